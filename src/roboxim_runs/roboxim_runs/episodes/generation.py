"""Generates demonstrations of a task with the expert; each becomes a bag in ``<out>/episodes``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ErrorCode, InvalidRequestError, RoboximError, UnavailableError, counted
from roboxim_core.limits import ATTEMPTS, require_range
from roboxim_core.shards import Shard
from roboxim_runs.episodes.pictures import write_contact_sheet
from roboxim_runs.episodes.run import EpisodesJob, not_played, run_environment, run_episodes
from roboxim_runs.episodes.task_choice import cells_of
from roboxim_runs.episodes_config import EpisodesConfig
from roboxim_runs.events import EpisodeFinished, Event, OnEvent, PictureWritten, ignore
from roboxim_runs.executors import Cancellation, Executor
from roboxim_runs.filmed import Episode
from roboxim_runs.storage.folder import RunFolder
from roboxim_runs.storage.store import readable_run

PICTURE = "first_demonstrations.png"
PICTURED = 4
"""Demonstrations in the picture."""


@dataclass(frozen=True, kw_only=True)
class GenerationConfig(EpisodesConfig):
    """Configuration of a generation."""

    out: Path | str = "runs/demos"
    """The run's folder."""
    usual: ClassVar[int] = 50
    max_attempts: int = 5
    """Largest number of attempts per index."""
    noise_mm: float = 3.0
    """Standard deviation of the noise in free motions, per axis and tick [mm]."""
    noise_mrad: float = 10.0
    """Standard deviation of the rotation noise, per axis and tick [mrad]."""
    noise_descents: float = 0.0
    """Share of this noise on descents, until 5 cm before a grasp and 3 cm before a place, 0..1."""
    first_try: bool = False
    """Whether to draw an index again if its demonstration needed a second grasp. Exports leave such demonstrations out,
    so that without this a dataset may have fewer episodes in some cells of a mix than in others."""

    def __post_init__(self) -> None:
        """Check the values that need no other file.

        Raises:
            ConfigError: As for every run of episodes.
            InvalidRequestError: On a number out of range, or a share of no noise.
        """
        super().__post_init__()
        require_range("max_attempts", self.max_attempts, 1, ATTEMPTS)
        require_range("noise_mm", self.noise_mm, 0, 1000)
        require_range("noise_mrad", self.noise_mrad, 0, 1000)
        require_range("noise_descents", self.noise_descents, 0, 1)
        if self.noise_descents and not (self.noise_mm or self.noise_mrad):
            raise InvalidRequestError(
                f"noise_descents {self.noise_descents:g} is a share of noise_mm and noise_mrad, which are both 0; set "
                "one of them, or leave noise_descents out"
            )

    def job(self) -> EpisodesJob:
        """Return the episodes to run.

        Raises:
            ConfigError: When the task or a number is wrong.
        """
        from roboxim_runs.scenes.definitions import definitions_of, task_files

        text = self.task_text()
        config = self.run_config(
            text, purpose="demo", actor="expert",
            keep="first_try" if self.first_try else "successful", max_attempts=self.max_attempts,
            noise_translation_m=self.noise_mm / 1000, noise_rotation_rad=self.noise_mrad / 1000,
            noise_descents=self.noise_descents,
        )  # fmt: skip
        return EpisodesJob(
            config=config, episodes=self.episodes, shard=Shard.parse(self.shard), workers=self.workers,
            renderer=self.renderer, store=self.store, definitions=definitions_of(cells_of(text), task_files(text)),
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class GenerationResult:
    """Result of a generation."""

    out: Path
    """The run's folder, as it was given."""
    results: tuple[EpisodeResult, ...]
    """Results of all requested episodes, in the order of their indices."""
    before: tuple[EpisodeResult, ...]
    """Results that the folder had before."""
    picture: Path | None
    """Picture of the first demonstrations; none without any."""

    @property
    def episodes(self) -> tuple[Episode, ...]:
        """The requested episodes, each with its bag and its film."""
        return tuple(Episode(policy="expert", result=result, folder=self.out) for result in self.results)

    @cached_property
    def kept(self) -> tuple[EpisodeResult, ...]:
        """The demonstrations."""
        return tuple(result for result in self.results if result.outcome == "success")

    @property
    def recovered(self) -> int:
        """Demonstrations that needed a second grasp."""
        return sum(result.recovered for result in self.kept)

    @property
    def summary(self) -> str:
        """Number of demonstrations, and how many of them existed before, in one line."""
        there = {result.episode_id: result for result in self.before}
        made = [result for result in self.results if there.get(result.episode_id) != result]
        indices = {result.index for result in self.results}
        more = sum(result.outcome == "success" for result in self.before if result.index not in indices)
        text = f"{counted(len(self.kept), 'demonstration')} in {self.out / 'episodes'}"
        notes = []
        if made and len(made) < len(self.results):
            notes.append(f"{len(self.results) - len(made)} of {len(self.results)} episodes existed before")
        if more:
            notes.append(f"{more} more in the folder, from an earlier run")
        retried = sum(result.attempt > 0 for result in self.kept)
        if retried:
            notes.append(f"{retried} after a failed attempt")
        if notes:
            text += f" ({'; '.join(notes)})"
        return text if made else f"{text}; all of them existed already, nothing was run"

    def require_any(self) -> None:
        """Refuse a result without any demonstration.

        Raises:
            RoboximError: ``TASK_FAULT``.
        """
        if not self.kept:
            reasons = sorted({result.reason for result in self.results})
            raise RoboximError(
                f"no demonstration succeeded ({', '.join(reasons)}); fix what the reasons name; then choose another "
                f"output folder (--out or out=) or remove this one (rm -r {self.out})",
                ErrorCode.TASK_FAULT,
            )


def generate(
    config: GenerationConfig,
    *,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
    executor: Executor | None = None,
) -> GenerationResult:
    """Generate the demonstrations that the folder lacks.

    An index whose episode fails is drawn again, so that the folder has as many demonstrations as requested. Failed
    attempts go to ``<out>/set_apart`` with their reasons.

    Args:
        config: Configuration of the generation.
        on_event: Receives the run's events.
        cancellation: Ends the run when it is set.
        executor: Runs the episodes; none: processes of this machine.

    Raises:
        CancelledError: When the run was cancelled.
        ConfigError: When the configuration is wrong, or the folder holds another run.
        RecorderError: ``BAG_DAMAGED`` when bags of earlier results have vanished.
        RoboximError: When a graph has a fault that a new worker does not recover from.
        UnavailableError: When all processes died at an episode.
    """
    config = config.sized(config.task_text(), on_event)
    job = config.job()
    out = Path(config.out)
    folder = RunFolder(out)
    before = () if config.repair else tuple(folder.results())
    picture = folder.path / PICTURE

    def show_first(event: Event) -> None:
        on_event(event)
        if not isinstance(event, EpisodeFinished) or picture.exists():
            return
        if event.result.outcome == "success" and event.result.bag:
            with readable_run(folder.path, [event.result.bag]) as run:
                written = write_contact_sheet([run / event.result.bag], picture)
            if written:
                on_event(PictureWritten(path=out / PICTURE))

    with run_environment("generate", out) as environment:
        results = run_episodes(
            job, "demonstrations", environment, on_event=show_first, cancellation=cancellation, executor=executor,
            repair=config.repair,
        )  # fmt: skip
    pictured = write_first_demonstrations(folder.path, results)
    made = GenerationResult(out=out, results=tuple(results), before=before, picture=out / PICTURE if pictured else None)
    if lost := not_played(results):
        raise UnavailableError(f"{made.summary}, but {lost}")
    return made


def write_first_demonstrations(folder: Path, results: Sequence[EpisodeResult]) -> bool:
    """Write the picture of a run's first demonstrations.

    Args:
        folder: The run's folder.
        results: Its results, in the order of their indices.

    Returns:
        Whether it was written: there is a demonstration, and it has cameras.
    """
    bags = [result.bag for result in results if result.outcome == "success" and result.bag][:PICTURED]
    with readable_run(folder, bags) as run:
        return write_contact_sheet([run / bag for bag in bags], folder / PICTURE)
