"""Evaluates policies in fresh scenes, counts successes, and writes a report.

Tasks, statistics and the report are imported where they are needed: the imports take seconds, and a mistake in a
policy's name or folder is refused before them.
"""

from __future__ import annotations

import contextlib
import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from roboxim_bringup.executors import Cancellation, Executor
from roboxim_bringup.executors.protocol import unchanged
from roboxim_bringup.runs.episodes import EpisodesConfig, EpisodesJob, run_environment, run_episodes
from roboxim_bringup.runs.events import OnEvent, PolicyMeasured, PolicyResumed, ignore
from roboxim_bringup.runs.folder import RunFolder, require_bags
from roboxim_bringup.runs.policies import ChosenPolicy, PolicySpec, find_policies
from roboxim_bringup.runs.results_log import write_atomically
from roboxim_bringup.runs.store import readable_run
from roboxim_core.config import from_plain, load_config, named_config, to_json, to_plain
from roboxim_core.documents import read_json_object
from roboxim_core.episode import EpisodeInfo, EpisodeResult
from roboxim_core.errors import ConfigError, EvaluationError, one_of
from roboxim_core.shards import Shard
from roboxim_core.specs import SceneSpec
from roboxim_policies.remote import SERVERS_OWN

if TYPE_CHECKING:
    from roboxim_bringup.runs.policy_servers import PolicyServers
    from roboxim_eval.report import PolicyRun
    from roboxim_eval.statistics import SuccessRate
    from roboxim_tasks.task_config import TaskConfig

RECORD_FILE = "evaluation.json"
"""File beside a report, by which `roboxim merge` writes it again."""
REPORT_FILE = "report.html"
"""The report's file."""
SHOWN = 12
"""Films of each policy in the report."""


@dataclass(frozen=True, kw_only=True)
class EvaluationConfig(EpisodesConfig):
    """Configuration of an evaluation."""

    policies: str | PolicySpec | Sequence[str | PolicySpec]
    """Policies under test; a text is ``[NAME=]SPEC``, e.g. ``random`` or ``mine=my_policy.py:MyPolicy``."""
    out: Path | str = "runs/evaluation"
    """Folder of the report, with a subfolder for each policy."""
    episodes: int = 20
    """Episodes per policy; every policy meets the same scenes."""
    max_steps: int = 0
    """Actions per episode; 0: as the task says."""
    window: int = 0
    """Observations per request; 0: the policy's window."""
    execute: int = 0
    """Actions executed per request; 0: as the policy says, by default its horizon."""
    ensemble: str = ""
    """``newest``, ``mean`` or ``exponential``: how several answers for one tick are combined; empty: as the policy
    says."""
    ensemble_decay: float = 0.0
    """k of the exponential weights exp(-k i), i = 0 the oldest answer; only with ``ensemble="exponential"``."""
    late_rows: str = ""
    """``shift`` (a late answer's first action is executed on arrival) or ``drop`` (actions whose tick has passed are
    left out); empty: as the policy says."""
    gripper_band: float = 0.0
    """Width of the band around half open in which the gripper keeps its command; outside it opens or closes fully.
    0: as the policy says."""
    gripper_agree: int = 0
    """Successive actions that must agree before the gripper switches; 0: as the policy says."""
    latency: int = 0
    """Ticks by which every answer is late."""
    real_time: bool = False
    """Whether simulated time goes on while the policy thinks. Such an evaluation is not repeatable."""
    policy_timeout_s: float = 120.0
    """Longest wait for an answer [s]. A model's first call can take a minute, in which it is compiled."""
    other_robot: bool = False
    """Whether to allow a robot other than the one that a policy was trained with."""
    command: str = ""
    """Command that reproduces the report, shown in it; empty: the call of `evaluate`."""
    stopped: str = ""
    """How the number of episodes was decided, for the report; empty: it was fixed beforehand."""
    page: bool = True
    """Whether to write the report's page, which takes seconds; `report_of` writes it later."""


@dataclass(frozen=True, kw_only=True)
class EvaluationRecord:
    """What a report says about an evaluation and its episodes do not; stored as `RECORD_FILE` beside it."""

    task: str
    """Name of the task."""
    seed: int
    """Seed of the run."""
    policies: tuple[str, ...]
    """Names of the policies, the one under test first; each has a run in a subfolder of its name."""
    facts: Mapping[str, str] = field(default_factory=dict)
    """Options and files of the policies."""
    command: str = ""
    """Command that reproduces the evaluation."""
    stopped: str = ""
    """How the number of episodes was decided; empty: it was fixed beforehand."""


@dataclass(frozen=True, kw_only=True)
class PolicyResult:
    """Result of one policy."""

    name: str
    """Its name."""
    results: tuple[EpisodeResult, ...]
    """Results by episode, in the order of their indices."""
    folder: Path
    """Folder of its run, with the bags."""

    @property
    def measured(self) -> bool:
        """Whether the results measure the policy; false when most episodes ended in errors."""
        from roboxim_eval.statistics import is_measured

        return is_measured(self.results)

    @property
    def rate(self) -> SuccessRate:
        """Success rate with its interval; an error counts as a failure."""
        from roboxim_eval.statistics import rate_of

        return rate_of(self.results)

    @property
    def success_rate(self) -> float | None:
        """Share of successes, 0..1; none when `measured` is false."""
        return self.rate.rate if self.measured else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """The 95 % interval of the success rate; none when `measured` is false."""
        return (self.rate.low, self.rate.high) if self.measured else None

    @property
    def summary(self) -> str:
        """Rate, interval and errors in one line."""
        return rate_line(self.results)


@dataclass(frozen=True, kw_only=True)
class EvaluationResult:
    """Result of an evaluation; ``evaluation["bc"]`` is one policy's result."""

    policies: Mapping[str, PolicyResult]
    """Name to result, the policy under test first."""
    report: Path | None
    """The report, ``<out>/report.html``; none: not written."""
    comparison: str
    """Comparison of the first policy with the others, in words; empty for one policy."""
    privileged: tuple[str, ...]
    """Policies that received the task, scene and state, which a policy under test must not see."""

    def __getitem__(self, name: str) -> PolicyResult:
        """Return a policy's result.

        Raises:
            ConfigError: When no policy has the name.
        """
        if name not in self.policies:
            raise ConfigError(f"no policy '{name}' in this evaluation; {one_of(self.policies, name)}")
        return self.policies[name]

    @property
    def first(self) -> PolicyResult:
        """The result of the policy under test."""
        return next(iter(self.policies.values()))

    @property
    def success_rate(self) -> float | None:
        """Success rate of the policy under test, 0..1; none when it was not measured."""
        return self.first.success_rate

    @property
    def interval(self) -> tuple[float, float] | None:
        """The 95 % interval of that rate; none when the policy was not measured."""
        return self.first.interval

    @property
    def results(self) -> tuple[EpisodeResult, ...]:
        """Results by episode of the policy under test."""
        return self.first.results

    def require_measured(self) -> None:
        """Refuse a result in which most episodes of a policy ended in errors.

        Raises:
            EvaluationError: Naming the policies.
        """
        broken = [policy for policy in self.policies.values() if not policy.measured]
        if broken:
            names = " and ".join(policy.name for policy in broken)
            raise EvaluationError(
                f"{names} could not be measured: most episodes ended in errors. Fix what their "
                f"reasons name; then choose another output folder (--out or out=) or remove "
                f"{', '.join(str(policy.folder) for policy in broken)}"
            )


def evaluate(
    config: EvaluationConfig,
    *,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
    executor: Executor | None = None,
    servers: Sequence[Executor] = (),
) -> EvaluationResult:
    """Run policies in fresh scenes and write a report. Episodes that the folder has are not run again.

    Evaluation scenes are never those of demonstrations, whatever the seed. A policy whose file or checkpoint has
    changed since needs another folder.

    Args:
        config: Configuration of the evaluation.
        on_event: Receives the run's events.
        cancellation: Ends the run when it is set.
        executor: Runs the episodes; none: processes of this machine.
        servers: Run one process each that serves a policy to all workers; none: each worker has the policy itself.
            Results are the same, but for policies that answer several workers together
            (`roboxim_policies.BasePolicy.act_batch`).

    Raises:
        CancelledError: When the run was cancelled.
        ConfigError: When a check before the workers' start fails, e.g. on an unknown camera.
        EvaluationError: When a policy's files changed during the evaluation.
        PolicyError: When a policy's module raises on import.
        RecorderError: ``BAG_DAMAGED`` when bags of earlier results have vanished.
        RoboximError: When a graph has a fault that a new worker does not recover from.
    """
    named = config.policies
    chosen = find_policies([named] if isinstance(named, str | PolicySpec) else named)
    text, out = config.task_text(), Path(config.out)
    cells = _cells(text)
    _require_cameras(chosen, cells)
    if not config.other_robot:
        _require_robots(chosen, cells)
    jobs = {policy.name: _job(config, policy, text, _server(config, policy)) for policy in chosen}
    for policy in chosen:
        _require_same_policy(policy.name, jobs[policy.name], out / policy.name, repair=config.repair)
    found = {}
    with run_environment("evaluate", out) as environment:
        for policy in chosen:
            job = jobs[policy.name]
            there = _report_resume(policy.name, job, on_event, repair=config.repair)
            with _served(policy, servers if there < len(job.indices) else ()) as served:
                results = run_episodes(
                    job, f"rollouts of {policy.name}", environment, cancellation=cancellation, executor=executor,
                    on_event=served.telling(on_event) if served else on_event, repair=config.repair,
                    prepare=served.prepared if served else unchanged,
                )  # fmt: skip
            if there < len(job.indices) and policy.files(out) != job.policy_files:
                raise EvaluationError(
                    f"the files of policy '{policy.name}' changed while it was evaluated, so its episodes may mix "
                    f"two policies; remove {out / policy.name} and evaluate again"
                )
            found[policy.name] = PolicyResult(name=policy.name, results=tuple(results), folder=out / policy.name)
            on_event(PolicyMeasured(policy=policy.name, results=found[policy.name].results))
    record = EvaluationRecord(
        task=config.task_name, seed=config.seed, policies=tuple(found), facts=_policy_facts(chosen, jobs),
        command=config.command or _call(config), stopped=config.stopped,
    )  # fmt: skip
    return _report(record, found, out, page=config.page)


@contextlib.contextmanager
def _served(policy: ChosenPolicy, executors: Sequence[Executor]) -> Iterator[PolicyServers | None]:
    """Serve a policy while the block runs; none: the workers have it themselves, or it is behind a server anyway."""
    if not executors or policy.launch is None or policy.acting.is_remote:
        yield None
        return
    from roboxim_bringup.runs.policy_servers import PolicyServers

    with PolicyServers(policy.name, policy.launch, executors) as servers:
        yield servers


def report_of(out: Path, record: EvaluationRecord | None = None, *, page: bool = True) -> EvaluationResult:
    """Write the report of the finished episodes in an evaluation's folder.

    Args:
        out: The evaluation's folder, with a run for each policy.
        record: What the report says about the evaluation; none: as stored in the folder.
        page: Whether to write its page, or only the record.

    Raises:
        ConfigError: When the folder has no record, or its files are damaged.
        RecorderError: With code ``BAG_DAMAGED`` when a bag that the page shows is not whole.
    """
    if record is None:
        stored = out / RECORD_FILE
        record = from_plain(read_json_object(stored), EvaluationRecord, source=str(stored))
    found = {
        name: PolicyResult(name=name, results=tuple(RunFolder(out / name).results()), folder=out / name)
        for name in record.policies
    }
    return _report(record, found, out, page=page)


def _server(config: EvaluationConfig, policy: ChosenPolicy) -> dict[str, Any]:
    """Return what identifies a remote policy's server; empty for other policies."""
    acting = policy.acting
    if not acting.is_remote:
        return {}
    from roboxim_bringup.runs.servers import server_record

    return server_record(
        acting, RunFolder(Path(config.out) / policy.name), len(config.indices), config.policy_timeout_s
    ).plain


def _job(config: EvaluationConfig, policy: ChosenPolicy, task_config: str, server: Mapping[str, Any]) -> EpisodesJob:
    launch, out = policy.launch, Path(config.out)
    if launch is not None and launch.options.get("convention") == SERVERS_OWN:  # a worker need not connect to begin
        launch = replace(launch, options={**launch.options, "convention": to_json(server["server"]["convention"])})
    run = config.run_config(
        task_config, purpose="eval", actor="expert" if launch is None else launch.namespace, keep="all",
        max_steps=config.max_steps, window=config.window, execute=config.execute, ensemble=config.ensemble,
        ensemble_decay=config.ensemble_decay, late_rows=config.late_rows, gripper_band=config.gripper_band,
        gripper_agree=config.gripper_agree, latency_ticks=config.latency, real_time=config.real_time,
        policy_timeout_s=config.policy_timeout_s,
        output_dir=str((out / policy.name).resolve()),
    )  # fmt: skip
    return EpisodesJob(
        config=run, episodes=config.episodes, shard=Shard.parse(config.shard), workers=config.workers,
        renderer=config.renderer, policies=() if launch is None else (launch,), policy_files=policy.files(out),
        server=server, store=f"{config.store.rstrip('/')}/{policy.name}" if config.store else "",
    )  # fmt: skip


# ------------------------------------------------------------------ checks before a worker starts


def _cells(task_config: str) -> Sequence[TaskConfig]:
    from roboxim_tasks.config import TaskMix, parse_task_config

    config = parse_task_config(task_config)
    return config.cells if isinstance(config, TaskMix) else (config,)


def _scene(cell: TaskConfig) -> SceneSpec:
    return load_config(named_config("scenes", cell.scene), SceneSpec)


def _require_cameras(chosen: Sequence[ChosenPolicy], cells: Sequence[TaskConfig]) -> None:
    """Refuse a policy that needs a camera which the task's scenes lack, where its cameras are known."""
    for cell in cells:
        reset = cell.reset.get("cameras")
        have = list(reset.names) if reset else [camera.name for camera in _scene(cell).cameras]
        for policy in chosen:
            for camera in policy.cameras:
                if camera not in have:
                    raise ConfigError(
                        f"policy '{policy.name}' needs camera '{camera}', which the task's scenes lack; "
                        f"{one_of(have, camera)}"
                    )


def _require_robots(chosen: Sequence[ChosenPolicy], cells: Sequence[TaskConfig]) -> None:
    """Refuse a policy that was trained with a robot other than the task's."""
    trained = {policy.name: policy.robot for policy in chosen if policy.robot}
    if not trained:
        return
    robots = {_scene(cell).robot.model for cell in cells}
    for name, robot in trained.items():
        if robots != {robot}:
            raise ConfigError(
                f"policy '{name}' was trained with the robot '{robot}', the task has {' and '.join(sorted(robots))}; "
                "choose a task with its robot, or allow this with --other-robot or other_robot=True"
            )


def _require_same_policy(name: str, job: EpisodesJob, folder: Path, *, repair: bool) -> None:
    """Refuse a folder with results of another run, or of an earlier state of the policy."""
    run = RunFolder(folder)
    if not run.path.exists():
        return
    if not repair:
        results = run.results()
        if results and job.policy_files:
            _require_same_files(name, job, run, len(results))
    with run.opened(job.identity, repair=repair):
        if not repair:
            require_bags(run, job.done(run.results()).values())


def _require_same_files(name: str, job: EpisodesJob, run: RunFolder, episodes: int) -> None:
    stored = run.config()
    files = stored.get("policy_files")
    holds = f"{run.path} holds {episodes} episode{'s' * (episodes != 1)}"
    todo = f"choose another output folder (--out or out=), or remove {run.path} to run it again"
    if files is None:
        raise ConfigError(
            f"{holds} from an older version, which did not record a policy's files: they may come from another "
            f"state of {', '.join(job.policy_files)}; {todo}"
        )
    if files != job.policy_files and stored.get("policies") == job.identity["policies"]:
        now = job.policy_files
        changes = [f"{file} has changed" for file in files if file in now and now[file] != files[file]]
        changes += [f"{file} is new" for file in now if file not in files]
        changes += [f"{file} is no longer part of it" for file in files if file not in now]
        raise ConfigError(f"{holds} of an earlier state of policy '{name}': {', '.join(changes)}; {todo}")


def _report_resume(name: str, job: EpisodesJob, on_event: OnEvent, *, repair: bool) -> int:
    """Report how many of a job's episodes an earlier run finished, and when; return the number."""
    run = RunFolder(job.config.output_dir)
    done = job.done(run.results()).values()
    there = len(done) - (len(run.without_bag(done)) if repair else 0)
    if there:
        since = datetime.fromtimestamp(run.log.path.stat().st_mtime).strftime("%Y-%m-%d %H:%M")
        on_event(PolicyResumed(policy=name, there=there, episodes=len(job.indices), since=since))
    return there


# ------------------------------------------------------------------ report


def rate_line(results: Sequence[EpisodeResult]) -> str:
    """Return a policy's success rate with its interval, and its errors; only the errors when they are most episodes."""
    from roboxim_eval.statistics import error_line, is_measured, rate_of

    errors = error_line(results)
    if not is_measured(results):
        return errors
    return f"{rate_of(results)}" + (f"; {errors}" if errors else "")


def timing_line(results: Sequence[EpisodeResult]) -> str:
    """Return when a policy's answers arrived, in words."""
    acting = [result for result in results if result.steps]
    if not acting:
        return "no episode was acted"
    line, held = acting[0].timing, sum(result.held for result in acting)
    if line == "lockstep":
        return line
    delay = sum(result.delay_ticks for result in acting) / len(acting)
    return (
        f"{line}: answers arrive {delay:.1f} ticks after their observation on average; the robot held still without an "
        f"answer at {held} of {sum(result.steps for result in acting)} ticks"
    )


def _policy_facts(chosen: Sequence[ChosenPolicy], jobs: Mapping[str, EpisodesJob]) -> dict[str, str]:
    """Return each policy's options and files, for the report."""
    facts = {}
    for policy in chosen:
        files = (f"{file} {digest[:16]}" for file, digest in jobs[policy.name].policy_files.items())
        server = jobs[policy.name].server.get("server", {})
        remote = [
            f"version {policy.options.get('version')}", f"convention {server['convention']['name']}",
            str(policy.options.get("url")),
        ] if server else []  # fmt: skip
        facts[f"policy {policy.name}"] = ", ".join([policy.spec, *remote, *files])
    return facts


def _policy_run(result: PolicyResult) -> PolicyRun:
    from roboxim_bringup.runs.episode_facts import episode_facts
    from roboxim_bringup.runs.pictures import film
    from roboxim_eval.report import PolicyRun
    from roboxim_eval.report.films import chosen_films

    recorded = {episode.episode_id: episode for episode in _with_bags(result)}
    shown = chosen_films([(name, episode.outcome == "success") for name, episode in recorded.items()], SHOWN)
    with readable_run(result.folder, [episode.bag for episode in recorded.values()]) as run:
        facts = episode_facts(result.folder, result.results, bags=run)
        films = {name: frames for name in shown if (frames := film(run / recorded[name].bag))}
    return PolicyRun(
        policy=result.name, results=result.results, folder=result.folder.name, films=films,
        drawn={name: one.drawn for name, one in facts.items()},
        starts={name: one.start for name, one in facts.items() if one.start is not None},
    )  # fmt: skip


def _report(
    record: EvaluationRecord, found: Mapping[str, PolicyResult], out: Path, *, page: bool
) -> EvaluationResult:  # fmt: skip
    """Write the record and, if asked for, the page."""
    from roboxim_eval.report import PolicyRun, verdict_line

    write_atomically(out / RECORD_FILE, json.dumps(to_plain(record), indent=2) + "\n")
    infos = {name: info for name, result in found.items() if (info := _first_info(result)) is not None}
    runs = [PolicyRun(policy=name, results=result.results) for name, result in found.items()]
    return EvaluationResult(
        policies=dict(found), report=_page(record, found, infos, out) if page else None,
        comparison=verdict_line(runs), privileged=tuple(n for n, info in infos.items() if info.actor_privileged),
    )  # fmt: skip


def _page(
    record: EvaluationRecord, found: Mapping[str, PolicyResult], infos: Mapping[str, EpisodeInfo], out: Path
) -> Path:  # fmt: skip
    """Write the page and return its file."""
    from roboxim_eval.report import Report, write_report

    facts = {"task": record.task, "run seed": str(record.seed), "purpose": "eval"}
    facts |= {"episodes": str(len(next(iter(found.values())).results)), **record.facts}
    versions: dict[str, str] = {}
    for name, result in found.items():
        facts[f"timing of {name}"] = timing_line(result.results)
        if name not in infos:
            continue
        info = infos[name]
        facts |= {
            "robot": info.scene.robot.model, "renderer": info.renderer,
            "control rate": f"{info.semantics.rate_hz:g} Hz",
        }  # fmt: skip
        facts |= {f"camera {camera.name}": f"{camera.width} x {camera.height}" for camera in info.scene.cameras}
        versions |= info.versions | {f"model {model}": digest for model, digest in info.models.items()}
        if info.actor_version:
            versions[f"policy {name}"] = info.actor_version
        if info.actor_privileged:
            facts[f"policy {name} is privileged"] = "it sees the task, scene and state"
    report = Report(
        title=f"Evaluation of {' and '.join(found)} on {record.task}",
        runs=[_policy_run(result) for result in found.values()], facts=facts, versions=versions,
        command=record.command, stopped=record.stopped,
    )  # fmt: skip
    return write_report(report, out)


def _first_info(result: PolicyResult) -> EpisodeInfo | None:
    """Return the episode information of a policy's first bag; none without a bag."""
    from roboxim_recorder.bag import BagReader

    first = next(iter(_with_bags(result)), None)
    if first is None:
        return None
    with readable_run(result.folder, [first.bag]) as run:
        return BagReader(run / first.bag).info


def _with_bags(result: PolicyResult) -> list[EpisodeResult]:
    """Return the episodes whose bags are in the folder or in its store; an unpacked run has none."""
    recorded = [episode for episode in result.results if episode.bag]
    gone = {episode.bag for episode in RunFolder(result.folder).without_bag(recorded)}
    return [episode for episode in recorded if episode.bag not in gone]


def _call(config: EvaluationConfig) -> str:
    """Return the call that reproduces a report, as Python."""
    default = {name: field.default for name, field in EvaluationConfig.__dataclass_fields__.items()}
    given = {
        name: str(value) if isinstance(value, Path) else value
        for name, value in vars(config).items()
        if value != default[name] and name not in ("workers", "stopped", "shard", "page")
    }
    return f"roboxim.evaluate({', '.join(f'{name}={value!r}' for name, value in given.items())})"


def command_line(words: Sequence[str]) -> str:
    """Return the command line that reproduces a report.

    Args:
        words: The command's arguments.
    """
    return shlex.join(["roboxim", *words])
