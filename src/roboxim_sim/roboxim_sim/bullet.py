"""PyBullet, imported without the line that it heads every command's output with, its build time."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

_GREETING = b"pybullet build time"


@contextlib.contextmanager
def _without_greeting() -> Iterator[None]:
    """Hold back what is written to file descriptor 2, and then pass on all but the greeting."""
    kept = os.dup(2)
    with os.fdopen(os.memfd_create("stderr"), "r+b") as held:
        os.dup2(held.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            held.seek(0)
            rest = b"".join(line for line in held if not line.startswith(_GREETING))
            if rest:
                os.write(2, rest)


with _without_greeting():
    import pybullet

__all__ = ["pybullet"]
