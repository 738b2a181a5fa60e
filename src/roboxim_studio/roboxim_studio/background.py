"""Threads that read and compress pictures beside the page.

They are no daemons: one that the interpreter's end meets inside OpenCV aborts the process. The interpreter waits for
them instead, and they look at `program_ends` between two pictures.
"""

from __future__ import annotations

import threading
from collections.abc import Callable


def run_beside(act: Callable[[], None], name: str) -> None:
    """Call a function in a thread; it returns soon after `program_ends` is true."""
    threading.Thread(target=act, name=name, daemon=False).start()


def program_ends() -> bool:
    """Return whether the program has come to its end and waits for its threads."""
    return not threading.main_thread().is_alive()
