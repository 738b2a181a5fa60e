"""Folders and names of RoboXim's YAML files. Tab completion uses this module, so it imports nothing heavy."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path

from roboxim_core import limits
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.user_folders import expanded

PLACE = "config://"
"""Begin of the name of a file in a folder of the search path."""
_PARENTS = tuple(Path(__file__).resolve().parents)


def config_dir() -> Path:
    """Return the directory of RoboXim's YAML files: ``$ROBOXIM_CONFIG_DIR``, or ``config/`` of the checkout.

    Raises:
        ConfigError: When there is no such directory.
    """
    return _with_robots(os.environ.get("ROBOXIM_CONFIG_DIR", ""))


@cache
def _with_robots(given: str) -> Path:
    candidates = [Path(given)] if given else [parent / "config" for parent in _PARENTS]
    for candidate in candidates:
        if (candidate / "robots").is_dir():
            return candidate
    raise ConfigError("no config directory with robots/ found; run from a checkout or set ROBOXIM_CONFIG_DIR")


def config_dirs() -> tuple[Path, ...]:
    """Return the search path of YAML files: the folders of ``$ROBOXIM_CONFIG_PATH``, then `config_dir`.

    ``ROBOXIM_CONFIG_PATH`` is a list like ``PATH``, of the user's folders with ``objects/``, ``cameras/`` and so on.

    Raises:
        ConfigError: When one of them is not a folder.
    """
    own = tuple(expanded(part) for part in os.environ.get("ROBOXIM_CONFIG_PATH", "").split(os.pathsep) if part)
    for folder in own:
        if not folder.is_dir():
            raise ConfigError(f"ROBOXIM_CONFIG_PATH names {folder}, which is not a folder")
    return (*own, config_dir())


def config_names(kind: str) -> list[str]:
    """Return the names of the YAML files of a kind, sorted.

    Args:
        kind: Folder in ``config/``, e.g. ``cameras``.

    Raises:
        ConfigError: See `config_dirs`.
    """
    return sorted({path.stem for folder in config_dirs() for path in (folder / kind).glob("*.yaml")})


def config_sets(kind: str, folders: Iterable[Path]) -> dict[str, dict[str, Path]]:
    """Return the sets of a kind: name of each subfolder with YAML files to name and path of these, all sorted.

    Args:
        kind: Folder in ``config/``, e.g. ``objects``.
        folders: Search path, see `config_dirs`; a file hides later ones of its name in the set.
    """
    found: dict[str, dict[str, Path]] = {}
    for folder in folders:
        for path in (folder / kind).glob("*/*.yaml"):
            found.setdefault(path.parent.name, {}).setdefault(path.stem, path)
    return {name: dict(sorted(members.items())) for name, members in sorted(found.items())}


def named_config(kind: str, name: str) -> Path:
    """Return the YAML file of a configuration: ``config/<kind>/<name>.yaml``, or the path if the name is one.

    Args:
        kind: Folder in ``config/``, e.g. ``cameras``.
        name: Name without suffix, or a path to a YAML file.

    Raises:
        ConfigError: When there is no such file; the message suggests names.
    """
    if is_path(name):
        try:
            path = expanded(name)
            found = path.is_file()
        except (OSError, ValueError, RuntimeError):  # too long, a NUL, no such user
            found = False
        if not found:
            raise ConfigError(f"no such file: {limits.echo(name)}")
        return path
    if limits.is_file_name(name):
        for folder in config_dirs():
            if (path := folder / kind / f"{name}.yaml").is_file():
                return path
    raise ConfigError(f"no '{name}' in config/{kind}; {one_of(config_names(kind), name)}")


def place_name(path: Path) -> str:
    """Return the name of a file in configurations, whose hashes must not depend on where the user's folders lie.

    Returns:
        In a folder of the search path its place there, e.g. ``config://looks/photo.png``, else the path as it is.
    """
    whole = path.resolve()
    for own in (one.resolve() for one in config_dirs()):
        if whole.is_relative_to(own):
            name = f"{PLACE}{whole.relative_to(own).as_posix()}"
            if place_file(name).resolve() == whole:  # no other folder hides it
                return name
    return str(path)


def place_file(name: str) -> Path:
    """Return the file of a name that `place_name` gives."""
    if not name.startswith(PLACE):
        return Path(name)
    found = [folder / name.removeprefix(PLACE) for folder in config_dirs()]
    return next((path for path in found if path.is_file()), found[-1])


def is_path(name: str) -> bool:
    """Return whether this is a path to a YAML file rather than the name of a configuration."""
    return re.search(r"[/\\]|\.ya?ml$", name) is not None
