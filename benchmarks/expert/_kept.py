"""Storage of a long benchmark's episodes in a folder; rejects episodes of other code or another configuration."""

from __future__ import annotations

import hashlib
import json
import subprocess
from collections import defaultdict
from collections.abc import Iterable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from roboxim_core.config import config_dirs
from roboxim_core.plain_data.results_log import ResultsLog

PACKAGES = ("core", "sim", "planner", "planner_native", "tasks", "eval", "ros", "bringup", "runs")
SUFFIXES = (".py", ".so", ".yaml", ".urdf", ".srdf", ".obj", ".stl", ".glb")
"""Patterns of the files that influence an episode; textures and documents do not."""


class Kept:
    """A folder with ``episodes.jsonl``, one episode a line, and ``made_by.json``."""

    def __init__(self, folder: Path, configs: Mapping[str, str]) -> None:
        """Open or create a folder.

        Args:
            folder: The folder.
            configs: Configurations by cell.

        Raises:
            SystemExit: When the folder has episodes of other code, or of another configuration of a cell.
        """
        self._log = ResultsLog(folder / "episodes.jsonl")
        made_by, cells = folder / "made_by.json", {name: _digest(text.encode()) for name, text in configs.items()}
        now: dict[str, Any] = {"code": code_digest(), "commit": commit(), "cells": cells}
        if self._log.path.exists():
            then = (
                json.loads(made_by.read_text()) if made_by.exists() else {"code": "", "commit": "unknown", "cells": {}}
            )
            if then["code"] != now["code"]:
                raise SystemExit(
                    f"{folder} holds episodes of other code (commit {then['commit']}; this is {now['commit']}, "
                    "or files have changed since): set --out to a new folder, or continue with the original code"
                )
            other = [name for name, digest in cells.items() if then["cells"].get(name, digest) != digest]
            if other:
                raise SystemExit(
                    f"{folder} holds episodes of another configuration of {', '.join(other)}: set --out to a new folder"
                )
            now["cells"] = then["cells"] | cells
        folder.mkdir(parents=True, exist_ok=True)
        made_by.write_text(json.dumps(now, indent=2) + "\n")

        self._keys = {name: f"{now['code']}-{digest}" for name, digest in now["cells"].items()}

    def load(self) -> dict[str, list[dict[str, Any]]]:
        """Return the episodes of each cell.

        Raises:
            SystemExit: When an episode comes from other code, or from another configuration of its cell.
        """
        found: dict[str, list[dict[str, Any]]] = defaultdict(list)
        for entry in self._log.read():
            cell = entry.data["cell"]
            if entry.key not in ("", self._keys.get(cell)):
                raise SystemExit(f"{self._log.path} line {entry.line} is of other code, or another configuration")
            found[cell].append(entry.data)
        return found

    def add(self, episodes: Iterable[Mapping[str, Any]]) -> None:
        """Append episodes."""
        for episode in episodes:
            self._log.append(self._keys[episode["cell"]], episode)


def code_digest() -> str:
    """Return a hash of the code and configuration that this process actually uses, independent of their location."""
    digest = hashlib.blake2b(digest_size=8)
    roots = [Path(str(import_module(f"roboxim_{name}").__file__)).parent for name in PACKAGES]
    for root in (*roots, *config_dirs()):
        for path in sorted(root.rglob("*")):
            if path.suffix in SUFFIXES and path.is_file():
                digest.update(
                    f"{root.name}/{path.relative_to(root)}".encode() + b"\0" + _digest(path.read_bytes()).encode()
                )
    return digest.hexdigest()


def commit() -> str:
    """Return the checkout's commit; ``unknown`` outside a checkout."""
    asked = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short=12", "HEAD"]
    answer = subprocess.run(asked, capture_output=True, text=True, check=False)
    return answer.stdout.strip() or "unknown"


def _digest(data: bytes) -> str:
    return hashlib.blake2b(data, digest_size=8).hexdigest()
