"""Evaluates policies in fresh scenes, counts successes, and writes a report.

Tasks, statistics and the report are imported where they are needed: the imports take seconds, and a mistake in a
policy's name or folder is refused before them.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from roboxim_core.config import to_json
from roboxim_core.errors import ConfigError, EvaluationError
from roboxim_core.policies import Policy
from roboxim_core.seeds import EVALUATED
from roboxim_core.shards import Shard
from roboxim_eval.film_options import FilmOptions
from roboxim_policies.remote import SERVERS_OWN
from roboxim_runs.episodes.run import EpisodesJob, run_environment, run_episodes
from roboxim_runs.episodes.task_choice import cells_of
from roboxim_runs.episodes_config import EpisodesConfig
from roboxim_runs.evaluation.checks import (
    require_cameras,
    require_local,
    require_played,
    require_robots,
    require_same_policy,
)
from roboxim_runs.evaluation.report import RECORD_FILE, EvaluationRecord, policy_facts, write_evaluation
from roboxim_runs.evaluation.results import EvaluationResult, PolicyResult
from roboxim_runs.evaluation.views import view_warnings
from roboxim_runs.events import Notice, OnEvent, PolicyMeasured, PolicyResumed, ignore
from roboxim_runs.executors import Cancellation, Executor
from roboxim_runs.executors.protocol import unchanged
from roboxim_runs.policies.here import OwnServer
from roboxim_runs.policies.specs import ChosenPolicy, PolicySpec, find_policies
from roboxim_runs.policies.waiting import SERVER_WAIT_S
from roboxim_runs.storage.folder import RunFolder
from roboxim_runs.storage.occupied import require_own

if TYPE_CHECKING:
    from roboxim_runs.policies.servers import PolicyServers


@dataclass(frozen=True, kw_only=True)
class EvaluationConfig(EpisodesConfig):
    """Configuration of an evaluation."""

    policies: str | PolicySpec | Policy | type[Policy] | Sequence[str | PolicySpec | Policy | type[Policy]]
    """Policies under test; a text is ``[NAME=]SPEC``, e.g. ``random`` or ``mine=my_policy.py:MyPolicy``. A subclass of
    `BasePolicy`, or an instance of one, is served to the workers by the calling process; its name is the class's."""
    out: Path | str = "runs/evaluation"
    """Folder of the report, with a subfolder for each policy."""
    usual: ClassVar[int] = 20
    purpose: str = "eval"
    """``eval``, or ``train``: scenes for choices, e.g. of a checkpoint, which no evaluation has."""
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
    """Whether simulated time passes while the policy computes. Such an evaluation is not repeatable."""
    policy_timeout_s: float = 120.0
    """Longest wait for an answer [s]. A model's first call can take a minute, in which it is compiled."""
    server_wait_s: float = SERVER_WAIT_S
    """Longest wait for a policy's server that is away [s]; then the run stops, and the same call continues it."""
    other_robot: bool = False
    """Whether to allow a robot other than the one that a policy was trained with."""
    command: str = ""
    """Command that reproduces the report, shown in it; empty: the call of `evaluate`."""
    stopped: str = ""
    """How the number of episodes was decided, for the report; empty: it was fixed beforehand."""
    undecided: bool = False
    """Whether planned looks at the results have not decided; then the report calls no policy better."""
    film: FilmOptions = FilmOptions()
    """Which films the report shows, and how."""
    page: bool = True
    """Whether to write the report's page, which takes seconds; `evaluation_report.report_of` writes it later."""

    def __post_init__(self) -> None:
        """Check the values that need no other file.

        Raises:
            ConfigError: As `EpisodesConfig`, or on another purpose.
        """
        super().__post_init__()
        if self.purpose not in EVALUATED:
            raise ConfigError(f"the purpose of an evaluation is {' or '.join(EVALUATED)}, got '{self.purpose}'")


def evaluate(
    config: EvaluationConfig,
    *,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
    executor: Executor | None = None,
    servers: Sequence[Executor] = (),
) -> EvaluationResult:
    """Run policies in fresh scenes and write a report. Episodes that the folder has are not run again.

    Evaluation scenes are never those of demonstrations, with any seed. A policy whose file or checkpoint has changed
    since needs another folder.

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
        EvaluationError: When a policy's files changed during the evaluation, or all processes died at an episode.
        PolicyError: When a policy's module raises on import.
        RecorderError: ``BAG_DAMAGED`` when bags of earlier results have vanished.
        RoboximError: When a graph has a fault that a new worker does not recover from.
        UnavailableError: When a policy's server stays away.
    """
    from roboxim_runs.scenes.definitions import definitions_of, task_files

    named = config.policies
    chosen = find_policies(named if isinstance(named, Sequence) and not isinstance(named, str) else [named])
    require_local(chosen, executor, config.workers)
    text, out = config.task_text(), Path(config.out)
    config = config.sized(text, on_event)
    if config.page:
        config.film.require_scenes(config.indices)
    cells = cells_of(text)
    require_cameras(chosen, cells)
    if not config.other_robot:
        require_robots(chosen, cells)
    warnings = view_warnings(chosen, cells)
    for warning in warnings:
        on_event(Notice(text=warning))
    definitions = definitions_of(cells, task_files(text))
    jobs = {
        policy.name: replace(_job(config, policy, text, _server(config, policy, on_event)), definitions=definitions)
        for policy in chosen
    }
    require_own(out, "evaluate", own=(RECORD_FILE, *jobs), empty=True)  # pages would lie between other files
    for policy in chosen:
        require_same_policy(policy.name, jobs[policy.name], out / policy.name, repair=config.repair)
        jobs[policy.name].upload.require_own(jobs[policy.name].identity, repair=config.repair)
    found = {}
    with run_environment("evaluate", out) as environment:
        for policy in chosen:
            job = jobs[policy.name]
            there = _report_resume(policy.name, job, on_event, repair=config.repair)
            with _served(policy, servers, missing=there < len(job.indices)) as served:
                results = run_episodes(
                    job, f"rollouts of {policy.name}", environment, cancellation=cancellation, executor=executor,
                    on_event=served.with_notices(on_event) if served else on_event, repair=config.repair,
                    prepare=served.prepared if served else unchanged,
                )  # fmt: skip
            if there < len(job.indices) and policy.files(out) != job.policy_files:
                raise EvaluationError(
                    f"the files of policy '{policy.name}' changed while it was evaluated, so its episodes may mix "
                    f"two policies; remove {out / policy.name} and evaluate again"
                )
            found[policy.name] = PolicyResult(name=policy.name, results=tuple(results), folder=out / policy.name)
            if all(result.played for result in results):
                on_event(PolicyMeasured(policy=policy.name, results=found[policy.name].results))
    require_played(found.values())
    record = EvaluationRecord(
        task=config.task_name, seed=config.seed, policies=tuple(found),
        facts={"purpose": config.purpose, **policy_facts(chosen, jobs)},
        command=config.command or _call(config), stopped=config.stopped,
        undecided=config.undecided,
        trained=tuple(policy.name for policy in chosen if policy.is_checkpoint),
        film=config.film, warnings=warnings,
    )  # fmt: skip
    return write_evaluation(record, found, out, page=config.page)


@contextlib.contextmanager
def _served(
    policy: ChosenPolicy, executors: Sequence[Executor], *, missing: bool
) -> Iterator[PolicyServers | OwnServer | None]:
    """Serve a policy while the block runs; none: the workers have it themselves, or it is behind a server anyway."""
    if policy.own is not None and missing:
        with OwnServer(policy.own) as own:
            yield own
        return
    if not missing or not executors or policy.launch is None or policy.acting.is_remote:
        yield None
        return
    from roboxim_runs.policies.servers import PolicyServers

    with PolicyServers(policy.name, policy.launch, executors) as servers:
        yield servers


def _server(config: EvaluationConfig, policy: ChosenPolicy, on_event: OnEvent) -> dict[str, Any]:
    """Return what identifies a remote policy's server; empty for other policies. Tell what its answers show."""
    acting = policy.acting
    if not acting.is_remote:
        return {}
    from roboxim_runs.policies.server_records import server_record

    folder = RunFolder(Path(config.out) / policy.name)
    record = server_record(acting, folder, len(config.indices), config.policy_timeout_s)
    for text in record.notices:
        on_event(Notice(text=text))
    return record.plain


def _job(config: EvaluationConfig, policy: ChosenPolicy, task_config: str, server: Mapping[str, Any]) -> EpisodesJob:
    launch, out = policy.launch, Path(config.out)
    if launch is not None and launch.options.get("convention") == SERVERS_OWN:  # a worker need not connect to begin
        launch = replace(launch, options={**launch.options, "convention": to_json(server["server"]["convention"])})
    run = config.run_config(
        task_config, purpose=config.purpose, actor="expert" if launch is None else launch.namespace, keep="all",
        max_steps=config.max_steps, window=config.window, execute=config.execute, ensemble=config.ensemble,
        ensemble_decay=config.ensemble_decay, late_rows=config.late_rows, gripper_band=config.gripper_band,
        gripper_agree=config.gripper_agree, latency_ticks=config.latency, real_time=config.real_time,
        policy_timeout_s=config.policy_timeout_s,
        output_dir=str((out / policy.name).resolve()),
    )  # fmt: skip
    return EpisodesJob(
        config=run, episodes=config.episodes, shard=Shard.parse(config.shard), workers=config.workers,
        renderer=config.renderer, policies=() if launch is None else (launch,), policy_files=policy.files(out),
        server=server, server_wait_s=config.server_wait_s,
        store=f"{config.store.rstrip('/')}/{policy.name}" if config.store else "",
    )  # fmt: skip


def _report_resume(name: str, job: EpisodesJob, on_event: OnEvent, *, repair: bool) -> int:
    """Report how many of a job's episodes an earlier run finished, and when; return the number."""
    run = RunFolder(job.config.output_dir)
    done = job.done(run.results()).values()
    there = len(done) - (len(run.without_bag(done)) if repair else 0)
    if there:
        since = datetime.fromtimestamp(run.log.path.stat().st_mtime).strftime("%Y-%m-%d %H:%M")
        on_event(PolicyResumed(policy=name, there=there, episodes=len(job.indices), since=since))
    return there


def _call(config: EvaluationConfig) -> str:
    """Return the call that reproduces a report, as Python."""
    default = {name: field.default for name, field in EvaluationConfig.__dataclass_fields__.items()}
    given = {
        name: str(value) if isinstance(value, Path) else value
        for name, value in vars(config).items()
        if value != default[name] and name not in ("workers", "stopped", "undecided", "shard", "page")
    }
    return f"roboxim.evaluate({', '.join(f'{name}={value!r}' for name, value in given.items())})"
