"""Results of a run, appended line by line: a crash loses at most the line being written.

A line is a JSON object. Its ``key`` is the hash of everything that the result depends on, so a line copied from a run
of another configuration or of other code is never reused. Its ``checksum`` is the hash of all its other fields, so a
line that was edited by hand is refused. Lines of versions before 2026-11-27 have none; `LoggedResult.checked` says so.
Resuming relies on this module alone: episodes, rendering and the benchmarks keep their results here.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from roboxim_core.config import digest
from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.documents import parse_json
from roboxim_core.whole_files import write_whole

RUN_FILE, RESULTS_FILE = "run.json", "results.jsonl"
"""Files of a run's folder: its configuration, and its results."""
KEY, CHECKSUM = "key", "checksum"
REMEDY = (
    "run again with --repair or repair=True, which drops unreadable results and repeats them, or choose another output "
    "folder (--out or out=)"
)


@dataclass(frozen=True, kw_only=True)
class LoggedResult:
    """One line."""

    line: int
    """Line number, from 1."""
    key: str
    """Hash of everything that the result depends on; empty in files of older versions."""
    data: dict[str, Any]
    """The result, as plain data."""
    checked: bool
    """Whether the line has a checksum, which agreed; false in files of older versions, whose edits are not noticed."""


class ResultsLog:
    """A file of results."""

    def __init__(self, path: Path) -> None:
        """Store the file's path; the file need not exist."""
        self.path = path

    def read(self) -> list[LoggedResult]:
        """Return the results in the order of their lines. A torn last line, left by a crash, is skipped.

        Raises:
            ConfigError: When any other line is not a result, or was changed; the message names the line.
        """
        results: list[LoggedResult] = []
        for number, line in enumerate(self._lines(), start=1):
            try:
                results.append(_parse(number, line))
                if not results[-1].checked and any(entry.checked for entry in results[-2:-1]):
                    raise ValueError("was changed: it has no checksum, although the line before it has one")
            except ValueError as error:
                raise ConfigError(f"{self.path} line {number} {error}; {REMEDY}") from None
        return results

    def append(self, key: str, *results: Mapping[str, Any]) -> None:
        """Append results. They are on the disk when this returns.

        Args:
            key: Hash of everything that the results depend on.
            *results: Plain data.
        """
        if self._ends_torn():
            whole = self.path.read_bytes().rpartition(b"\n")[0]
            write_whole(self.path, whole.decode(errors="replace") + ("\n" if whole else ""))
        with open(self.path, "a") as file:
            file.write("".join(line_of(key, result) for result in results))
            file.flush()
            os.fsync(file.fileno())

    def repair(self, keep: Callable[[LoggedResult], bool] = lambda _: True) -> int:
        """Drop lines that are not results or not to be kept. The original file stays as ``<name>.damaged``.

        Args:
            keep: Returns whether to keep a readable result.

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
            write_whole(self.path, "".join(f"{line}\n" for line in kept))
        return dropped

    def _ends_torn(self) -> bool:
        """Return whether a crash left a partial last line; reads one byte, since runs have many results."""
        if not self.path.exists() or not self.path.stat().st_size:
            return False
        with open(self.path, "rb") as file:
            file.seek(-1, os.SEEK_END)
            return file.read(1) != b"\n"

    def _lines(self) -> list[str]:
        """Return the whole lines, without the partial last line that a crash leaves."""
        if not self.path.exists():
            return []
        return self.path.read_bytes().decode(errors="replace").split("\n")[:-1]


def line_of(key: str, result: Mapping[str, Any]) -> str:
    """Return a result as a line of a file, with its checksum and the end of the line."""
    fields = {**result, KEY: key}
    return _canonical({**fields, CHECKSUM: digest(_canonical(fields))}) + "\n"


def _canonical(fields: Mapping[str, Any]) -> str:
    return json.dumps(fields, sort_keys=True, separators=(",", ":"))


def _parse(number: int, line: str) -> LoggedResult:
    try:
        data = parse_json(line, source="the line")
    except ConfigError as error:
        raise ValueError(f"is not a result ({error})") from None
    if not isinstance(data, dict):
        raise ValueError("is not a result (expected a JSON object)")
    checksum = data.pop(CHECKSUM, None)
    if checksum not in (None, digest(_canonical(data))):
        raise ValueError("was changed after it was written: its checksum is of other values")
    key = data.pop(KEY, "")
    if not isinstance(key, str):
        raise ValueError(f"is not a result (its key must be text, got {key!r})")
    return LoggedResult(line=number, key=key, data=data, checked=checksum is not None)
