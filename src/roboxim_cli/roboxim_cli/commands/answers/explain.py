"""Run a failed episode again with one thing changed, and name the cause of its failure."""

from __future__ import annotations

from pathlib import Path

import click

from roboxim_cli import strict
from roboxim_cli.commands.answers._policies import policy_options
from roboxim_cli.options import print_json
from roboxim_core.errors import counted


@strict.command(begins="looking for causes")
@click.argument("place", metavar="EPISODE", type=click.Path(exists=True, path_type=Path))
@click.argument("number", type=click.IntRange(0), required=False)
@click.option("--policy", required=True, metavar="SPEC", help="The policy that failed, as evaluate takes it.")
@policy_options
@click.option("--repeats", type=click.IntRange(3), default=5, show_default=True, help="Runs of each change.")
@click.option("--change", "only", multiple=True, metavar="NAME", help="Try only this change; may be repeated.")
@click.option(
    "--pairs/--no-pairs", default=True, show_default=True, help="Try pairs of changes if no single one is a cause."
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(
    place: Path, number: int | None, policy: str, checkpoints: tuple[str, ...], policy_options: tuple[str, ...],
    repeats: int, only: tuple[str, ...], pairs: bool, as_json: bool,
) -> None:  # fmt: skip
    r"""Run a failed episode again with one thing changed, a few times each, and name what it failed by.

    \b
    roboxim explain runs/evaluation 7 --policy bc --checkpoint runs/bc
    roboxim explain runs/evaluation/bc/episodes/eval-0-00007-0 --policy bc --checkpoint runs/bc --change distractors

    EPISODE is a bag, or the folder of a run or an evaluation with the episode's NUMBER. Changes: distractors, color,
    camera, light, surfaces, physics, words, start, place; those that are nominal in the episode are left out. A policy
    that is not the recorded one is said to be another, and refused where the outcome is not repeated.
    """
    import dataclasses

    from roboxim_cli.commands.answers._policies import chosen
    from roboxim_eval.answers.causes import Tally
    from roboxim_recorder.bag import BagReader
    from roboxim_runs.answers.explaining import ExplainConfig, explain
    from roboxim_runs.answers.trying import TryBench
    from roboxim_runs.evaluation.finding import find_episode

    config = ExplainConfig(repeats=repeats, only=only, pairs=pairs)
    policies = chosen([policy], checkpoints, policy_options)
    bag = BagReader(find_episode(place, number).bag)
    info = bag.info

    def print_tally(tally: Tally) -> None:
        click.echo(f"  {tally.words}: {tally.successes} of {tally.runs}", err=as_json)

    click.echo(f"{info.episode_id}: {info.task.instruction}", err=as_json)
    with TryBench() as bench:
        found = explain(
            bench, info, bench.actor(policies[0]), config, recorded=bag.result, on_tally=print_tally,
            on_doubt=lambda sentence: click.echo(f"  but: {sentence}", err=True),
        )  # fmt: skip
        runs = bench.runs
    if as_json:
        print_json(dataclasses.asdict(found) | {"sentence": found.sentence, "runs": runs})
        return
    click.echo(found.sentence)
    click.echo(counted(runs, "run"))
