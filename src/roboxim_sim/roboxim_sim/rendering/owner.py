"""Binds a renderer to the thread that made it."""

from __future__ import annotations

import os
import threading

from roboxim_core.errors import SimError


class Owner:
    """Refuses calls from another thread, from a forked child and after closing.

    GL drivers answer such calls with the previous image or never; a renderer without GL keeps the same rule, so that
    a program that works with one works with all.
    """

    def __init__(self) -> None:
        """Bind to the calling thread."""
        self._pid, self._thread = os.getpid(), threading.current_thread()
        self.closed = False

    def check(self) -> None:
        """Check the calling thread.

        Raises:
            SimError: When it is not the owner, or the renderer is closed.
        """
        if self.closed:
            raise SimError("the renderer is closed; make another one")
        if (self._pid, self._thread) != (os.getpid(), threading.current_thread()):
            raise SimError(
                f"a renderer is bound to the thread that made it ({self._thread.name} of process {self._pid}); called "
                f"from {threading.current_thread().name} of process {os.getpid()}: call it there, or make another one"
            )
