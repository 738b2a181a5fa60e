"""Binding of a renderer to the thread that created it."""

from __future__ import annotations

import os
import threading

from roboxim_core.errors import ErrorCode, SimError


class Owner:
    """Rejects calls from another thread, from a forked child process and after closing.

    GL drivers answer such calls with the previous image or never. Renderers without GL follow the same rule, so a
    program works with every renderer.
    """

    def __init__(self) -> None:
        """Bind to the calling thread."""
        self._pid, self._thread = os.getpid(), threading.current_thread()
        self.closed = False

    def end(self) -> bool:
        """Close the renderer; return whether there is something to free: false when it was closed before.

        Raises:
            SimError: When the calling thread is not the owner.
        """
        if self.closed:
            return False
        self.check()
        self.closed = True
        return True

    def check(self, *, loaded: bool = True) -> None:
        """Check the calling thread.

        Args:
            loaded: Whether the renderer has the world that the call needs; true if it needs none.

        Raises:
            SimError: When the calling thread is not the owner, the renderer is closed, or it has no world.
        """
        if self.closed:
            raise SimError("the renderer is closed; create another one")
        if (self._pid, self._thread) != (os.getpid(), threading.current_thread()):
            raise SimError(
                f"a renderer is bound to the thread that created it ({self._thread.name} of process {self._pid}); "
                f"called from {threading.current_thread().name} of process {os.getpid()}: call it "
                "there, or create another one"
            )
        if not loaded:
            raise SimError("the renderer has no world yet: call load() first", ErrorCode.NO_SCENE)
