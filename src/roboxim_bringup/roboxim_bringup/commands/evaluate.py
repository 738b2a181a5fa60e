"""Evaluate policies in fresh scenes; writes an HTML report."""

from __future__ import annotations

import shlex
import sys
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from roboxim_bringup.options import episode_options

if TYPE_CHECKING:
    from collections.abc import Sequence

    from roboxim_bringup.jobs import Job
    from roboxim_bringup.policy_choice import ChosenPolicy
    from roboxim_core.episode import EpisodeResult
    from roboxim_eval.report import PolicyRun

SHOWN = 12
"""Films per policy in the report, failures first."""


@click.command()
@click.option(
    "--policy", "policies", multiple=True, required=True, metavar="[NAME=]SPEC",
    help="bc, random, zero, replay, expert, module:Class or file.py:Class; may be repeated to compare. The name is for "
    "the report; two of one class need names.",
)  # fmt: skip
@click.option(
    "--checkpoint", "checkpoints", multiple=True, metavar="[NAME=]PATH",
    help="Checkpoint, a file or a folder, of the policies that take one, or of the one named; may be repeated.",
)  # fmt: skip
@click.option(
    "--option", "policy_options", multiple=True, metavar="[NAME.]KEY=VALUE",
    help="Argument of the first policy, or of the one named; may be repeated.",
)  # fmt: skip
@episode_options(episodes=20, out="runs/evaluation")
@click.option("--max-steps", type=click.IntRange(0), default=0, help="Actions per episode; 0: as the task says.")
@click.option(
    "--execute", type=click.IntRange(0), default=0, help="Actions executed per request; 0: the policy's horizon."
)
@click.option("--policy-timeout", default=30.0, show_default=True, help="Longest wait for an answer [s].")
@click.option("--other-robot", is_flag=True, help="Also with another robot than the policy was trained with.")
def command(
    policies: tuple[str, ...], checkpoints: tuple[str, ...], policy_options: tuple[str, ...], task: str, skill: str,
    objects: tuple[str, ...], distractors: str, colors: str, out: Path, episodes: int, seed: int, workers: int,
    size: str, renderer: str, depth: bool, segmentation: bool, max_steps: int, execute: int, policy_timeout: float,
    other_robot: bool,
) -> None:  # fmt: skip
    r"""Run policies in fresh scenes, count successes, and write OUT/report.html.

    \b
    roboxim evaluate --policy bc --checkpoint runs/bc --policy random --episodes 20
    roboxim evaluate --policy my_module:MyPolicy
    roboxim evaluate --policy old=bc --checkpoint old=runs/bc --policy new=bc --checkpoint new=runs/bc2

    Every policy meets the same scenes. Evaluation scenes are never those of demonstrations, whatever the seed. Ctrl-C
    stops; the same command goes on. A policy whose file or checkpoint has changed since needs another --out.
    """
    from roboxim_bringup.jobs import Job, failures, parse_size, registered_run, run_job
    from roboxim_bringup.policy_choice import choose_policies
    from roboxim_bringup.task_choice import DEFAULT_TASK, task_text
    from roboxim_core.episode import RunConfig
    from roboxim_core.errors import EvaluationError
    from roboxim_eval.statistics import is_measured

    width, height = parse_size(size)
    chosen = choose_policies(policies, checkpoints, policy_options)
    text = task_text(task, skill=skill, objects=objects, distractors=distractors, colors=colors)
    if not other_robot:
        _require_robots(chosen, text)
    jobs = {}
    for policy in chosen:
        launch = policy.launch
        config = RunConfig(
            run_seed=seed, purpose="eval", actor="expert" if launch is None else launch.namespace, keep="all",
            task_config=text, image_width=width, image_height=height, depth=depth, segmentation=segmentation,
            max_steps=max_steps, execute=execute, policy_timeout_s=policy_timeout,
            output_dir=str((out / policy.name).resolve()),
        )  # fmt: skip
        jobs[policy.name] = Job(
            config=config, episodes=episodes, workers=workers, renderer=renderer,
            policies=() if launch is None else (launch,), policy_files=policy.files(out),
        )  # fmt: skip
        _require_same_policy(policy.name, jobs[policy.name], out / policy.name)
    runs = []
    with registered_run("evaluate"):
        for policy in chosen:
            job = jobs[policy.name]
            there = _say_what_is_there(policy.name, job)
            results = run_job(job, f"rollouts of {policy.name}")
            if there < episodes and policy.files(out) != job.policy_files:
                raise EvaluationError(
                    f"the files of policy '{policy.name}' changed while it was evaluated, so its episodes may be of "
                    f"two policies; remove {out / policy.name} and run the same command again"
                )
            runs.append(_policy_run(policy.name, results, out / policy.name))
            click.echo(f"{policy.name}: {_told(results)}")
            for line in failures(results):
                click.echo(line)
    _report(runs, out, chosen, jobs, task=Path(task).stem or skill or DEFAULT_TASK, seed=seed)
    broken = [run.policy for run in runs if not is_measured(run.results)]
    if broken:
        raise EvaluationError(
            f"{' and '.join(broken)} could not be measured: most episodes ended in errors, and the reasons above say "
            f"what to change; then choose another --out or remove {', '.join(str(out / name) for name in broken)}"
        )


def _require_robots(chosen: Sequence[ChosenPolicy], task_text: str) -> None:
    """Refuse a policy that was trained with another robot than the task has."""
    from roboxim_core.config import load_config, named_config
    from roboxim_core.errors import ConfigError
    from roboxim_core.specs import SceneSpec
    from roboxim_tasks.config import TaskMix, parse_task_config

    trained = {policy.name: policy.robot for policy in chosen if policy.robot}
    if not trained:
        return
    config = parse_task_config(task_text)
    scenes = {cell.scene for cell in (config.cells if isinstance(config, TaskMix) else (config,))}
    robots = {load_config(named_config("scenes", scene), SceneSpec).robot.model for scene in scenes}
    for name, robot in trained.items():
        if robots != {robot}:
            raise ConfigError(
                f"policy '{name}' was trained with the robot '{robot}', the task has {' and '.join(sorted(robots))}; "
                "choose a task with its robot, or ask for this with --other-robot"
            )


def _require_same_policy(name: str, job: Job, folder: Path) -> None:
    """Refuse a folder whose results are not of the policy as it is now, or not of this run, before anything starts."""
    from roboxim_bringup.run_folder import RunFolder
    from roboxim_core.errors import ConfigError

    run = RunFolder(folder)
    if not run.path.exists():
        return
    results = run.results()
    if results and job.policy_files:
        stored = run.config()
        files = stored.get("policy_files")
        holds = f"{folder} holds {len(results)} episode{'s' * (len(results) != 1)}"
        todo = f"choose another --out, or remove {folder} to run it again"
        if files is None:
            raise ConfigError(
                f"{holds} from an older version, which did not record what a policy is made of: they may be of another "
                f"state of {', '.join(job.policy_files)}; {todo}"
            )
        if files != job.policy_files and stored.get("policies") == job.identity["policies"]:
            now = job.policy_files
            changes = [f"{file} has changed" for file in files if file in now and now[file] != files[file]]
            changes += [f"{file} is a part of it now" for file in now if file not in files]
            changes += [f"{file} was a part of it then" for file in files if file not in now]
            raise ConfigError(f"{holds} of an earlier state of policy '{name}': {', '.join(changes)}; {todo}")
    with run.opened(job.identity):
        pass


def _say_what_is_there(name: str, job: Job) -> int:
    """Say how many of a job's episodes an earlier command has run, and when; return the number."""
    from roboxim_bringup.run_folder import RESULTS_FILE, RunFolder

    run = RunFolder(job.config.output_dir)
    there = len(job.done(run.results()))
    if there:
        date = datetime.fromtimestamp((run.path / RESULTS_FILE).stat().st_mtime).strftime("%Y-%m-%d %H:%M")
        rest = "nothing is run" if there == job.episodes else "the others are run now"
        click.echo(f"{name}: {there} of {job.episodes} episodes were there already, from {date}; {rest}")
    return there


def _told(results: Sequence[EpisodeResult]) -> str:
    from roboxim_eval.statistics import error_line, is_measured, rate_of

    errors = error_line(results)
    if not is_measured(results):
        return errors
    return f"{rate_of(results)}" + (f"; {errors}" if errors else "")


def _policy_run(name: str, results: Sequence[EpisodeResult], folder: Path) -> PolicyRun:
    from roboxim_bringup.jobs import drawn_by_name, film
    from roboxim_eval.report import PolicyRun

    recorded = [result for result in results if result.bag]
    failed = [result for result in recorded if result.outcome != "success"][: SHOWN // 2]
    solved = [result for result in recorded if result.outcome == "success"][: SHOWN - len(failed)]
    films = {result.episode_id: film(folder / result.bag) for result in failed + solved}
    drawn = {result.episode_id: drawn_by_name(folder / result.bag) for result in recorded}
    return PolicyRun(policy=name, results=results, films=films, drawn=drawn)


def _report(
    runs: Sequence[PolicyRun], out: Path, chosen: Sequence[ChosenPolicy], jobs: dict[str, Job], *, task: str, seed: int
) -> None:
    from roboxim_eval.report import Report, verdict_line, write_report
    from roboxim_recorder.bag import BagReader

    facts = {"task": task, "run seed": str(seed), "purpose": "eval", "episodes": str(len(runs[0].results))}
    for policy in chosen:
        files = (f"{file} {digest[:16]}" for file, digest in jobs[policy.name].policy_files.items())
        facts[f"policy {policy.name}"] = ", ".join([policy.spec, *files])
    versions: dict[str, str] = {}
    privileged: list[str] = []
    for run in runs:
        first = next((result for result in run.results if result.bag), None)
        if first is None:
            continue
        info = BagReader(out / run.policy / first.bag).info
        facts |= {
            "robot": info.scene.robot.model, "renderer": info.renderer,
            "control rate": f"{info.semantics.rate_hz:g} Hz",
        }  # fmt: skip
        facts |= {f"camera {c.name}": f"{c.width} x {c.height}" for c in info.scene.cameras}
        versions |= info.versions | {f"model {name}": digest for name, digest in info.models.items()}
        if info.actor_version:
            versions[f"policy {run.policy}"] = info.actor_version
        if info.actor_privileged:
            facts[f"policy {run.policy} is privileged"] = "it sees task, scene and state"
            privileged.append(run.policy)
    report = Report(
        title=f"Evaluation of {' and '.join(run.policy for run in runs)} on {task}",
        runs=runs, facts=facts, versions=versions, command=shlex.join(["roboxim", *sys.argv[1:]]),
    )  # fmt: skip
    page = write_report(report, out)
    for name in privileged:
        click.echo(
            f"policy {name} is privileged: it was told task, scene and state, which no policy under test may see"
        )
    if len(runs) > 1:
        click.echo(verdict_line(runs))
    click.echo(f"report: {page}")
