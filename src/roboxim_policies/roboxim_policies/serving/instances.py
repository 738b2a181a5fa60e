"""The instances of a served policy: one for each session, used again by later ones."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Generic, TypeVar

from roboxim_core.errors import UnavailableError

T = TypeVar("T")


class Instances(Generic[T]):
    """Instances that sessions take and give back; more are made when all are taken."""

    def __init__(self, first: T, make: Callable[[], T], *, max_instances: int) -> None:
        """Start with one instance.

        Args:
            first: The first instance.
            make: Makes another one.
            max_instances: Largest number of sessions at the same time.
        """
        self._make, self._most = make, max_instances
        self._free = [first]
        self._open = 0
        self._lock = threading.Lock()

    @contextmanager
    def taken(self) -> Iterator[T]:
        """Yield an instance that no other session has.

        Raises:
            UnavailableError: When there are too many sessions.
        """
        with self._lock:
            if self._open >= self._most:
                raise UnavailableError(f"the server has {self._most} sessions already")
            self._open += 1
            free = [self._free.pop()] if self._free else []
        try:
            if not free:
                free.append(self._make())
            yield free[0]
        finally:
            with self._lock:
                self._open -= 1
                self._free += free

    def close(self) -> None:
        """Forget the free instances."""
        with self._lock:
            self._free.clear()
