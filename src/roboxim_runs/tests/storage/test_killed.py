"""Commands that are killed or stopped at any of their file operations: the same command ends with the same bytes."""

from __future__ import annotations

import os
import random
import signal
import sys
import tarfile
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.writer import MCAP0_MAGIC

from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError, RoboximError
from roboxim_core.plain_data.results_log import RESULTS_FILE
from roboxim_core.shards import Shard
from roboxim_runs.experiments.pack import pack, unpack
from roboxim_runs.storage.folder import RunFolder
from roboxim_runs.storage.merging import merge_shards
from roboxim_runs.storage.state import run_state

OPERATIONS = {"open", "os.rename", "os.link", "os.mkdir", "os.remove", "os.rmdir", "shutil.rmtree", "shutil.copytree"}
CONFIG = {"purpose": "eval", "episodes": 6, "run_seed": 0}
KILLS = 12


def shard(path: Path, number: int) -> Path:
    with RunFolder(path).opened({**CONFIG, "shard": f"{number}/2"}) as folder:
        for index in Shard.parse(f"{number}/2").indices(6):
            bag = f"episodes/eval-0-{index:05d}-0"
            (folder.path / bag).mkdir(parents=True)
            (folder.path / bag / "x_0.mcap").write_bytes(bag.encode() + MCAP0_MAGIC)
            folder.append(EpisodeResult(episode_id=Path(bag).name, index=index, outcome="success", bag=bag))
    return path


def experiment(path: Path) -> Path:
    path.mkdir()
    (path / "experiment.json").write_text("{}")
    for number in range(6):
        (path / f"part{number}").mkdir()
        (path / f"part{number}" / "text.txt").write_text(f"content {number}\n" * 100)
    return path


def content(place: Path) -> dict[str, bytes]:
    """Return every file below a folder, or in a pack."""
    if place.is_file():
        with tarfile.open(place) as archive:
            return {m.name: archive.extractfile(m).read() for m in archive if m.isfile()}  # type: ignore[union-attr]
    files = [path for path in sorted(place.rglob("*")) if path.is_file() and path.name != ".lock"]
    return {str(path.relative_to(place)): path.read_bytes() for path in files}


def child(work: Callable[[], object], number: int, blow: int) -> int:
    """Do work in a process that gets a signal at an operation on files; return its status, as of `os.waitpid`."""
    pid = os.fork()
    if pid == 0:  # pragma: no cover - another process
        left = [number]

        def hook(event: str, _: object) -> None:
            if event in OPERATIONS:
                left[0] -= 1
                if left[0] == 0:
                    os.kill(os.getpid(), blow)

        sys.addaudithook(hook)
        try:
            work()
        except BaseException:
            os._exit(2)
        os._exit(0 if left[0] <= 0 else 9)  # 9: it ended before the signal
    _, status = os.waitpid(pid, os.WUNTRACED)
    if os.WIFSTOPPED(status):
        os.kill(pid, signal.SIGCONT)
        _, status = os.waitpid(pid, 0)
    return status


JOBS: dict[str, tuple[Callable[[Path], object], Callable[[Path, Path], object]]] = {
    "merge": (
        lambda place: [shard(place / f"shard{n}", n) for n in (1, 2)],
        lambda place, out: merge_shards(out, [place / "shard1", place / "shard2"]),
    ),
    "pack": (lambda place: experiment(place / "x"), lambda place, out: pack(place / "x", out)),
    "unpack": (
        lambda place: pack(experiment(place / "x"), place / "x.tgz"),
        lambda place, out: unpack(place / "x.tgz", out),
    ),
}


@pytest.mark.thorough
@pytest.mark.parametrize("blow", [signal.SIGKILL, signal.SIGSTOP])
@pytest.mark.parametrize("name", JOBS)
def test_the_same_command_ends_a_killed_one_with_the_same_bytes(tmp_path: Path, name: str, blow: int) -> None:
    prepare, work = JOBS[name]
    source = tmp_path / "source"
    source.mkdir()
    prepare(source)
    (tmp_path / "whole").mkdir()
    work(source, tmp_path / "whole" / "out")
    whole = content(tmp_path / "whole" / "out")
    there = content(source) if source.is_dir() else {}
    rng, hits = random.Random(7), 0
    for attempt in range(KILLS):
        place = tmp_path / f"try{attempt}"
        place.mkdir()
        status = child(lambda place=place: work(source, place / "out"), rng.randint(1, 60), blow)  # type: ignore[misc]
        hits += os.WIFSIGNALED(status) or os.WEXITSTATUS(status) == 0
        if blow == signal.SIGKILL and os.WIFSIGNALED(status):
            assert not (place / "out").exists() or content(place / "out") == whole, "a part has the final name"
            if not (place / "out").exists():
                work(source, place / "out")
        assert content(place / "out") == whole
        left = {path.name for path in place.iterdir()} - {"out"}
        assert not left, f"attempt {attempt} left {left}"
        assert content(source) == there, "the source was changed"
    assert hits > KILLS // 3, "few were hit in mid-run"


@pytest.mark.parametrize("what", ["removed", "moved", "replaced"])
def test_a_folder_that_is_replaced_in_mid_run_ends_the_run_by_name(tmp_path: Path, what: str) -> None:
    run, first = tmp_path / "run", EpisodeResult(episode_id="eval-0-00000-0", index=0)
    with RunFolder(run).opened(CONFIG) as folder:
        folder.append(first)
        run.rename(tmp_path / "away")
        if what == "replaced":
            run.mkdir()
            (run / RESULTS_FILE).write_text("others'\n")
        with pytest.raises(RoboximError, match="moved, removed or replaced while the run wrote into it; put it back"):
            folder.append(EpisodeResult(episode_id="eval-0-00001-0", index=1))
        if what == "replaced":
            assert (run / RESULTS_FILE).read_text() == "others'\n", "nothing is written into another folder"
    if what != "removed":
        with RunFolder(tmp_path / "away").opened(CONFIG) as folder:
            assert folder.results() == [first]


def test_a_clock_that_goes_back_disturbs_no_run_and_no_estimate(tmp_path: Path) -> None:
    with RunFolder(tmp_path / "run").opened(CONFIG) as folder:
        folder.append(EpisodeResult(episode_id="eval-0-00000-0", index=0, wall_s=-5.0))
    lines = [
        '{"event":"run_started","time":"2031-01-01T00:00:00+00:00"}',
        '{"event":"stage_progress","done":1,"total":6,"time":"2031-01-01T00:00:10+00:00"}',
        '{"event":"stage_progress","done":2,"total":6,"time":"1999-01-01T00:00:00+00:00"}',
    ]
    (tmp_path / "run" / "events.jsonl").write_text("\n".join(lines) + "\n")
    for now_s in (0.0, 1e9, 4e9):
        try:
            state = run_state(tmp_path / "run", now_s)
        except ConfigError as error:
            pytest.fail(f"a clock that jumped is no damage: {error}")
        assert state.done == 1
        assert state.per_second is None or state.per_second >= 0
        assert state.left_s is None or state.left_s >= 0
