"""Evaluate policies in fresh scenes; writes an HTML report."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from roboxim_cli import strict
from roboxim_cli.commands.answers._policies import policy_options
from roboxim_cli.named import Named
from roboxim_cli.options import episode_options, film_options
from roboxim_core.plain_data.shell import shell_line


@strict.command(begins="evaluating")
@click.option(
    "--policy", "policies", type=Named("policy", "expert"), multiple=True, required=True, metavar="[NAME=]SPEC",
    help="bc, random, zero, replay, expert, module:Class or file.py:Class; may be repeated to compare. NAME is "
    "shown in the report; two policies of one class need names.",
)  # fmt: skip
@policy_options
@episode_options(episodes=20, out="runs/evaluation")
@click.option("--max-steps", type=click.IntRange(0), default=0, help="Actions per episode; 0: the task's limit.")
@click.option("--window", type=click.IntRange(0), default=0, help="Observations per request; 0: the policy's window.")
@click.option(
    "--execute", type=click.IntRange(0), default=0,
    help="Actions executed per request; 0: as the policy says, by default its horizon.",
)  # fmt: skip
@click.option(
    "--ensemble", type=click.Choice(["newest", "mean", "exponential"]), default=None,
    help="Combine several answers for one tick: the last one, the mean, or weights exp(-K i) with i = 0 the oldest.",
)  # fmt: skip
@click.option(
    "--ensemble-decay", type=float, default=0.0, metavar="K",
    help="K of --ensemble exponential: K > 0 prefers older answers (Octo, ACT), K < 0 newer ones.",
)  # fmt: skip
@click.option(
    "--late-rows", type=click.Choice(["shift", "drop"]), default=None,
    help="Of a late answer, execute all actions late (shift) or leave out those whose tick has passed (drop).",
)  # fmt: skip
@click.option(
    "--gripper-band", type=click.FloatRange(0, 1), default=0.0, metavar="WIDTH",
    help="Width of the band around half open in which the gripper keeps its command.",
)  # fmt: skip
@click.option(
    "--gripper-agree", type=click.IntRange(0), default=0, metavar="N",
    help="Successive actions that must agree before the gripper switches.",
)  # fmt: skip
@click.option(
    "--latency", type=click.IntRange(0), default=0, metavar="TICKS", help="Let every answer arrive TICKS late."
)
@click.option(
    "--real-time", is_flag=True,
    help="Let simulated time pass while the policy computes. Such an evaluation is not repeatable.",
)  # fmt: skip
@click.option(
    "--policy-timeout", type=click.FloatRange(0), default=120.0, show_default=True,
    help="Longest wait for an answer [s].",
)  # fmt: skip
@click.option(
    "--server-wait", "server_wait_s", type=click.FloatRange(0), default=180.0, show_default=True, metavar="SECONDS",
    help="Longest wait for a missing policy server; then the run stops, and the same command continues it.",
)  # fmt: skip
@click.option(
    "--stop-early", "looks", type=click.IntRange(2), metavar="LOOKS",
    help="Stop before --episodes at one of LOOKS evenly spaced looks if two policies differ by then.",
)  # fmt: skip
@click.option(
    "--policy-servers", type=click.IntRange(0, 1000), default=0, metavar="N",
    help="Serve each policy from N processes to all workers; 0: each worker has the policy itself.",
)  # fmt: skip
@click.option(
    "--policy-resources", default="", metavar="NAME=N,...",
    help="What a policy server takes of a Ray node, e.g. GPU=1; implies --policy-servers 1.",
)  # fmt: skip
@click.option("--other-robot", is_flag=True, help="Allow a robot other than the one that the policy was trained with.")
@film_options()
def command(
    policies: tuple[str, ...], checkpoints: tuple[str, ...], policy_options: tuple[str, ...], size: str,
    policy_timeout: float, ensemble: str | None, late_rows: str | None, looks: int | None, executor: str, address: str,
    resources: str, policy_servers: int, policy_resources: str, **options: Any,
) -> None:  # fmt: skip
    r"""Run policies in fresh scenes, count successes, and write OUT/report.html.

    \b
    roboxim evaluate --policy bc --checkpoint runs/bc --policy random --episodes 20
    roboxim evaluate --policy my_module:MyPolicy --suite core
    roboxim evaluate --policy openpi --option url=ws://host:8000 --option convention=libero --option version=pi05_libero
    roboxim evaluate --policy old=bc --checkpoint old=runs/bc --policy new=bc --checkpoint new=runs/bc2

    Every policy meets the same scenes. Evaluation scenes are never those of demonstrations, whatever the seed. Ctrl-C
    stops; the same command continues. A policy whose file or checkpoint has changed since needs another --out.
    """
    from contextlib import nullcontext

    from roboxim_cli.options import make_executor, make_policy_servers, parse_films, parse_size
    from roboxim_runs.policies.specs import choose_policies

    image_size = parse_size(size)
    chosen = choose_policies(policies, checkpoints, policy_options)  # before the slow imports

    from roboxim_cli.printer import EventPrinter
    from roboxim_runs.evaluation.run import EvaluationConfig, evaluate

    config = EvaluationConfig(
        policies=chosen, size=image_size, policy_timeout_s=policy_timeout, ensemble=ensemble or "",
        late_rows=late_rows or "", command=shell_line("roboxim", *sys.argv[1:]), film=parse_films(options), **options,
    )  # fmt: skip
    runs_on = make_executor(executor, address, resources, config.workers)
    serves = make_policy_servers(executor, address, policy_resources, policy_servers, Path(config.out))
    with EventPrinter() as printer, runs_on or nullcontext():
        if looks is None:
            result, stopped = evaluate(config, on_event=printer, executor=runs_on, servers=serves), ""
        else:
            from roboxim_runs.evaluation.sequential import evaluate_sequentially

            found = evaluate_sequentially(config, looks, on_event=printer, executor=runs_on, servers=serves)
            result, stopped = found.evaluation, found.sentence
    for name in result.privileged:
        click.echo(
            f"policy {name} is privileged: it received the task, scene and state, "
            "which a policy under test must not see"
        )
    for line in (*result.doubts, *result.by_skill, stopped, result.comparison):
        if line:
            click.echo(line)
    click.echo(f"report: {result.report}")
    failed = next((one.index for one in result.results if one.outcome == "failure" and one.bag), None)
    if failed is not None:
        click.echo(f"why episode {failed} failed: {shell_line('roboxim', 'show', config.out, failed)}")
    result.require_measured()
