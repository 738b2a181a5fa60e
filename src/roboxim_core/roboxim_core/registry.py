"""A collection in which extensions register by name: skills, objects, reset components, renderers, policies, ...

A third-party distribution adds to a registry through an entry point of the registry's group, so a plug-in needs no
change here.
"""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from hashlib import sha256
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Generic, TypeVar

from roboxim_core.errors import ConfigError, one_of

T = TypeVar("T")


class Registry(Generic[T]):
    """Mapping of names to items of one kind; duplicates and unknown names raise errors that list the valid names."""

    def __init__(self, kind: str, checks: str = "") -> None:
        """Make an empty registry.

        Args:
            kind: Kind of the items, for messages and for the entry point group ``roboxim.<kind>``, e.g. ``"skill"``.
            checks: Module with further conformance checks, imported by the first `check`: for checks that use modules
                which import the registry.
        """
        self.kind = kind
        self._checks_in = checks
        self._items: dict[str, T] = {}
        self._broken: dict[str, str] = {}
        self._checks: list[Callable[[str, T], None]] = []
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
        """Return the item with a name.

        Raises:
            ConfigError: When nothing is registered under the name; the message lists the known names.
        """
        self._load_entry_points()
        try:
            return self._items[name]
        except KeyError:
            if name in self._broken:
                raise ConfigError(f"the plug-in of {self.kind} '{name}' is broken: {self._broken[name]}") from None
            others = f"; plug-ins that could not be loaded: {', '.join(sorted(self._broken))}" if self._broken else ""
            raise ConfigError(f"unknown {self.kind} '{name}'; {one_of(self._items, name)}{others}") from None

    def __contains__(self, name: object) -> bool:
        """Return whether a name is registered."""
        self._load_entry_points()
        return name in self._items

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names in sorted order."""
        self._load_entry_points()
        return iter(sorted(self._items))

    def __len__(self) -> int:
        """Count the registered items."""
        self._load_entry_points()
        return len(self._items)

    @property
    def broken(self) -> dict[str, str]:
        """Name of each plug-in that could not be loaded, mapped to its location and the error."""
        self._load_entry_points()
        return dict(self._broken)

    def conformance(self, check: Callable[[str, T], None]) -> Callable[[str, T], None]:
        """Register a check that every item must pass; use as a decorator.

        Args:
            check: Called with a name and its item; must raise an error that describes the problem.
        """
        self._checks.append(check)
        return check

    def check(self, name: str) -> None:
        """Run all checks of the registry on an item; see `check_plugin`.

        Raises:
            ConfigError: When there is no such item, or it does not conform; the message names every failed check.
        """
        item = self[name]
        if self._checks_in:
            importlib.import_module(self._checks_in)
        failed = []
        if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
            failed.append(f"the name '{name}' is not lower case with underscores")
        for check in self._checks:
            try:
                check(name, item)
            except Exception as error:  # a plug-in may raise anything
                failed.append(f"{check.__name__}: {type(error).__name__}: {error}")
        if failed:
            raise ConfigError(f"{self.kind} '{name}' does not conform: " + "; ".join(failed))

    def _load_entry_points(self) -> None:
        if self._entry_points_loaded:
            return
        self._entry_points_loaded = True
        for entry in entry_points(group=f"roboxim.{self.kind.replace(' ', '_')}"):
            try:
                entry.load()
            except (Exception, SystemExit) as error:  # one broken plug-in must not prevent loading the others
                self._broken[entry.name] = f"{entry.value} raised {type(error).__name__}: {error}"


def import_modules(package: str, path: Iterable[str]) -> None:
    """Import every module of a package, which registers what it holds.

    Args:
        package: The package's ``__name__``.
        path: The package's ``__path__``.
    """
    for module in pkgutil.iter_modules(path):
        importlib.import_module(f"{package}.{module.name}")


def check_plugin(registry: Registry[T], name: str) -> None:
    """Check that an item conforms to its registry's kind. Authors of plug-ins call this in a test.

    ::

        def test_my_skill_conforms():
            check_plugin(SKILLS, "my_skill")

    Args:
        registry: E.g. ``roboxim_tasks.skills.SKILLS``.
        name: Registered name of the item.

    Raises:
        ConfigError: Naming every failed check.
    """
    registry.check(name)


def run_file(path: Path, name: str) -> ModuleType:
    """Run a user's Python file as a module, which dataclasses and pickles of its classes find in ``sys.modules``.

    Args:
        path: The file.
        name: Name of the module; where another file has it, a name made of it and the path.

    Raises:
        Exception: What the file raises.
    """
    path = path.absolute()
    if name in sys.modules and getattr(sys.modules[name], "__file__", None) != str(path):
        name = f"{name}_{sha256(str(path).encode()).hexdigest()[:8]}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module
