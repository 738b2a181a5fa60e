"""Results of a run, appended line by line, so that a crash loses at most the line that was being written.

A line is a JSON object; its ``key`` is the hash of everything that the result depends on. So a line is never taken for
a result of another configuration or of other code, whatever was copied into the file. This is the one place that
resuming relies on: episodes, rendering and the benchmarks keep their results here.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from roboxim_core.errors import ConfigError

KEY = "key"
REMEDY = "the same command with --repair drops what cannot be read and runs it again; or choose another --out"


@dataclass(frozen=True, kw_only=True)
class LoggedResult:
    """One line."""

    line: int
    """Its number, from 1."""
    key: str
    """Hash of what it depends on; empty in files of older versions."""
    data: dict[str, Any]
    """The result, plain data."""


class ResultsLog:
    """A file of results."""

    def __init__(self, path: Path) -> None:
        """Name the file; it need not exist."""
        self.path = path

    def read(self) -> list[LoggedResult]:
        """Return the results in the order of their lines; a torn last line (a crash) is left out.

        Raises:
            ConfigError: When another line is not a result, naming the line.
        """
        results = []
        for number, line in enumerate(self._lines(), start=1):
            try:
                results.append(_parse(number, line))
            except ValueError as error:
                raise ConfigError(f"{self.path} line {number} is not a result ({error}); {REMEDY}") from None
        return results

    def append(self, key: str, result: Mapping[str, Any]) -> None:
        """Add a result; it is on the disk when this returns.

        Args:
            key: Hash of what the result depends on.
            result: Plain data.
        """
        if self.path.exists() and self.path.stat().st_size and not self.path.read_bytes().endswith(b"\n"):
            whole = self.path.read_bytes().rpartition(b"\n")[0]
            write_atomically(self.path, whole.decode(errors="replace") + ("\n" if whole else ""))
        with open(self.path, "a") as file:
            file.write(json.dumps({**result, KEY: key}, sort_keys=True, separators=(",", ":")) + "\n")
            file.flush()
            os.fsync(file.fileno())

    def repair(self, keep: Callable[[LoggedResult], bool] = lambda _: True) -> int:
        """Drop lines that are no results, or not to be kept; the file as it was stays beside it, ``<name>.damaged``.

        Args:
            keep: Tells whether a result that can be read stays.

        Returns:
            Number of lines dropped.
        """
        kept, dropped = [], 0
        for number, line in enumerate(self._lines(), start=1):
            try:
                fits = keep(_parse(number, line))
            except (ValueError, ConfigError):
                fits = False
            if fits:
                kept.append(line)
            else:
                dropped += 1
        if dropped:
            self.path.with_name(f"{self.path.name}.damaged").write_bytes(self.path.read_bytes())
            write_atomically(self.path, "".join(f"{line}\n" for line in kept))
        return dropped

    def _lines(self) -> list[str]:
        """Return the whole lines; what follows the last line's end was torn off by a crash."""
        if not self.path.exists():
            return []
        return self.path.read_bytes().decode(errors="replace").split("\n")[:-1]


def _parse(number: int, line: str) -> LoggedResult:
    try:
        data = json.loads(line)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    if not isinstance(data, dict):
        raise ValueError("expected a JSON object")
    key = data.pop(KEY, "")
    if not isinstance(key, str):
        raise ValueError(f"its key must be text, got {key!r}")
    return LoggedResult(line=number, key=key, data=data)


def write_atomically(path: Path, text: str) -> None:
    """Write a file so that it is there as a whole or not at all."""
    partial = path.with_name(f".{path.name}.partial")
    partial.write_text(text)
    partial.replace(path)
