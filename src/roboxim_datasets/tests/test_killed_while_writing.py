"""A writer that is killed at any step leaves the old or the new dataset whole; the same call completes it."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest

from roboxim_core.errors import RecorderError
from roboxim_datasets.build import ResumableBuild, link
from roboxim_datasets.formats import FORMATS, open_dataset

CHANGES = {"os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.truncate"}


class Killed(BaseException):
    """The process is gone: nothing that it would do afterwards happens."""


class Killer:
    """Counts the changes of files below a folder; from one of them on all fail, also those of cleaning up."""

    def __init__(self) -> None:
        self.folder, self.left, self.watching = "", 0, False
        sys.addaudithook(self._hook)

    def _hook(self, event: str, args: tuple) -> None:
        if not self.watching or not (event in CHANGES or (event == "open" and args[2] & (os.O_WRONLY | os.O_RDWR))):
            return
        named = str(args[0])
        if os.path.isabs(named) and not named.startswith(self.folder):
            return
        self.left -= 1
        if self.left < 0:
            raise Killed

    @contextmanager
    def after(self, changes: int, folder: Path) -> Iterator[None]:
        self.left, self.folder, self.watching = changes, str(folder), True
        try:
            yield
        finally:
            self.watching = False


@pytest.fixture(scope="module")
def killer() -> Killer:
    return Killer()


@pytest.fixture
def write(episode_of, description) -> Callable[..., None]:
    """Writes a dataset of episodes, or goes on with it: ``write(format, folder, 1, 2)``."""

    def make(format: str, folder: Path, *numbers: int, overwrite: bool = True) -> None:
        made, options = FORMATS[format](), {"lerobot": {"images": True}, "rlds": {"shard_mib": 1}}
        settings = made.options(**options.get(format, {}))
        with made.create(folder, description, settings, identity=str(numbers), overwrite=overwrite) as writer:
            for number in numbers[writer.resumed("train") :]:
                writer.add("train", episode_of(number, length=2))
            writer.complete({"export.json": "{}"})

    return make


def ids(folder: Path) -> list[str]:
    return [episode.episode_id for episode in open_dataset(folder).episodes() if list(episode.steps())]


def require_whole_after_every_kill(
    killer: Killer, folder: Path, write: Callable[..., None], ids: Callable[[Path], list[str]]
) -> None:
    """Kill a writer of episodes 1 and 2 over a dataset of episode 0 at each of its steps, and let it go on."""
    old, new = ["demo-0"], ["demo-1", "demo-2"]
    for changes in range(1000):
        path = folder / str(changes) / "set"
        write(path, 0)
        try:
            with killer.after(changes, folder):
                write(path, 1, 2)
            break
        except Killed:
            pass
        with pytest.raises(RecorderError, match="exists"):  # another dataset never takes its place unasked
            write(path, 3, overwrite=False)
        assert ids(path) in (old, new), f"after {changes} changes"
        write(path, 1, 2)
        assert ids(path) == new, f"after {changes} changes"
        assert not list(path.parent.rglob(".partial-*")), f"after {changes} changes"
    assert changes > 10
    assert ids(path) == new


def test_a_build_that_is_killed_at_any_step(tmp_path, killer):
    def write(path: Path, *numbers: int, overwrite: bool = True) -> None:
        path.parent.mkdir(exist_ok=True)
        build = ResumableBuild(path, identity=str(numbers), overwrite=overwrite, marker="1.txt")
        for number in numbers[build.resumed("train") :]:
            build.piece("train", number, "demo").write_text(f"demo-{number}")
            build.commit({"split": "train", "number": number})
        build.staged.mkdir()
        for place, entry in enumerate(build.split_entries()["train"], start=1):
            link(build.piece("train", entry["number"], "demo"), build.staged / f"{place}.txt")
        build.finish()

    require_whole_after_every_kill(
        killer, tmp_path, write, lambda path: [file.read_text() for file in sorted(path.iterdir())]
    )


@pytest.mark.thorough
@pytest.mark.parametrize("format", ["rlds", "hdf5", "lerobot"])
def test_a_writer_of_a_format_that_is_killed_at_any_step(format, tmp_path, killer, write):
    require_whole_after_every_kill(killer, tmp_path, partial(write, format), ids)
