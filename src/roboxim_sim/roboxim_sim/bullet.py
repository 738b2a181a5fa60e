"""PyBullet, imported without the build time that it prints on import."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

_GREETING = b"pybullet build time"


@contextlib.contextmanager
def _without_greeting() -> Iterator[None]:
    """Capture file descriptor 2 and afterwards write everything but the greeting to it."""
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
