"""PyBullet, imported without the line that its library prints: standard output is for what a command answers."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
from collections.abc import Iterator


@contextlib.contextmanager
def _without_stdout() -> Iterator[None]:
    """Drop what is written to file descriptor 1; C has a buffer of its own."""
    libc = ctypes.CDLL(None)
    sys.stdout.flush()
    libc.fflush(None)
    kept, sink = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, 1)
    os.close(sink)
    try:
        yield
    finally:
        libc.fflush(None)
        os.dup2(kept, 1)
        os.close(kept)


with _without_stdout():
    import pybullet

__all__ = ["pybullet"]
