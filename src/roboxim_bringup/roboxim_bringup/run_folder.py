"""A run on disk: what was asked and which indices are done, so that Ctrl-C and a crash lose at most running episodes.

``run.json`` holds the configuration, ``results.jsonl`` one finished result a line. Asking for the same run again
goes on where it stopped; asking for another run in the same folder is refused.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from roboxim_core.config import from_json, to_json
from roboxim_core.differences import differences
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError, ErrorCode, RoboximError
from roboxim_recorder.bag_writer import PARTIAL, PLACES

RUN_FILE = "run.json"
RESULTS_FILE = "results.jsonl"
MAY_DIFFER = ("episodes", "workers")
"""Keys of a run's configuration that may change when it goes on: more episodes, other machines."""
COMMANDS = {"demo": "generate", "eval": "evaluate"}
"""Purpose of a run's episodes to the command that makes them."""


class RunFolder:
    """The folder of one run."""

    def __init__(self, path: Path | str) -> None:
        """Name the folder; nothing is made yet."""
        self.path = Path(path).resolve()

    @contextmanager
    def opened(self, config: Mapping[str, Any]) -> Iterator[RunFolder]:
        """Make the folder or go on with it, alone.

        Args:
            config: Everything that results depend on, plain data; compared with the stored one once there are results.

        Raises:
            ConfigError: When the folder holds another run or something else, or is in use.
            RoboximError: ``DISK`` when it cannot be made.
        """
        stored_at = self.path / RUN_FILE
        make_folder(self.path)
        if not stored_at.exists() and any(not p.name.startswith(".") for p in self.path.iterdir()):
            raise ConfigError(f"{self.path} exists and is not a run's folder; choose another --out or empty it")
        with open(self.path / ".lock", "w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise ConfigError(f"another command is running in {self.path}; wait for it or stop it") from None
            if stored_at.exists() and (self.path / RESULTS_FILE).exists():
                self._require_same(json.loads(stored_at.read_text()), config)
            write_atomically(stored_at, json.dumps(dict(config), indent=2, sort_keys=True) + "\n")
            try:
                yield self
            except KeyboardInterrupt:
                done = len(self.results())
                click.echo(
                    f"{done} episode{'s are' if done != 1 else ' is'} done in {self.path}; "
                    "the same command goes on with what is missing",
                    err=True,
                )
                raise

    def _require_same(self, stored: Mapping[str, Any], config: Mapping[str, Any]) -> None:
        there, asked = command_of(stored), command_of(config)
        if there != asked:
            raise ConfigError(f"{self.path} holds a run of 'roboxim {there}'; choose another --out")
        details = differences(stored, json.loads(json.dumps(dict(config))), ignore=MAY_DIFFER)
        if not details:
            return
        results = self.results()
        if asked == "generate" and not any(result.outcome == "success" for result in results):
            todo = (
                f"none of its {len(results)} episodes succeeded: remove it (rm -r {self.path}) or choose another --out"
            )
        else:
            todo = "choose another --out, or ask for the same to go on with it"
        raise ConfigError(f"{self.path} holds a run with another configuration ({details}); {todo}")

    @property
    def in_use(self) -> bool:
        """Whether a command is running in the folder now."""
        try:
            with open(self.path / ".lock") as lock:
                fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        except OSError:  # no lock, or not ours to read
            return False
        return False

    def config(self) -> dict[str, Any]:
        """Return the stored configuration.

        Raises:
            ConfigError: When the folder is not a run's.
        """
        try:
            return dict(json.loads((self.path / RUN_FILE).read_text()))
        except (OSError, json.JSONDecodeError) as error:
            raise ConfigError(f"{self.path} is not a run's folder (no readable {RUN_FILE}): {error}") from None

    def results(self) -> list[EpisodeResult]:
        """Return the finished results in the order of their indices; a torn last line (a crash) is left out."""
        path = self.path / RESULTS_FILE
        if not path.exists():
            return []
        lines = path.read_text().split("\n")
        found = {}
        for number, line in enumerate(lines[:-1], start=1):
            result = from_json(line, EpisodeResult, source=f"{path} line {number}")
            found[result.index] = result
        return [found[index] for index in sorted(found)]

    def discard(self, index: int) -> None:
        """Remove the bags of an index that has no result, partial or whole: a crash left them."""
        for place in (*PLACES.values(), PARTIAL):
            for bag in (self.path / place).glob(f"*-{index:05d}-*"):
                shutil.rmtree(bag)

    def append(self, result: EpisodeResult) -> None:
        """Add a finished result; it is on the disk when this returns."""
        path = self.path / RESULTS_FILE
        if path.exists() and not path.read_bytes().endswith(b"\n") and path.stat().st_size:
            whole = path.read_bytes().rpartition(b"\n")[0]
            write_atomically(path, whole.decode() + ("\n" if whole else ""))
        with open(path, "a") as file:
            file.write(to_json(result) + "\n")
            file.flush()
            os.fsync(file.fileno())


def make_folder(path: Path) -> None:
    """Make a folder for what a command writes, if it is not there.

    Raises:
        RoboximError: ``DISK`` when a file is in its place or it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = "it is a file" if path.is_file() else error.strerror or str(error)
        raise RoboximError(f"cannot make the folder {path}: {reason}; choose another --out", ErrorCode.DISK) from None


def command_of(config: Mapping[str, Any]) -> str:
    """Return the command that a run's configuration is of."""
    return "rerender" if "rerender" in config else COMMANDS.get(str(config.get("purpose")), "generate")


def write_atomically(path: Path, text: str) -> None:
    """Write a file so that it is there as a whole or not at all."""
    partial = path.with_name(f".{path.name}.partial")
    partial.write_text(text)
    partial.replace(path)
