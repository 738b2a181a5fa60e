"""Registers the Gymnasium environments when both RoboXim and Gymnasium are imported, in either order.

``gymnasium.make("roboxim:...")`` imports `roboxim`, but an import that has happened before does nothing. Importing
Gymnasium here would cost every script a second. So if it is not loaded yet, a finder waits for its import.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

NAME = "gymnasium"


def register_with_gymnasium() -> None:
    """Register now, or as soon as Gymnasium is imported."""
    if NAME in sys.modules:
        _register()
    else:
        sys.meta_path.insert(0, _Finder())


def _register() -> None:
    from roboxim_runs.environments.ids import register

    register()


class _Finder(MetaPathFinder):
    """Finds Gymnasium as the other finders do, with a loader that registers afterwards."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != NAME:
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(fullname)
        if spec is not None and spec.loader is not None:
            spec.loader = _Loader(spec.loader)
        return spec


class _Loader(Loader):
    def __init__(self, loader: Loader) -> None:
        self._loader = loader

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        if module.__spec__ is not None:
            module.__spec__.loader = module.__loader__ = self._loader
        self._loader.exec_module(module)
        _register()
