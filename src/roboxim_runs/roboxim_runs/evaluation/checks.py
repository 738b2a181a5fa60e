"""Checks of an evaluation before a worker starts: policies suit the task, folders hold no results of another policy."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from roboxim_core.errors import ConfigError, EvaluationError, counted, one_of
from roboxim_datasets.episode import BETWEEN_ROBOTS
from roboxim_runs.episodes.run import EpisodesJob, not_played
from roboxim_runs.evaluation.results import PolicyResult
from roboxim_runs.executors import Executor, LocalExecutor
from roboxim_runs.policies.specs import ChosenPolicy
from roboxim_runs.storage.folder import RunFolder, require_bags

if TYPE_CHECKING:
    from roboxim_tasks.task_config import TaskConfig


def require_cameras(chosen: Sequence[ChosenPolicy], cells: Sequence[TaskConfig]) -> None:
    """Refuse a policy that needs a camera which the task's scenes lack, where its cameras are known.

    Raises:
        ConfigError: Naming the policy and the camera.
    """
    for cell in cells:
        reset = cell.reset.get("cameras")
        have = list(reset.names) if reset else [camera.name for camera in cell.base_scene().cameras]
        for policy in chosen:
            for camera in policy.cameras:
                if camera not in have:
                    raise ConfigError(
                        f"policy '{policy.name}' needs camera '{camera}', which the task's scenes lack; "
                        f"{one_of(have, camera)}"
                    )


def require_local(chosen: Sequence[ChosenPolicy], executor: Executor | None, workers: int) -> None:
    """Refuse a policy of the calling process when workers may be on other machines, or cannot have a copy each.

    Raises:
        ConfigError: Naming the policy.
    """
    for policy in chosen:
        if policy.own is not None and not isinstance(executor, LocalExecutor | None):
            raise ConfigError(
                f"policy '{policy.name}' lives in this process, which workers on other machines do not reach; write it "
                f"to a file and name it, e.g. 'my_policy.py:{policy.name}'"
            )
        if policy.own is not None and workers > 1:
            policy.own.require_copies()


def require_robots(chosen: Sequence[ChosenPolicy], cells: Sequence[TaskConfig]) -> None:
    """Refuse a policy that was trained without a robot of the task.

    Raises:
        ConfigError: Naming the policy and both robots.
    """
    trained = {policy.name: policy.robot for policy in chosen if policy.robot}
    if not trained:
        return
    robots = {cell.base_scene().robot.model for cell in cells}
    for name, robot in trained.items():
        if not robots <= set(robot.split(BETWEEN_ROBOTS)):
            seen = "' and '".join(robot.split(BETWEEN_ROBOTS))
            raise ConfigError(
                f"policy '{name}' was trained with the robot '{seen}', the task has {' and '.join(sorted(robots))}; "
                "choose a task with its robot, or allow this with --other-robot or other_robot=True"
            )


def require_played(policies: Iterable[PolicyResult]) -> None:
    """Refuse to report policies that did not play all of their episodes: those that are missing are no failures.

    Raises:
        EvaluationError: Naming the policies, the first episode, and what happened to it.
    """
    for policy in policies:
        if lost := not_played(policy.results):
            raise EvaluationError(
                f"policy '{policy.name}' has no rate, since {lost}; a policy that ends its own process must be mended"
            )


def require_same_policy(name: str, job: EpisodesJob, folder: Path, *, repair: bool) -> None:
    """Refuse a folder with results of another run, or of an earlier state of the policy.

    Raises:
        ConfigError: Naming what differs.
        RecorderError: ``BAG_DAMAGED`` when bags of its results have vanished.
    """
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
    holds = f"{run.path} holds {counted(episodes, 'episode')}"
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
