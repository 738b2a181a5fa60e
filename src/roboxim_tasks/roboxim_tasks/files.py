"""Cache of the named YAML files that every reset reads; a changed file is parsed again."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import TypeVar, cast

from roboxim_core.config import config_dirs, named_config
from roboxim_core.plain_data.pictures import load_scenery

T = TypeVar("T")


def named(kind: str, name: str, cls: type[T]) -> T:
    """Return ``config/<kind>/<name>.yaml`` as a frozen dataclass.

    Raises:
        ConfigError: When the file is missing or invalid.
    """
    path = named_config(kind, name)
    return cast("T", _load(path, path.stat().st_mtime_ns, config_dirs(), cls))  # type: ignore[arg-type]


@lru_cache(maxsize=64)
def _load(path: Path, _mtime_ns: int, _folders: tuple[Path, ...], cls: type[object]) -> object:
    return load_scenery(path, cls)
