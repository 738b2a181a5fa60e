"""What ``generate`` and ``evaluate`` share: episodes of a run on workers, resumable, with progress."""

from __future__ import annotations

import contextlib
import itertools
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from roboxim_bringup.graph import PolicyLaunch
from roboxim_bringup.progress import ProgressLine
from roboxim_bringup.run_folder import RunFolder
from roboxim_bringup.task_choice import task_text
from roboxim_bringup.workers import WORKER_DIED, Progress, WorkerPool
from roboxim_core.config import to_plain
from roboxim_core.episode import EpisodeResult, RunConfig
from roboxim_core.errors import ConfigError
from roboxim_sim.rendering import RENDERERS


@dataclass(frozen=True, kw_only=True)
class Job:
    """Episodes to run."""

    config: RunConfig
    """How; its ``output_dir`` is the run's folder."""
    episodes: int
    """How many."""
    workers: int = 1
    """Processes."""
    renderer: str = "raster"
    """Renderer of every worker's sim."""
    policies: tuple[PolicyLaunch, ...] = field(default=())
    """Policies that every worker serves."""
    policy_files: Mapping[str, str] = field(default_factory=dict)
    """What they are made of: file to its content's hash; see `roboxim_policies.identity`."""

    def __post_init__(self) -> None:
        """Check the renderer's name; whether it works here shows when a scene is loaded.

        Raises:
            ConfigError: When no renderer has the name.
        """
        RENDERERS[self.renderer]

    @property
    def looking_renderer(self) -> str:
        """Renderer by which scenes are found to show their objects: ``raster`` for all but a machine without GL.

        So a run has the same scenes whatever draws its images, unless that is ``tiny``.
        """
        return "tiny" if self.renderer == "tiny" else "raster"

    @property
    def identity(self) -> dict[str, Any]:
        """What the results depend on, as plain data."""
        config = to_plain(self.config)
        del config["output_dir"]
        return {
            **config,
            "episodes": self.episodes,
            "workers": self.workers,
            "renderer": self.renderer,
            "policies": [to_plain(launch) for launch in self.policies],
            **({"policy_files": dict(self.policy_files)} if self.policy_files else {}),
        }

    def done(self, results: Iterable[EpisodeResult]) -> dict[int, EpisodeResult]:
        """Return by index which of a folder's results are of this job and need no other try."""
        return {
            result.index: result for result in results if result.index < self.episodes and result.reason != WORKER_DIED
        }


@contextlib.contextmanager
def registered_run(kind: str) -> Iterator[None]:
    """Take a domain of its own for this process and make it known to other terminals."""
    from roboxim_ros.runs import activate_transport, free_domain, register_run

    activate_transport()
    with free_domain() as domain, register_run(kind, domain=domain) as run:
        run.join()
        yield


def run_job(
    job: Job, title: str, *, on_result: Callable[[EpisodeResult, ProgressLine], None] = lambda *_: None
) -> list[EpisodeResult]:
    """Run the episodes of a job that its folder does not have yet.

    Args:
        job: What to run.
        title: Title of the progress bar.
        on_result: Called with each new result.

    Returns:
        All results, in the order of their indices.

    Raises:
        ConfigError: When the folder holds another run.
        RoboximError: When a graph has a fault that a fresh worker does not cure.
    """
    with RunFolder(job.config.output_dir).opened(job.identity) as folder:
        done = job.done(folder.results())
        missing = [index for index in range(job.episodes) if index not in done]
        for index in missing:
            folder.discard(index)
        if missing:
            with (
                ProgressLine(title, job.episodes, len(done)) as bar,
                WorkerPool(
                    min(job.workers, len(missing)),
                    parameters={
                        "sim": {"renderer": job.renderer, "scene": ""},
                        "tasks": {"visible_renderer": job.looking_renderer},
                        "recorder": {"output_root": str(Path(job.config.output_dir).absolute())},
                    },
                    policies=job.policies,
                    log_dir=folder.path / "logs",
                ) as pool,
            ):
                bar.update(len(done), "starting")
                for result in pool.run(job.config, missing, on_progress=_reporter(bar), before_retry=folder.discard):
                    folder.append(result)
                    done[result.index] = result
                    bar.update(len(done), _tally(done.values()))
                    on_result(result, bar)
        return [done[index] for index in sorted(done)]


def _reporter(bar: ProgressLine) -> Callable[[Progress], None]:
    def report(progress: Progress) -> None:
        if progress.note:
            bar.say(progress.note)

    return report


def _tally(results: Any) -> str:
    outcomes = [result.outcome for result in results]
    return f"{outcomes.count('success')} of {len(outcomes)} succeeded"


def parse_size(text: str) -> tuple[int, int]:
    """Parse an image size: ``128`` or ``128x96`` (width x height), or ``as-configured`` (0, 0).

    Raises:
        ConfigError: When it is neither.
    """
    if text == "as-configured":
        return 0, 0
    found = re.fullmatch(r"(\d+)(?:x(\d+))?", text)
    if not found or not 16 <= int(found[1]) <= 4096 or not 16 <= int(found[2] or found[1]) <= 4096:
        raise ConfigError(f"an image size is SIZE or WIDTHxHEIGHT with 16 to 4096 px, got '{text}'")
    return int(found[1]), int(found[2] or found[1])


def film(bag: Path, every: int = 2) -> list[npt.NDArray[np.uint8]]:
    """Read a bag's frames, cameras side by side.

    Args:
        bag: The bag.
        every: Takes each so-manieth tick, and the last.

    Returns:
        Frames of shape (height, sum of widths, 3).
    """
    from roboxim_recorder.bag import BagReader

    reader = BagReader(bag)
    last = len(reader) - 1
    frames = []
    for tick in reader.ticks():
        if tick.seq % every == 0 or tick.seq == last:
            images = [tick.images[name] for name in sorted(tick.images)]
            height = min(image.shape[0] for image in images)
            frames.append(np.concatenate([image[:height] for image in images], axis=1))
    return frames


def drawn_by_name(bag: Path) -> dict[str, str]:
    """Return what the reset components of a bag's episode have drawn by name, e.g. the interaction area."""
    from roboxim_recorder.bag import BagReader

    return BagReader(bag).info.task.drawn


def contact_sheet(films: Sequence[Sequence[npt.NDArray[np.uint8]]], columns: int = 6) -> npt.NDArray[np.uint8]:
    """Put films under one another, each as a strip of frames from its start to its end.

    Args:
        films: Frames per film, all of one shape.
        columns: Frames per strip.
    """
    rows = []
    for frames in films:
        picks = np.linspace(0, len(frames) - 1, columns).round().astype(int)
        rows.append(np.concatenate([frames[i] for i in picks], axis=1))
    return np.concatenate(rows, axis=0)


def failures(results: Sequence[EpisodeResult]) -> Iterator[str]:
    """Say in a line each which episodes did not succeed, and why."""
    for result in itertools.islice((r for r in results if r.outcome != "success"), 10):
        yield f"  {result.episode_id}: {result.reason}" + (f": {result.message}" if result.message else "")


__all__ = [
    "Job",
    "contact_sheet",
    "failures",
    "film",
    "parse_size",
    "registered_run",
    "run_job",
    "task_text",
]
