"""The replay gate: a dataset's own actions, executed again, must still solve its tasks.

A dataset can load without an error although its actions no longer solve the task, e.g. after rounding, a change of
representation or a lower rate. The gate takes the actions as a trainer reads them, converts them back, and executes
them in the simulator from each episode's restored scene. Two streams are executed:

- the *executed* actions (``sim.action_executed``). They contain the noise of the demonstrations and must reproduce the
  episode. At the recorded rate, end-effector actions must retain every success.
- the *labels* alone. Labels correct the noise that preceded them and lead elsewhere without it, so their result is
  binding only for episodes without noise.

Bags hold the scenes. They are found by episode id and by the hash of the final state.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from roboxim_core.actions import ActionArray
from roboxim_core.config import from_plain, to_plain
from roboxim_core.conventions import Convention
from roboxim_core.errors import ConfigError, counted
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import distance
from roboxim_core.state import StateRecord
from roboxim_datasets.dataset import Dataset
from roboxim_datasets.episode import Episode
from roboxim_datasets.formats import open_dataset
from roboxim_recorder.bag import BagReader
from roboxim_runs.datasets.action_decoding import ActionDecoder, dataset_convention
from roboxim_runs.datasets.bag_finder import BagFinder
from roboxim_runs.episodes.reexecution import execute
from roboxim_runs.events import OnEvent, Reporter, ignore
from roboxim_runs.executors import Cancellation, Executor, Job, Work, run_required
from roboxim_sim.world import World

REQUIRED = 0.95
"""Part of the successes that an export must retain."""
APART_M = 1e-3
"""A replay farther from the recording than this has diverged [m]."""
Stream = Literal["executed", "labels"]


@dataclass(frozen=True, kw_only=True)
class StreamReplay:
    """One stream of an episode's actions, executed."""

    success: bool
    """Whether the task was solved."""
    reason: str
    """Why it was not; empty on success."""
    steps: int
    """Actions executed."""
    tcp_error_m: tuple[float, ...]
    """Distance of the measured tool centre point from the recorded one after each action [m]."""
    apart_at: int = -1
    """First tick that is more than `APART_M` from the recording; -1: none."""
    exact: bool = False
    """Whether every state is the recorded one, bit for bit."""


@dataclass(frozen=True, kw_only=True)
class EpisodeReplay:
    """One episode of a dataset, replayed."""

    split: str
    """Split."""
    index: int
    """Number in the split."""
    episode_id: str
    """Its id; empty: the dataset has none."""
    problem: str = ""
    """Why it could not be replayed; empty: it was."""
    recorded_success: bool = False
    """Whether the recorded episode is a success."""
    lossless: bool = False
    """Whether the actions can reproduce the episode exactly: end effector, at the recorded rate."""
    noise_free: bool = False
    """Whether the bag says that no noise was injected, so that labels and executed actions should be the same."""
    executed: StreamReplay | None = None
    """The executed actions; None: the dataset has none."""
    labels: StreamReplay | None = None
    """The labels; None: not requested."""
    changed: tuple[str, ...] = ()
    """Models that have changed since the recording."""

    def stream(self, name: Stream) -> StreamReplay | None:
        """Return a stream by its name."""
        return self.executed if name == "executed" else self.labels


@dataclass(frozen=True, kw_only=True)
class Retained:
    """What of the recorded successes a stream retains."""

    successes: int
    """Recorded successes that the replay solves again."""
    of: int
    """Recorded successes that were replayed."""

    @property
    def fraction(self) -> float:
        """Part retained; 1 when there was nothing to retain."""
        return self.successes / self.of if self.of else 1.0

    def __str__(self) -> str:
        """Readable counts."""
        return f"{self.successes} of {self.of} successes ({100 * self.fraction:.1f} %)"


@dataclass(frozen=True, kw_only=True)
class ReplayReport:
    """Result of a replay."""

    path: Path
    """The dataset."""
    format: str
    """Its format."""
    episodes: tuple[EpisodeReplay, ...]
    """The episodes, in the order of the dataset."""

    def retained(self, stream: Stream, *, noise_free: bool = False) -> Retained:
        """Count the successes that a stream retains.

        Args:
            stream: The stream.
            noise_free: Whether to count the episodes without noise only.
        """
        solved = [replay.success for _, replay in self._successes(stream, noise_free)]
        return Retained(successes=sum(solved), of=len(solved))

    def tcp_error_m(self, stream: Stream) -> dict[str, float]:
        """Return median, 95th percentile and maximum of a stream's distances over all ticks [m]; empty: no ticks."""
        errors = [error for episode in self.episodes for error in getattr(episode.stream(stream), "tcp_error_m", ())]
        if not errors:
            return {}
        return {"median": float(np.median(errors)), "p95": float(np.quantile(errors, 0.95)), "max": max(errors)}

    def failed(self, stream: Stream, *, noise_free: bool = False) -> list[EpisodeReplay]:
        """Return the recorded successes that a stream does not solve again, in the order of the dataset.

        Args:
            stream: The stream.
            noise_free: Whether to return episodes without noise only.
        """
        return [episode for episode, replay in self._successes(stream, noise_free) if not replay.success]

    def _successes(self, stream: Stream, noise_free: bool) -> Iterator[tuple[EpisodeReplay, StreamReplay]]:
        for episode in self.episodes:
            replay = episode.stream(stream)
            if replay is not None and episode.recorded_success and (episode.noise_free or not noise_free):
                yield episode, replay

    @cached_property
    def required(self) -> float:
        """Part of the successes that must be retained: all, if the actions can reproduce every episode exactly."""
        replayed = [episode for episode in self.episodes if not episode.problem]
        return 1.0 if all(episode.lossless for episode in replayed) else REQUIRED

    @cached_property
    def refusal(self) -> str:
        """Why the dataset does not pass the gate; empty: it passes."""
        problems = [episode for episode in self.episodes if episode.problem]
        if problems:
            first = problems[0]
            return (
                f"{counted(len(problems), 'episode')} could not be replayed, first {first.episode_id}: {first.problem}"
            )
        if any(episode.executed is None for episode in self.episodes):
            return "it holds no executed actions (sim.action_executed); export the bags again"
        streams: tuple[tuple[Stream, bool, str], ...] = (
            ("executed", False, "the executed actions retain"),
            ("labels", True, "the labels of the episodes without noise retain"),
        )
        for stream, noise_free, what in streams:
            retained = self.retained(stream, noise_free=noise_free)
            if retained.fraction < self.required:
                failure = _shown(self.failed(stream, noise_free=noise_free)[0], stream)
                return f"{what} {retained}, required are {100 * self.required:.0f} %; first: {failure}"
        return ""

    @property
    def lines(self) -> Iterator[str]:
        """Readable report."""
        yield f"{self.path} ({self.format}): {counted(len(self.episodes), 'episode')} replayed"
        names: tuple[tuple[Stream, str], ...] = (("executed", "executed actions"), ("labels", "labels alone"))
        for stream, name in names:
            replays = [replay for episode in self.episodes if (replay := episode.stream(stream)) is not None]
            if not replays:
                continue
            error = self.tcp_error_m(stream)
            shown = ", ".join(f"{key} {1e3 * value:.3g}" for key, value in error.items())
            exact = sum(replay.exact for replay in replays)
            yield f"  {name}: {self.retained(stream)} retained; {exact} of {len(replays)} bit for bit"
            yield f"    distance of the tool centre point from the recording [mm]: {shown or 'no ticks'}"
            if stream == "labels":
                noise_free = self.retained("labels", noise_free=True)
                required = f"{noise_free} retained" if noise_free.of else "none here, so nothing is required"
                yield f"    required only of episodes without injected noise: {required}"
            if failed := self.failed(stream):
                yield f"    first failure: {_shown(failed[0], stream)}"
        for episode in self.episodes:
            if episode.problem:
                yield f"  {episode.split}/{episode.index} {episode.episode_id}: {episode.problem}"
        if changed := sorted({model for episode in self.episodes for model in episode.changed}):
            yield f"  changed since the recording: the files of {', '.join(changed)}"
        yield f"  {'REFUSED: ' + self.refusal if self.refusal else 'passed'}"

    def to_json(self) -> str:
        """Return the report as JSON text, with every episode and tick."""
        facts: dict[str, Any] = {"format": self.format, "passed": not self.refusal, "refusal": self.refusal}
        facts["required"] = self.required
        for stream in ("executed", "labels"):
            retained = self.retained(stream)
            facts[stream] = {"retained": retained.successes, "of": retained.of, "tcp_error_m": self.tcp_error_m(stream)}
        facts["episodes"] = [to_plain(episode) for episode in self.episodes]
        return json.dumps(facts, indent=1) + "\n"


def _shown(episode: EpisodeReplay, stream: Stream) -> str:
    replay = episode.stream(stream)
    assert replay is not None
    where = f", {APART_M * 1e3:g} mm from the recording at tick {replay.apart_at}" if replay.apart_at >= 0 else ""
    return f"{episode.episode_id} ({replay.reason}{where})"


# ------------------------------------------------------------------ one episode


def replay_episode(
    episode: Episode,
    bag: BagReader,
    world: World,
    *,
    labels: bool = True,
    convention: Convention | None = None,
    library: ModelLibrary | None = None,
) -> EpisodeReplay:
    """Execute a dataset's episode from its bag's scene.

    Args:
        episode: The episode, as a trainer reads it.
        bag: The bag that it was exported from.
        world: The simulator's world, held by no episode.
        labels: Whether to execute the labels too.
        convention: What the actions mean if the episode does not say it; see `dataset_convention`.
        library: Models, to name those that have changed; None: RoboXim's own.

    Raises:
        InvalidRequestError: When the actions cannot be converted to those that the simulator executes.
        RecorderError: When episode or bag is damaged.
    """
    steps = list(episode.steps(()))
    given = np.stack([step.action for step in steps])
    done = [step.action_executed for step in steps]
    executed = None if any(action is None for action in done) else np.stack([a for a in done if a is not None])
    replayer = _Replayer(episode, bag, world, convention)
    first = None if executed is None else replayer.run(executed)
    again = first if executed is not None and np.array_equal(given, executed) else None
    return EpisodeReplay(
        split="",
        index=0,
        episode_id=episode.episode_id,
        recorded_success=bag.result.outcome == "success",
        lossless=replayer.lossless,
        noise_free=replayer.noise_free,
        executed=first,
        labels=(again or replayer.run(given)) if labels or executed is None else None,
        changed=tuple((library or ModelLibrary()).changed(bag.info.models)),
    )


class _Replayer:
    """Executes action streams of one episode."""

    def __init__(self, episode: Episode, bag: BagReader, world: World, convention: Convention | None) -> None:
        info = bag.info
        self._info, self._world = info, world
        self._decoder = ActionDecoder(episode, info.scene, convention)
        self._scene = replace(info.scene, control_rate_hz=self._decoder.rate_hz)
        self._ratio = info.scene.control_rate_hz / self._decoder.rate_hz
        self.lossless = not self._decoder.semantics.control.is_joint_space and self._ratio == 1
        ticks = list(bag.ticks(cameras=()))
        self._recorded = [tick.state for tick in ticks]
        self.noise_free = not any(tick.step.disturbance for tick in ticks)

    def run(self, actions: np.ndarray) -> StreamReplay:
        """Execute actions, shape (T, D)."""
        errors: list[float] = []
        apart_at, exact = -1, self._ratio == 1
        decode = self._decoder.start()

        def following(state: StateRecord) -> ActionArray | None:
            return decode(actions[state.seq], state) if state.seq < len(actions) else None

        def compare(state: StateRecord) -> None:
            nonlocal apart_at, exact
            at = state.seq * self._ratio
            if state.seq == 0 or at != round(at) or at >= len(self._recorded):
                return
            recorded = self._recorded[round(at)]
            exact = exact and state.state_hash == recorded.state_hash
            metres, _ = distance(state.robot.pose_tcp_measured, recorded.robot.pose_tcp_measured)
            errors.append(metres)
            if metres > APART_M and apart_at < 0:
                apart_at = state.seq

        execution = execute(
            self._world, self._info.episode_id, self._info.task, self._scene, following,
            semantics=self._decoder.executed, on_state=compare,
        )  # fmt: skip
        return StreamReplay(
            success=execution.success, reason=execution.reason, steps=execution.steps, tcp_error_m=tuple(errors),
            apart_at=apart_at, exact=exact and execution.steps == len(actions),
        )  # fmt: skip


# ------------------------------------------------------------------ a dataset


class ReplayWorker:
    """Replays one episode per job; see `roboxim_runs.executors`."""

    def __init__(self, settings: Mapping[str, Any], number: int) -> None:
        """Open the dataset and make the simulator.

        Args:
            settings: ``dataset``, its path; ``format``; ``labels``, whether to execute the labels too.
            number: The worker's number.
        """
        self._dataset = open_dataset(settings["dataset"], format=settings["format"])
        self._convention = dataset_convention(_folder(self._dataset))
        self._labels = bool(settings["labels"])
        self._library = ModelLibrary()
        self._world = World(self._library)

    def run(self, job: Mapping[str, Any], note: Callable[[Any], None]) -> dict[str, Any]:
        """Replay an episode: ``split``, ``index`` and ``bag``."""
        episode = self._dataset.read(job["split"], job["index"])
        found = replay_episode(
            episode, BagReader(job["bag"]), self._world, labels=self._labels,
            convention=self._convention, library=self._library,
        )  # fmt: skip
        plain: dict[str, Any] = to_plain(replace(found, split=job["split"], index=job["index"]))
        return plain

    def close(self) -> None:
        """Disconnect from the physics server."""
        self._world.close()


def _folder(dataset: Dataset) -> Path:
    return dataset.path if dataset.path.is_dir() else dataset.path.parent


def replay_dataset(
    path: Path | str,
    bags: Sequence[Path | str] = (),
    *,
    format: str = "",
    episodes: int = 0,
    labels: bool = True,
    workers: int = 1,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
    executor: Executor | None = None,
) -> ReplayReport:
    """Execute a dataset's actions again and report what of its successes remains.

    Args:
        path: The dataset, of any registered format.
        bags: Runs, folders of bags or bags that it was exported from; none: the runs beside the dataset and beside the
            folders above it are searched.
        format: Name of the format; empty: found from the files.
        episodes: Number of episodes to replay, spread evenly; 0: all.
        labels: Whether to execute the labels too.
        workers: Processes; 1: this process.
        on_event: Receives the run's events.
        cancellation: Ends the run when it is set.
        executor: Replays the episodes; none: the local one.

    Raises:
        CancelledError: When the run was cancelled.
        ConfigError: When there is no dataset, or it is of no known format.
        RoboximError: When dataset or bags are damaged, or workers die.
    """
    dataset = open_dataset(path, format=format)
    numbers = spread(len(dataset), episodes)
    finder = BagFinder(dataset.path, [Path(place) for place in bags])
    found: dict[int, EpisodeReplay] = {}
    jobs = []
    reporter = Reporter(on_event, cancellation)
    with reporter.resumable("a replay writes nothing; start it again"):
        for number in numbers:
            split, index = dataset.place(number)
            episode = dataset.episode(number)
            bag, problem = finder.find(episode)
            if bag is None:
                found[number] = EpisodeReplay(split=split, index=index, episode_id=episode.episode_id, problem=problem)
            else:
                data = {"split": split, "index": index, "bag": str(bag.resolve())}
                jobs.append(Job(key=str(number), data=data))
        work = Work(
            worker="roboxim_runs.datasets.replay_gate:ReplayWorker",
            settings={"dataset": str(dataset.path.resolve()), "format": dataset.format, "labels": labels},
        )
        with reporter.stage("replaying", len(numbers), "episodes", len(found)) as progress:
            for replayed in run_required(
                work, jobs, lost="episode {} was not replayed", executor=executor, workers=workers,
                on_note=lambda note: reporter.notice(note.text), cancellation=cancellation,
            ):  # fmt: skip
                found[int(replayed.key)] = from_plain(replayed.value, EpisodeReplay)
                progress(len(found))
    return ReplayReport(
        path=dataset.path, format=dataset.format, episodes=tuple(found[number] for number in sorted(found))
    )


def spread(total: int, wanted: int) -> list[int]:
    """Return ``wanted`` of the numbers below ``total``, spread evenly; all if ``wanted`` is 0 or not smaller."""
    if wanted < 0:
        raise ConfigError(f"the number of episodes must be 0 (all) or more, got {wanted}")
    if not wanted or wanted >= total:
        return list(range(total))
    return [math.floor((k + 0.5) * total / wanted) for k in range(wanted)]
