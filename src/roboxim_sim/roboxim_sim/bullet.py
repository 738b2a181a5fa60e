"""PyBullet, imported without the build time that it prints on import."""

from __future__ import annotations

import contextlib
import functools
import inspect
import os
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

_GREETING = b"pybullet build time"


@contextlib.contextmanager
def _without_greeting() -> Iterator[None]:
    """Capture file descriptor 2 and afterwards write everything except the greeting to it."""
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


class BulletClient:
    """An in-process physics server with PyBullet's functions, bound to its id.

    The class of this name in ``pybullet_utils`` looks a function up at each call, and prints a line to stdout.
    """

    def __init__(self) -> None:
        """Connect. If this fails, e.g. because PyBullet allows no more servers, ``isConnected`` is false."""
        client = pybullet.connect(pybullet.DIRECT)
        functions = {name: value for name, value in vars(pybullet).items() if inspect.isbuiltin(value)}
        vars(self).update({name: functools.partial(f, physicsClientId=client) for name, f in functions.items()})

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...


@contextlib.contextmanager
def bullet_client() -> Iterator[BulletClient]:
    """Yield a client, and disconnect it at the end of the block."""
    client = BulletClient()
    try:
        yield client
    finally:
        client.disconnect()


__all__ = ["BulletClient", "bullet_client", "pybullet"]
