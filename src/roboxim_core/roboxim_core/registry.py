"""A named collection that features register themselves in: skills, objects, reset components, renderers, policies, ...

A third-party distribution adds to a registry through an entry point of the registry's group, so a plug-in needs no
change here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib.metadata import entry_points
from typing import Generic, TypeVar

from roboxim_core.errors import ConfigError, one_of

T = TypeVar("T")


class Registry(Generic[T]):
    """Names to values of one kind; raises on duplicates and lists the valid names when one is unknown."""

    def __init__(self, kind: str) -> None:
        """Make an empty registry.

        Args:
            kind: What it holds, for messages and for the entry point group ``roboxim.<kind>``, e.g. ``"skill"``.
        """
        self.kind = kind
        self._items: dict[str, T] = {}
        self._entry_points_loaded = False

    def register(self, name: str) -> Callable[[T], T]:
        """Return a decorator that registers its argument under a name.

        Args:
            name: Unique name, lower case with underscores.

        Raises:
            ConfigError: When the name is taken.
        """

        def add(item: T) -> T:
            if name in self._items:
                raise ConfigError(f"{self.kind} '{name}' is registered twice; give one of them another name")
            self._items[name] = item
            return item

        return add

    def __getitem__(self, name: str) -> T:
        """Return the item of a name.

        Raises:
            ConfigError: When nothing is registered under the name; the message lists what is.
        """
        self._load_entry_points()
        try:
            return self._items[name]
        except KeyError:
            raise ConfigError(f"unknown {self.kind} '{name}'; {one_of(self._items, name)}") from None

    def __contains__(self, name: object) -> bool:
        """Tell whether a name is registered."""
        self._load_entry_points()
        return name in self._items

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names, sorted."""
        self._load_entry_points()
        return iter(sorted(self._items))

    def __len__(self) -> int:
        """Count the registered items."""
        self._load_entry_points()
        return len(self._items)

    def _load_entry_points(self) -> None:
        if not self._entry_points_loaded:
            self._entry_points_loaded = True
            for entry in entry_points(group=f"roboxim.{self.kind.replace(' ', '_')}"):
                entry.load()
