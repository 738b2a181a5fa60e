"""Names for the command line: skills, tasks, objects, policies. Imports no heavy module.

Listing skills with the objects that suit them, and checking every task, means importing numerics. The catalog is
therefore cached in the user's cache folder with a fingerprint of its sources: RoboXim's modules, the YAML files and the
installed distributions. `roboxim tasks list`, tab completion and the first check of an option read the cache, and renew
it when it is stale. It has four parts with a file each, so that a command makes only what it shows.

As a program, it renews one part.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from roboxim_core.config_folders import config_dirs, config_names, config_sets
from roboxim_core.user_folders import cache_dir
from roboxim_core.whole_files import write_whole

if TYPE_CHECKING:
    from roboxim_cli.catalog_maker import Catalog, Part

PART_OF: dict[str, Part] = {"skill": "tasks", "policy": "policies"}
"""Kind of name to the part of the catalog that knows the names; names of other kinds are those of files."""

_PACKAGES = tuple(f"roboxim_{name}" for name in ("core", "tasks", "policies", "eval", "bringup", "runs", "cli"))
RATES_FILES = "rates-*/*.json"
"""Measured rates of all image sizes and experiments, see `roboxim_runs.experiments.calibration.rates`."""


def catalog(part: Part) -> Catalog:
    """Return a part of the catalog; renew it when it is stale.

    Raises:
        ConfigError: When a configuration folder is missing.
    """
    fingerprint = _fingerprint(part)
    kept = _fresh(part, fingerprint)
    if kept is not None:
        return kept
    from roboxim_cli.catalog_maker import make_catalog

    made = make_catalog(part)
    _write(_file(part), {"fingerprint": fingerprint, "catalog": made})
    return made


def fresh_catalog(part: Part) -> Catalog | None:
    """Return the cached part if its sources are unchanged, else None."""
    return _fresh(part, _fingerprint(part))


def names_of(kind: str) -> list[str]:
    """Return the names of a kind at once, for tab completion.

    Skills and policies come from the cached catalog. When it is stale, a background process renews it for the next
    call.

    Args:
        kind: ``skill``, ``policy``, or a kind of configuration: ``task``, ``object``, ``camera``, ...
    """
    if kind == "renderer":
        return []
    if kind == "object":
        sets = config_sets("objects", config_dirs())
        return sorted({*config_names("objects"), *sets, *(name for members in sets.values() for name in members)})
    if kind not in PART_OF:
        return config_names(f"{kind}s")
    part = PART_OF[kind]
    kept = _read(_file(part))
    if kept.get("fingerprint") != _fingerprint(part):
        subprocess.Popen(
            [sys.executable, "-m", "roboxim_cli.catalog", part],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
    return sorted(kept.get("catalog", {}).get("skills" if kind == "skill" else "policies", {}))


def _fresh(part: Part, fingerprint: str) -> Catalog | None:
    kept = _read(_file(part))
    return cast("Catalog", kept["catalog"]) if kept.get("fingerprint") == fingerprint else None


def _file(part: Part) -> Path:
    """Return a part's cache file for this installation and these configuration folders."""
    place = "\n".join([sys.prefix, *map(str, _folders())])
    return cache_dir() / f"{part}-{hashlib.blake2b(place.encode(), digest_size=6).hexdigest()}.json"


def _folders() -> Iterable[Path]:
    for package in _PACKAGES:
        spec = importlib.util.find_spec(package)
        yield from map(Path, (spec.submodule_search_locations or ()) if spec else ())
    yield from config_dirs()


def _fingerprint(part: Part) -> str:
    """Return a hash of the names, sizes and times of the files that a part depends on."""
    digest = hashlib.blake2b(digest_size=16)
    for folder in _folders():
        for path in sorted(folder.rglob("*")):
            if path.suffix in (".py", ".yaml", ".yml"):
                status = path.stat()
                digest.update(f"{path}\n{status.st_mtime_ns} {status.st_size}\n".encode())
    for place in sys.path:  # folders of installed distributions, which may bring plug-ins
        if "site-packages" in place:
            with contextlib.suppress(OSError):
                digest.update(f"{place} {os.stat(place).st_mtime_ns}\n".encode())
    if part == "experiments":
        for path in sorted(cache_dir().glob(RATES_FILES)):
            digest.update(f"{path.parent.name}/{path.name} {path.stat().st_mtime_ns}\n".encode())
    return digest.hexdigest()


def _read(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return data if isinstance(data, dict) and isinstance(data.get("catalog"), dict) else {}


def _write(path: Path, data: dict[str, Any]) -> None:
    """Write a file atomically. If that fails, the next call makes the catalog again."""
    with contextlib.suppress(OSError):
        write_whole(path, json.dumps(data))


if __name__ == "__main__":
    catalog(cast("Part", sys.argv[1]))
