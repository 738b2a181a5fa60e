"""Search a task's continuous factors for regions where a policy fails."""

from __future__ import annotations

from pathlib import Path

import click

from roboxim_cli import strict
from roboxim_cli.commands.answers._policies import policy_options
from roboxim_cli.options import option, print_json
from roboxim_core.errors import counted


@strict.command(begins="looking for failures")
@click.argument("policy", metavar="POLICY")
@policy_options
@option("task")
@click.option(
    "--factor", "factors", multiple=True, metavar="NAME", help="Vary only this range of the task, by its path."
)
@click.option("--first", type=click.IntRange(6), default=32, show_default=True, help="Points of the first sample.")
@click.option("--rounds", type=click.IntRange(0), default=4, show_default=True, help="Rounds of refinement.")
@click.option(
    "--confirm",
    type=click.IntRange(6),
    default=12,
    show_default=True,
    help="Fresh scenes inside a region, and as many outside.",
)
@option("seed")
@option("size", help="Image size of cameras for which the policy states none.")
@option("out", help="Folder for the outcomes so far and for bags of failed scenes, two of each region; default: none.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(
    policy: str, checkpoints: tuple[str, ...], policy_options: tuple[str, ...], task: str, factors: tuple[str, ...],
    first: int, rounds: int, confirm: int, seed: int, size: str, out: Path | None, as_json: bool,
) -> None:  # fmt: skip
    r"""Search a task's continuous factors for regions where POLICY fails.

    \b
    roboxim mine bc --checkpoint runs/bc --task pick_cube
    roboxim mine bc --checkpoint runs/bc --task pick_cube_randomised --factor reset.objects.area --out runs/mined

    Each range {lower, upper} of the task is a factor. A failure counts only if the expert solves the scene. A region
    counts only if fresh scenes confirm it. With --out, the same command continues a search that was stopped.
    """
    from roboxim_cli.commands.answers._policies import chosen
    from roboxim_cli.options import parse_size
    from roboxim_core.episode import RunConfig
    from roboxim_eval.answers.regions import SearchConfig
    from roboxim_runs.answers.mining import MineConfig, mine
    from roboxim_runs.answers.trying import TryBench
    from roboxim_runs.episodes.task_choice import task_text

    (one,) = chosen([policy], checkpoints, policy_options)
    width, height = parse_size(size)
    config = MineConfig(
        task_config=task_text(task or "pick_cube"), factors=factors,
        search=SearchConfig(first=first, rounds=rounds, confirm=confirm, seed=seed),
        run=RunConfig(image_width=width, image_height=height),
        policy={} if out is None else one.identity(out),
    )  # fmt: skip

    def print_rollout(number: int, failed: bool | None) -> None:
        if number % 10 == 9:
            click.echo(f"{number + 1} scenes", err=True)

    with TryBench() as bench:
        found = mine(bench, bench.actor(one), config, out=out, on_rollout=print_rollout)
    if as_json:
        print_json(found)
        return
    for region in found.regions:
        (a, n), (b, m) = region.inside, region.outside
        word = "fails where" if region.confirmed else "not confirmed:"
        click.echo(f"{word} {region.words}: {a} of {n} fresh scenes there, {b} of {m} elsewhere (p {region.p:.2g})")
        for bag in found.bags.get(region.words, ()):
            click.echo(f"  {bag}")
    if not any(region.confirmed for region in found.regions):
        click.echo("no region was confirmed")
    click.echo(
        f"{counted(found.failures, 'failure')} in {counted(found.rollouts, 'rollout')} over "
        f"{', '.join(factor.name for factor in found.factors)}; "
        f"{counted(found.unsolved, 'scene')} not solved by the expert, "
        f"{counted(found.infeasible, 'point')} without a scene"
    )
