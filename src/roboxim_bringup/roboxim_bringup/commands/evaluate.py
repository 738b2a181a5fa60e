"""Evaluate policies in fresh scenes; writes an HTML report."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from roboxim_bringup.options import episode_options

if TYPE_CHECKING:
    from collections.abc import Sequence

    from roboxim_bringup.graph import PolicyLaunch
    from roboxim_core.episode import EpisodeResult
    from roboxim_eval.report import PolicyRun

SHOWN = 12
"""Films per policy in the report, failures first."""


@click.command()
@click.option(
    "--policy", "policies", multiple=True, required=True, metavar="SPEC",
    help="bc, random, zero, replay, expert, module:Class or file.py:Class; may be repeated to compare.",
)  # fmt: skip
@click.option(
    "--checkpoint", type=click.Path(path_type=Path), help="Checkpoint of the bc policy: a file or its folder."
)
@click.option(
    "--option",
    "policy_options",
    multiple=True,
    metavar="KEY=VALUE",
    help="Argument of the first policy; may be repeated.",
)
@episode_options(episodes=20, out="runs/evaluation")
@click.option("--max-steps", type=click.IntRange(0), default=0, help="Actions per episode; 0: as the task says.")
@click.option(
    "--execute", type=click.IntRange(0), default=0, help="Actions executed per request; 0: the policy's horizon."
)
@click.option("--policy-timeout", default=30.0, show_default=True, help="Longest wait for an answer [s].")
def command(
    policies: tuple[str, ...], checkpoint: Path | None, policy_options: tuple[str, ...], task: str, skill: str,
    objects: tuple[str, ...], distractors: str, colors: str, out: Path, episodes: int, seed: int, workers: int,
    size: str, renderer: str, depth: bool, segmentation: bool, max_steps: int, execute: int, policy_timeout: float,
) -> None:  # fmt: skip
    r"""Run policies in fresh scenes, count successes, and write OUT/report.html.

    \b
    roboxim evaluate --policy bc --checkpoint runs/bc --policy random --episodes 20
    roboxim evaluate --policy my_module:MyPolicy

    Every policy meets the same scenes. Evaluation scenes are never those of demonstrations, whatever the seed. Ctrl-C
    stops; the same command goes on.
    """
    from roboxim_bringup.jobs import Job, failures, parse_size, registered_run, run_job
    from roboxim_bringup.task_choice import DEFAULT_TASK, task_text
    from roboxim_core.episode import RunConfig
    from roboxim_eval.statistics import rate_of

    width, height = parse_size(size)
    launches = [
        _launch(spec, checkpoint, policy_options if number == 0 else ()) for number, spec in enumerate(policies)
    ]
    text = task_text(task, skill=skill, objects=objects, distractors=distractors, colors=colors)
    runs = []
    with registered_run("evaluate"):
        for spec, launch in zip(policies, launches, strict=True):
            name = _name(spec)
            config = RunConfig(
                run_seed=seed, purpose="eval", actor="expert" if launch is None else launch.namespace, keep="all",
                task_config=text, image_width=width, image_height=height, depth=depth, segmentation=segmentation,
                max_steps=max_steps, execute=execute, policy_timeout_s=policy_timeout,
                output_dir=str((out / name).resolve()),
            )  # fmt: skip
            job = Job(
                config=config, episodes=episodes, workers=workers, renderer=renderer,
                policies=() if launch is None else (launch,),
            )  # fmt: skip
            results = run_job(job, f"rollouts of {name}")
            runs.append(_policy_run(name, results, out / name))
            click.echo(f"{name}: {rate_of(results)}")
            for line in failures(results):
                click.echo(line)
    _report(runs, out, task=Path(task).stem or skill or DEFAULT_TASK, seed=seed)


def _name(spec: str) -> str:
    return Path(spec).name.rpartition(":")[2] or spec


def _launch(spec: str, checkpoint: Path | None, options: Sequence[str]) -> PolicyLaunch | None:
    """Return how to serve a policy in the workers; none for the expert, which the task node serves."""
    from dataclasses import replace

    from roboxim_bringup.graph import PolicyLaunch
    from roboxim_bringup.parameters import parse_options
    from roboxim_core.errors import ConfigError

    if spec == "expert":
        return None
    launch = PolicyLaunch(spec=spec, options=parse_options(options))
    if spec == "bc":
        if checkpoint is None:
            raise ConfigError("--policy bc needs --checkpoint, e.g. the folder that roboxim train bc wrote")
        if not checkpoint.exists():
            raise ConfigError(f"no checkpoint at {checkpoint}; make one with roboxim train bc")
        launch = replace(launch, options={**launch.options, "checkpoint": str(checkpoint.resolve())})
    return launch


def _policy_run(name: str, results: Sequence[EpisodeResult], folder: Path) -> PolicyRun:
    from roboxim_bringup.jobs import drawn_by_name, film
    from roboxim_eval.report import PolicyRun

    recorded = [result for result in results if result.bag]
    failed = [result for result in recorded if result.outcome != "success"][: SHOWN // 2]
    solved = [result for result in recorded if result.outcome == "success"][: SHOWN - len(failed)]
    films = {result.episode_id: film(folder / result.bag) for result in failed + solved}
    drawn = {result.episode_id: drawn_by_name(folder / result.bag) for result in recorded}
    return PolicyRun(policy=name, results=results, films=films, drawn=drawn)


def _report(runs: Sequence[PolicyRun], out: Path, *, task: str, seed: int) -> None:
    from roboxim_eval.report import Report, verdict_line, write_report
    from roboxim_recorder.bag import BagReader

    facts = {"task": task, "run seed": str(seed), "purpose": "eval", "episodes": str(len(runs[0].results))}
    versions: dict[str, str] = {}
    for run in runs:
        first = next((result for result in run.results if result.bag), None)
        if first is None:
            continue
        info = BagReader(out / run.policy / first.bag).info
        facts |= {"renderer": info.renderer, "control rate": f"{info.semantics.rate_hz:g} Hz"}
        facts |= {f"camera {c.name}": f"{c.width} x {c.height}" for c in info.scene.cameras}
        versions |= info.versions
    report = Report(
        title=f"Evaluation of {' and '.join(run.policy for run in runs)} on {task}",
        runs=runs, facts=facts, versions=versions, command=shlex.join(["roboxim", *sys.argv[1:]]),
    )  # fmt: skip
    page = write_report(report, out)
    for name, version in versions.items():
        if name.startswith("policy ") and version.endswith(", privileged"):
            click.echo(f"{name} is privileged: it was told task, scene and state, which no policy under test may see")
    if len(runs) > 1:
        click.echo(verdict_line(runs))
    click.echo(f"report: {page}")
