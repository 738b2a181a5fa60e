"""A run on disk: its configuration and finished indices. Ctrl-C and a crash lose at most the running episodes.

``run.json`` holds the configuration, ``results.jsonl`` one finished result per line. The same run continues where it
stopped; another run in the same folder is refused.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mcap.writer import MCAP0_MAGIC

from roboxim_core.config import digest, from_plain, to_plain
from roboxim_core.errors import ConfigError, ErrorCode, RecorderError, RoboximError, counted
from roboxim_core.plain_data.differences import differences
from roboxim_core.plain_data.documents import read_json_object
from roboxim_core.plain_data.results_log import REMEDY, RESULTS_FILE, RUN_FILE, LoggedResult, ResultsLog
from roboxim_core.shards import Shard
from roboxim_core.user_folders import expanded
from roboxim_core.whole_files import write_json
from roboxim_recorder.bag_writer import PARTIAL, PLACES
from roboxim_runs.storage.occupied import command_of, require_own
from roboxim_runs.storage.store import repair_stored, stored_bags

if TYPE_CHECKING:
    from roboxim_core.episode import EpisodeResult

MAY_DIFFER = ("episodes", "workers", "shard", "store", "server_probe")
"""Keys of a run's configuration that may change when it continues, e.g. on another machine or with more episodes. The
probe of a remote policy is compared by `roboxim_runs.policies.server_records`."""
LONGEST_NAME, LONGEST_PATH = 200, 3500
"""Largest number of bytes of a folder's name and of its whole path. Below a file system's own limits, since bags lie
deeper."""
EPISODE_MARK = "--- episode {} ---"
"""Line of a worker's log before the output of an episode; the number is the index in the run."""


class RunFolder:
    """The folder of one run."""

    def __init__(self, path: Path | str) -> None:
        """Store the folder's path; nothing is created yet.

        Raises:
            ConfigError: When the name is too long for a folder.
        """
        self.path = checked_path(path)
        self.log = ResultsLog(self.path / RESULTS_FILE)
        self._key = ""
        self._locked: tuple[int, int] | None = None  # device and number of the folder while it is open

    @contextmanager
    def opened(self, config: Mapping[str, Any], *, repair: bool = False) -> Iterator[RunFolder]:
        """Create the folder or continue in it, and lock it while the block runs.

        Args:
            config: Everything that results depend on, as plain data; compared with the stored configuration once there
                are results.
            repair: Drop results that are unreadable, or not certainly of this configuration.

        Raises:
            ConfigError: When the folder holds another run or other files, is in use, or has a damaged file.
            RoboximError: ``DISK`` when it cannot be made.
        """
        stored_at = self.path / RUN_FILE
        make_folder(self.path)
        require_own(self.path, command_of(config), own=(RUN_FILE,), empty=True)
        with locked(self.path):
            self._key, about = run_key(config), self.path.stat()
            self._locked = about.st_dev, about.st_ino
            if repair:
                repair_stored(self.path)
            if stored_at.exists() and self.log.path.exists():
                self._require_same(config, repair)
            self._require_same_store(config, repair)
            write_json(stored_at, dict(config), sort_keys=True)
            yield self

    def _require_same(self, config: Mapping[str, Any], repair: bool) -> None:
        """Refuse results of another configuration, and results whose configuration is unknown."""
        try:
            stored = self.config()
        except ConfigError:
            if not repair:
                raise
            self.log.repair(lambda entry: entry.key == self._key and bool(self._parsed(entry)))
            return
        self._require_same_configuration(stored, config)
        if repair:
            self.log.repair(lambda entry: entry.key in ("", self._key) and bool(self._parsed(entry)))
        for entry in self.log.read():
            if entry.key not in ("", self._key):
                raise ConfigError(f"{self.log.path} line {entry.line} is a result of another run; {REMEDY}")

    def _require_same_store(self, config: Mapping[str, Any], repair: bool) -> None:
        """Refuse another store than the one that has bags of the folder: they would no longer be found."""
        if not stored_bags(self.path):
            return
        try:
            stored = self.config()
        except ConfigError:
            if not repair:
                raise
            return
        before, now = (str(one.get("store", "")).rstrip("/") for one in (stored, config))
        if before != now:
            raise ConfigError(
                f"the bags of {self.path} are in the store '{before}', not in '{now}'; continue with --store {before} "
                "or store=, or choose another output folder (--out or out=)"
            )

    def _require_same_configuration(self, stored: Mapping[str, Any], config: Mapping[str, Any]) -> None:
        stored_command, command = command_of(stored), command_of(config)
        if stored_command != command:
            raise ConfigError(
                f"{self.path} holds a run of 'roboxim {stored_command}'; choose another output folder (--out or out=)"
            )
        details = differences(stored, json.loads(json.dumps(dict(config))), ignore=MAY_DIFFER)
        if not details:
            return
        results = self.results()
        if command == "generate" and not any(result.outcome == "success" for result in results):
            todo = (
                f"none of its {len(results)} episodes succeeded: remove it (rm -r {self.path}) or choose another "
                "output folder (--out or out=)"
            )
        else:
            todo = "choose another output folder (--out or out=), or the same configuration to continue the run"
        raise ConfigError(f"{self.path} holds a run with another configuration ({details}); {todo}")

    @property
    def in_use(self) -> bool:
        """Whether a command is running in the folder."""
        try:
            with open(self.path / ".lock") as lock:
                fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        except OSError:  # no lock, or no permission to read it
            return False
        return False

    def config(self) -> dict[str, Any]:
        """Return the stored configuration.

        Raises:
            ConfigError: When the folder is not a run's, or the file is damaged.
        """
        file = self.path / RUN_FILE
        try:
            with open(file, "rb"):
                pass
        except OSError as error:
            raise ConfigError(
                f"{self.path} is not a run's folder (no readable {RUN_FILE}): {error.strerror or error}"
            ) from None
        try:
            return read_json_object(file)
        except ConfigError as error:
            raise ConfigError(
                f"{file} is damaged ({error}), so the configuration of its results is unknown; restore the file, run "
                "again with --repair or repair=True, which keeps the results that name this configuration, or choose "
                "another output folder (--out or out=)"
            ) from None

    def results(self) -> list[EpisodeResult]:
        """Return the finished results in the order of their indices. A torn last line, left by a crash, is skipped.

        Episodes that their policy did not play (`EpisodeResult.played`) are also skipped; the same run repeats them.

        Raises:
            ConfigError: When any other line is not a result, was changed or is of another run; the message names the
                line.
        """
        found, key = {}, ""
        for entry in self.log.read():
            key = key or entry.key
            if entry.key not in ("", key):
                raise ConfigError(f"{self.log.path} line {entry.line} is a result of another run; {REMEDY}")
            result = self._parsed(entry)
            found[result.index, result.episode] = result
        return [found[place] for place in sorted(found) if found[place].played]

    def doubts(self) -> list[str]:
        """Return what keeps the results from being relied upon, a sentence each: lost and unchecked lines.

        Raises:
            ConfigError: When a line is not a result, or the configuration is damaged.
        """
        found = []
        unchecked = sum(not entry.checked for entry in self.log.read())
        if unchecked:
            found.append(
                f"{self.log.path} cannot be checked whole: lines without a checksum, which an earlier version wrote: "
                f"{unchecked}. Edits of them cannot be detected."
            )
        config = self.config() if (self.path / RUN_FILE).exists() else {}
        there = {result.index for result in self.results()}
        wanted = wanted_indices(config)
        if lost := [index for index in wanted if index not in there]:
            names = ", ".join(map(str, lost[:5])) + (", ..." if len(lost) > 5 else "")
            found.append(
                f"{len(lost)} of {len(wanted)} episodes have no result in {self.log.path} (index {names}): the run is "
                "not finished, or lines were removed."
            )
        return found

    def _parsed(self, entry: LoggedResult) -> EpisodeResult:
        try:
            from roboxim_core.episode import EpisodeResult

            return from_plain(entry.data, EpisodeResult, source=f"{self.log.path} line {entry.line}")
        except ConfigError as error:
            raise ConfigError(f"{error}; {REMEDY}") from None

    def without_bag(self, results: Iterable[EpisodeResult]) -> list[EpisodeResult]:
        """Return the results whose bag is neither in a store nor whole in the folder: gone, or cut short."""
        stored = stored_bags(self.path)
        return [
            result
            for result in results
            if result.bag and result.bag not in stored and not _whole_bag(self.path / result.bag)
        ]

    def discard(self, indices: Iterable[int]) -> None:
        """Remove all bags of indices without a result; a crash left them."""
        wanted = {f"{index:05d}" for index in indices}
        for place in (*PLACES.values(), PARTIAL):
            for bag in (self.path / place).glob("*-*-*"):  # one listing, since a run may have very many bags
                if bag.name.rsplit("-", 2)[1] in wanted:  # the seed before the index may be the same number
                    shutil.rmtree(bag)

    def discard_episode(self, episode_id: str) -> None:
        """Remove all bags of an episode without a result; a crash left them."""
        for place in (*PLACES.values(), PARTIAL):
            shutil.rmtree(self.path / place / episode_id, ignore_errors=True)

    def append(self, result: EpisodeResult) -> None:
        """Append a finished result. It is on the disk when this returns.

        Raises:
            RoboximError: ``DISK`` when another folder has taken the place of the one that was opened.
        """
        try:
            about = self.path.stat()
        except OSError:
            about = None
        if self._locked is not None and (about is None or (about.st_dev, about.st_ino) != self._locked):
            raise RoboximError(
                f"{self.path} was moved, removed or replaced while the run wrote into it; put it back and run the same "
                "command again: it continues with the results that the folder has",
                ErrorCode.DISK,
            )
        self.log.append(self._key, to_plain(result))


@contextmanager
def locked(folder: Path, name: str = ".lock") -> Iterator[None]:
    """Lock a folder while the block runs.

    Raises:
        ConfigError: When another command holds the lock.
    """
    with open(folder / name, "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise ConfigError(f"another command is running in {folder}; wait for it or stop it") from None
        yield


def folders_with(name: str, folder: Path, deepest: int) -> Iterator[Path]:
    """Yield a folder and those below it, down to a level, that contain a file of a name; skip hidden folders."""
    for depth in range(deepest + 1):
        yield from (file.parent for file in sorted(folder.glob("/".join(["[!.]*"] * depth + [name]))))


def distinct_ends(folders: Sequence[Path]) -> list[str]:
    """Return the shortest ends of the folders' paths that distinguish them."""
    parts = [folder.resolve().parts for folder in folders]
    for length in range(1, max(map(len, parts), default=0) + 1):
        names = ["/".join(part[-length:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return [str(folder) for folder in folders]


def run_key(config: Mapping[str, Any]) -> str:
    """Return the hash of everything that a run's results depend on, 16 hexadecimal digits."""
    return digest({name: value for name, value in config.items() if name not in MAY_DIFFER})


def wanted_indices(config: Mapping[str, Any]) -> range:
    """Return the indices of the episodes that a run's configuration asks for; of a shard, its part."""
    return Shard.parse(config.get("shard", "")).indices(int(config.get("episodes", 0)))


def _whole_bag(bag: Path) -> bool:
    """Return whether a bag is there and none of its files is cut short: it would lack the format's last bytes."""
    files = list(bag.glob("*.mcap"))
    for path in files:
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - len(MCAP0_MAGIC)))
            if file.read() != MCAP0_MAGIC:
                return False
    return bool(files)


def require_bags(folder: RunFolder, results: Iterable[EpisodeResult]) -> None:
    """Refuse to continue a run whose bags have vanished or were cut short.

    Raises:
        RecorderError: ``BAG_DAMAGED``, naming them and what to do.
    """
    lost = folder.without_bag(results)
    if lost:
        names = ", ".join(result.bag for result in lost[:3]) + (f" and {len(lost) - 3} more" if len(lost) > 3 else "")
        raise RecorderError(
            f"{counted(len(lost), 'bag')} that {folder.log.path} names {'are' if len(lost) > 1 else 'is'} "
            f"gone or cut short: {names}; put them back, or run again with --repair or repair=True, which repeats "
            "these episodes",
            ErrorCode.BAG_DAMAGED,
        )


def checked_path(path: Path | str) -> Path:
    """Return an output path as an absolute path.

    Raises:
        ConfigError: When a name in it or the whole path is too long.
    """
    absolute = Path(os.path.abspath(expanded(path)))
    longest = max((len(os.fsencode(part)) for part in absolute.parts), default=0)
    if longest > LONGEST_NAME or len(os.fsencode(absolute)) > LONGEST_PATH or "\0" in str(path):
        raise ConfigError(
            f"'{str(path)[:40]}...' is not a valid folder: a name has at most {LONGEST_NAME} bytes and a path "
            f"{LONGEST_PATH}, this has {longest} and {len(os.fsencode(absolute))}; choose a shorter one"
        )
    return expanded(path).resolve()


def path_as_given(path: Path | str) -> Path:
    """Return an output path as it was given, for what is printed; only ``~`` is replaced by the user's home.

    Raises:
        ConfigError: As `checked_path`.
    """
    checked_path(path)
    return expanded(path)


def make_folder(path: Path) -> None:
    """Create an output folder unless it exists.

    Raises:
        ConfigError: When its name is too long.
        RoboximError: ``DISK`` when a file is in its place or it cannot be made.
    """
    checked_path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = "it is a file" if path.is_file() else error.strerror or str(error)
        raise RoboximError(
            f"cannot create the folder {path}: {reason}; choose another output folder (--out or out=)", ErrorCode.DISK
        ) from None
