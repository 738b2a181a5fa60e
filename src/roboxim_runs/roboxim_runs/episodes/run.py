"""Episodes of a run on workers, resumable; shared by generation and evaluation."""

from __future__ import annotations

import contextlib
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from roboxim_bringup.graph import GraphConfig, PolicyLaunch
from roboxim_core.config import from_plain, to_plain
from roboxim_core.episode import EpisodeResult, RunConfig, episode_id
from roboxim_core.episode.records import WORKER_DIED
from roboxim_core.seeds import SeedPath
from roboxim_core.shards import Shard
from roboxim_policies.identity import location_free
from roboxim_runs.episodes.staging import clear_staging, take_over
from roboxim_runs.events import EpisodeFinished, OnEvent, Reporter, ignore
from roboxim_runs.executors import Cancellation, Done, Executor, LocalExecutor, Lost, Note, Work
from roboxim_runs.executors import Job as ExecutorJob
from roboxim_runs.executors.protocol import Prepare, unchanged
from roboxim_runs.policies.waiting import SERVER_WAIT_S, Waiting
from roboxim_runs.storage.event_log import EVENTS_FILE, logged
from roboxim_runs.storage.folder import RunFolder, require_bags
from roboxim_runs.storage.upload import RunUpload
from roboxim_sim.rendering import RENDERERS

TIDY = {"zero", "random", "replay", "bc", "roboxim_runs.policies.planted:PlantedPolicy"}
"""Policies that keep everything in their instance, so that another one may follow in the same process."""


@dataclass(frozen=True, kw_only=True)
class EpisodesJob:
    """Episodes to run."""

    config: RunConfig
    """The episode loop's configuration; its ``output_dir`` is the run's folder."""
    episodes: int
    """Number of episodes of the whole run."""
    shard: Shard = Shard()
    """Part of it to run."""
    workers: int = 1
    """Processes."""
    renderer: str = "raster"
    """Renderer of every worker's sim."""
    policies: tuple[PolicyLaunch, ...] = field(default=())
    """Policies that every worker serves."""
    policy_files: Mapping[str, str] = field(default_factory=dict)
    """Files that define the policies, each with its content's hash; see `roboxim_policies.identity`."""
    definitions: Mapping[str, str] = field(default_factory=dict)
    """Files that the task names, each with its content's hash; see `roboxim_runs.scenes.definitions`."""
    server: Mapping[str, Any] = field(default_factory=dict)
    """What identifies the server of a remote policy; see `roboxim_runs.policies.server_records`."""
    store: str = ""
    """URL that the bags and the results go to, see `roboxim_runs.storage.store`; empty: bags stay in the folder."""
    server_wait_s: float = SERVER_WAIT_S
    """Longest wait for a policy's server that is away [s]; see `roboxim_runs.policies.waiting`."""

    def __post_init__(self) -> None:
        """Check the renderer's name. Whether the renderer works here shows only when a scene is loaded.

        Raises:
            ConfigError: When no renderer has the name.
        """
        RENDERERS[self.renderer]

    @property
    def indices(self) -> range:
        """Indices of the episodes to run."""
        return self.shard.indices(self.episodes)

    @property
    def looking_renderer(self) -> str:
        """Renderer of the visibility check: ``tiny`` if it draws the images (no GL), else ``raster``.

        A run thus has the same scenes with every renderer but ``tiny``.
        """
        return "tiny" if self.renderer == "tiny" else "raster"

    @property
    def identity(self) -> dict[str, Any]:
        """Everything that the results depend on, as plain data."""
        config = to_plain(self.config)
        del config["output_dir"]
        return {
            **config,
            "episodes": self.episodes,
            "workers": self.workers,
            **({"shard": str(self.shard)} if str(self.shard) else {}),
            **({"store": self.store} if self.store else {}),
            "renderer": self.renderer,
            "policies": [to_plain(replace(one, **location_free(one.spec, one.options))) for one in self.policies],
            **({"policy_files": dict(self.policy_files)} if self.policy_files else {}),
            **({"definitions": dict(self.definitions)} if self.definitions else {}),
            **self.server,
        }

    @property
    def upload(self) -> RunUpload:
        """Uploads the files of the job's run."""
        return RunUpload(Path(self.config.output_dir), self.store, shard=str(self.shard))

    def done(self, results: Iterable[EpisodeResult]) -> dict[int, EpisodeResult]:
        """Return, by index, a folder's results that belong to this job and need no further attempt."""
        return {result.index: result for result in results if result.index in self.indices and result.played}

    def work(self, environment: Mapping[str, str], *, staged: bool = False) -> Work:
        """Return the workers' work.

        Args:
            environment: Environment variables by which a process takes part in the run.
            staged: Whether each worker records into its own folder; see `roboxim_runs.episodes.staging`.
        """
        parameters: dict[str, dict[str, Any]] = {
            "sim": {"renderer": self.renderer, "scene": "", "publish_unheard": False},
            "tasks": {"visible_renderer": self.looking_renderer},
            "recorder": {"output_root": str(Path(self.config.output_dir).absolute())},
        }
        staging = {"store": self.store} if staged or self.store else None
        graph = GraphConfig(parameters=parameters, policies=self.policies)
        return episodes_work(graph, self.config, environment, staging=staging, server_wait_s=self.server_wait_s)


def episodes_work(
    graph: GraphConfig,
    config: RunConfig,
    environment: Mapping[str, str],
    *,
    staging: Mapping[str, str] | None = None,
    server_wait_s: float = SERVER_WAIT_S,
) -> Work:
    """Return the work of processes that run episodes, each with its own graph. A job's data is an index.

    Args:
        graph: Graph that each process starts; ``/w<number>`` replaces its namespace.
        config: Configuration of the episode loop.
        environment: Environment variables by which a process takes part in the run.
        staging: Where each worker records, see `roboxim_runs.episodes.staging`; none: in the run's folder.
        server_wait_s: Longest wait for a policy's server that is away [s].
    """
    return Work(
        worker="roboxim_runs.episodes.worker:EpisodeWorker",
        settings={
            "graph": to_plain(graph),
            "config": to_plain(config),
            "server_wait_s": server_wait_s,
            **({} if staging is None else {"staging": dict(staging)}),
        },
        environment=dict(environment),
        leaves_nothing=all(map(_leaves_nothing, graph.policies)),
    )


def _leaves_nothing(launch: PolicyLaunch) -> bool:
    return (launch.options["policy"] if launch.spec == "reworded" else launch.spec) in TIDY


@contextlib.contextmanager
def run_environment(kind: str, out: Path | str = "") -> Iterator[dict[str, str]]:
    """Reserve a ROS domain for a run and register the run for other terminals.

    The calling process runs no episode, so its environment stays unchanged.

    Args:
        kind: Kind of the run, e.g. ``generate``.
        out: Folder of the run, for `roboxim runs`.

    Yields:
        Environment variables by which a worker takes part.

    Raises:
        ConfigError: When ``ROBOXIM_TRANSPORT`` is neither ``loopback`` nor ``network``.
        UnavailableError: When no domain is free.
    """
    from roboxim_ros.runs import activate_transport, free_domain, register_run

    before = dict(os.environ)
    try:
        activate_transport()
        with free_domain() as domain, register_run(kind, domain=domain, folder=out) as run:
            _set_environment(before)
            yield run.environment
    finally:
        _set_environment(before)


def _set_environment(wanted: Mapping[str, str]) -> None:
    for name in set(os.environ) - set(wanted):
        del os.environ[name]
    os.environ.update(wanted)


def run_episodes(
    job: EpisodesJob,
    title: str,
    environment: Mapping[str, str],
    *,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
    executor: Executor | None = None,
    repair: bool = False,
    prepare: Prepare = unchanged,
) -> list[EpisodeResult]:
    """Run the episodes of a job that are missing in its folder.

    Args:
        job: Episodes to run.
        title: Title of the stage.
        environment: See `run_environment`.
        on_event: Receives the run's events.
        cancellation: Ends the run when it is set.
        executor: Runs the episodes; none: processes of this machine.
        repair: Repeat episodes that are lost or damaged.
        prepare: See `Executor.run`.

    Returns:
        All results of the job's shard, in the order of their indices.

    Raises:
        CancelledError: When the run was cancelled.
        ConfigError: When the folder or the store holds another run.
        RecorderError: ``BAG_DAMAGED`` when bags of earlier results have vanished.
        RoboximError: When a graph has a fault that a new worker does not recover from.
    """
    folder = RunFolder(job.config.output_dir)
    with Reporter(on_event).resumable(lambda: _describe_progress(folder)), folder.opened(job.identity, repair=repair):
        upload = job.upload
        upload.require_own(job.identity, repair=repair)
        done = _finished(job, folder, repair)
        missing = [index for index in job.indices if index not in done]
        upload.all()  # at once, so that no other run takes the store; and in case that an earlier run did not end
        if not missing:
            return [done[index] for index in sorted(done)]
        folder.discard(missing)
        clear_staging(folder)
        executor = executor or LocalExecutor(job.workers, log_dir=folder.path / "logs")
        total = len(job.indices)
        facts = {"title": title, "executor": type(executor).__name__.removesuffix("Executor").lower()}
        outcomes = Counter(result.outcome for result in done.values())
        with logged(folder.path / EVENTS_FILE, on_event, **facts, workers=job.workers, total=total) as report:
            reporter = Reporter(report)
            with reporter.stage(title, total, done=len(done)) as progress:
                progress(len(done), note="starting")
                for result in _results(executor, job, missing, environment, folder, reporter, cancellation, prepare):
                    folder.append(result)
                    upload.now_and_then()
                    done[result.index] = result
                    outcomes[result.outcome] += result.played
                    progress(len(done), note=f"{outcomes['success']} of {outcomes.total()} succeeded")
                    report(EpisodeFinished(folder=folder.path, result=result))
                upload.all()
        clear_staging(folder)
        return [done[index] for index in sorted(done)]


def _finished(job: EpisodesJob, folder: RunFolder, repair: bool) -> dict[int, EpisodeResult]:
    """Return the finished results, and refuse them when bags have vanished."""
    done = job.done(folder.results())
    if not repair:
        require_bags(folder, done.values())
        return done
    lost = {result.index for result in folder.without_bag(done.values())}
    return {index: result for index, result in done.items() if index not in lost}


def _results(
    executor: Executor,
    job: EpisodesJob,
    indices: Sequence[int],
    environment: Mapping[str, str],
    folder: RunFolder,
    reporter: Reporter,
    cancellation: Cancellation | None,
    prepare: Prepare,
) -> Iterator[EpisodeResult]:
    waiting = Waiting()

    def receive(note: Note) -> None:
        for text in (note.text, waiting.notice(note)):
            reporter.notice(text)

    staged = bool(getattr(executor, "staged", False)) or bool(job.store)
    outcomes = executor.run(
        job.work(environment, staged=staged), episode_jobs(indices), on_note=receive,
        before_retry=lambda key: folder.discard([index_of(key)]), cancellation=cancellation, prepare=prepare,
    )  # fmt: skip
    for outcome in outcomes:
        if staged and isinstance(outcome, Done):
            result = from_plain(outcome.value["result"], EpisodeResult, source="a worker's result")
            take_over(folder, result, outcome.value)
            yield result
        else:
            yield episode_result(outcome, job.config)


def episode_jobs(indices: Iterable[int]) -> list[ExecutorJob]:
    """Return the jobs for the given indices."""
    return [ExecutorJob(key=f"index {index}", data=index) for index in indices]


def index_of(key: str) -> int:
    """Return the index of an episode's job."""
    return int(key.removeprefix("index "))


def episode_result(outcome: Done | Lost, config: RunConfig) -> EpisodeResult:
    """Return the result of an episode's job. A job whose workers all died becomes the error `WORKER_DIED`."""
    if isinstance(outcome, Done):
        return from_plain(outcome.value, EpisodeResult, source="a worker's result")
    index = index_of(outcome.key)
    return EpisodeResult(
        episode_id=episode_id(SeedPath(run_seed=config.run_seed, purpose=config.purpose, index=index)),
        index=index,
        outcome="error",
        reason=WORKER_DIED,
        message=outcome.message,
    )


def _describe_progress(folder: RunFolder) -> str:
    done = len(folder.results())
    return (
        f"{done} episode{'s are' if done != 1 else ' is'} done in {folder.path}; "
        "the same call or command runs the missing episodes"
    )


def not_played(results: Sequence[EpisodeResult]) -> str:
    """Return how many episodes were not played, and why, in two sentences; empty: all were played."""
    lost = [result for result in results if not result.played]
    if not lost:
        return ""
    return (
        f"{len(lost)} of {len(results)} episodes were not played: every process that ran one of them died, first at "
        f"index {lost[0].index}: {lost[0].message}. The same call or command repeats these episodes"
    )


def failures(results: Iterable[EpisodeResult], max_items: int = 10) -> list[str]:
    """Return a line for each reason of failure, the most frequent first, with its episodes and its first message.

    Args:
        results: The results.
        max_items: Number of episodes that a line names at most.
    """
    by_reason: dict[str, list[EpisodeResult]] = {}
    for result in results:
        if result.outcome != "success":
            by_reason.setdefault(result.reason, []).append(result)
    lines = []
    for reason, failed in sorted(by_reason.items(), key=lambda item: -len(item[1])):
        named = ", ".join(str(result.index) for result in failed[:max_items])
        more = f" and {len(failed) - max_items} more" if len(failed) > max_items else ""
        message = next((f": {result.message}" for result in failed if result.message), "")
        lines.append(f"{reason} in {len(failed)} episode{'s' * (len(failed) > 1)}: {named}{more}{message}")
    return lines
