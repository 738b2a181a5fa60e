"""A folder in which a dataset is built, so that an interruption at any point loses no finished episode.

Beside the final place ``<name>`` stands ``.partial-<name>`` with:

- ``pieces/``: files of single episodes;
- ``journal.jsonl``: one line for each finished episode, appended after its pieces are whole;
- ``dataset/``: the dataset that is put together from the pieces at the end;
- ``replaced/``: the dataset that had the final name, while the new one takes it.

`ResumableBuild.finish` renames ``dataset/`` to the final name. So a dataset with its final name is complete, and a
killed build continues after its last finished episode. The pieces stay until then, and the journal goes before them.
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

from roboxim_core.errors import ConfigError, ErrorCode, RecorderError
from roboxim_core.whole_files import write_whole

Facts = dict[str, Any]
"""What the journal says of an episode: plain JSON values, with at least ``split``."""


@contextmanager
def only_build(path: Path) -> Iterator[None]:
    """Be the only build of a dataset while the block runs.

    Args:
        path: Final place of the dataset.

    Raises:
        ConfigError: When another process builds it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    place = path.with_name(f".partial-{path.name}.lock")
    with open(place, "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            locked = os.path.samestat(os.fstat(lock.fileno()), os.stat(place))
        except (BlockingIOError, FileNotFoundError):
            locked = False
        if not locked:  # another process has it, or has just removed it
            raise ConfigError(f"another command is writing {path}; wait for it or stop it")
        try:
            yield
        finally:
            place.unlink(missing_ok=True)


class ResumableBuild:
    """Builds one dataset; see the module."""

    def __init__(self, path: Path, *, identity: str, overwrite: bool, marker: str) -> None:
        """Start a build, or continue an interrupted one of the same identity.

        Args:
            path: Final place of the dataset, a file or a folder.
            identity: Distinguishes this build from others; empty: never continued.
            overwrite: Whether a dataset at the final place is replaced at the end.
            marker: File that a dataset of this format has, relative to ``path`` (empty: ``path`` is the file); a folder
                without it is never replaced.

        Raises:
            RecorderError: With code ``EXPORT_REFUSED`` when something stands at the final place that must stay.
        """
        self.path, self._overwrite, self._marker = path, overwrite, marker
        self._folder = partial_of(path)
        self._replaced = self._folder / "replaced"
        restore(path, self._replaced)
        self._require_place()
        self._journal = self._folder / "journal.jsonl"
        self.staged = self._folder / "dataset"
        """Where the dataset is put together: a folder or a file, like ``path``."""
        self.entries: list[Facts] = _entries(self._journal, identity) if identity else []
        """What the journal says of the finished episodes, in the order of their writing."""
        self._remove_staged()
        if not self.entries:
            self._remove_pieces()
        (self._folder / "pieces").mkdir(parents=True, exist_ok=True)
        lines = [{"identity": identity}, *self.entries]  # written again: the last line may be torn
        write_whole(self._journal, "".join(json.dumps(line) + "\n" for line in lines))

    def _require_place(self) -> None:
        path = self.path
        if not path.exists() or (path.is_dir() and not any(path.iterdir())):
            return
        if not (path / self._marker if self._marker else path).is_file():
            raise RecorderError(
                f"{path} exists and is not a dataset of this format; choose another folder", ErrorCode.EXPORT_REFUSED
            )
        if not self._overwrite:
            raise RecorderError(
                f"{path} exists; choose another folder, or replace it (--overwrite or overwrite=True)",
                ErrorCode.EXPORT_REFUSED,
            )

    def resumed(self, split: str) -> int:
        """Return the number of finished episodes of a split; an entry holds one, or ``episodes``."""
        return sum(entry.get("episodes", 1) for entry in self.entries if entry["split"] == split)

    def piece(self, split: str, number: int, name: str) -> Path:
        """Return the path of a piece of an episode.

        Args:
            split: Split of the episode.
            number: Number of the episode in its split, from 0.
            name: Name of the piece with its suffix.
        """
        return self._folder / "pieces" / f"{split}-{number:06d}-{name}"

    def commit(self, facts: Facts) -> None:
        """Note that the pieces of an episode are complete.

        Raises:
            OSError: When the disk is full.
        """
        with self._journal.open("a") as file:
            file.write(json.dumps(facts) + "\n")
        self.entries.append(facts)

    def split_entries(self) -> dict[str, list[Facts]]:
        """Return the finished episodes by split, in the order in which the splits were added.

        Raises:
            RecorderError: ``EXPORT_REFUSED`` when there is none.
        """
        if not self.entries:
            raise RecorderError("a dataset needs at least one episode; nothing was written", ErrorCode.EXPORT_REFUSED)
        names = dict.fromkeys(entry["split"] for entry in self.entries)
        return {name: [entry for entry in self.entries if entry["split"] == name] for name in names}

    def finish(self) -> None:
        """Move the dataset to its final place and remove the pieces."""
        replace_whole(self.staged, self.path, self._replaced)
        self._remove_pieces()

    def _remove_pieces(self) -> None:
        """Remove the build's folder; the journal goes first, because it says that the pieces are there."""
        self._journal.unlink(missing_ok=True)
        shutil.rmtree(self._folder, ignore_errors=True)

    def _remove_staged(self) -> None:
        if self.staged.is_dir():
            shutil.rmtree(self.staged)
        else:
            self.staged.unlink(missing_ok=True)


def partial_of(path: Path) -> Path:
    """Return the folder beside a dataset's final place in which it is built."""
    return path.with_name(f".partial-{path.name}")


def replace_whole(new: Path, place: Path, aside: Path) -> None:
    """Move a dataset to its final place; what is there is moved aside first. After a kill in between, see `restore`."""
    if place.exists():
        place.replace(aside)
    new.replace(place)


def restore(place: Path, aside: Path) -> None:
    """Put back what a killed `replace_whole` has moved aside, or remove it if the new dataset has its place."""
    if aside.exists() and not place.exists():
        aside.replace(place)
    elif aside.is_dir():
        shutil.rmtree(aside)
    else:
        aside.unlink(missing_ok=True)


def link(source: Path, target: Path) -> None:
    """Give a file a second name; copy it if the file system has no hard links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


def write_files(folder: Path, files: Mapping[str, str | bytes]) -> None:
    """Write files by their names relative to a folder."""
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)


def _entries(journal: Path, identity: str) -> list[Facts]:
    """Return the complete lines of a journal of this identity; a torn line and what follows it do not count."""
    found: list[Facts] = []
    if not journal.is_file():
        return found
    for number, line in enumerate(journal.read_text(errors="replace").splitlines(keepends=True)):
        try:
            facts = json.loads(line) if line.endswith("\n") else None
        except ValueError:
            facts = None
        if not isinstance(facts, dict) or (number == 0 and facts.get("identity") != identity):
            break
        if number:
            found.append(facts)
    return found
