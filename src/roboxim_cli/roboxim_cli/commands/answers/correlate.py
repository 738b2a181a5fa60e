"""Compare two benchmarks of the same policies: does one predict the other?"""

from __future__ import annotations

from pathlib import Path

import click

from roboxim_cli import strict
from roboxim_cli.options import option, print_json


@strict.command(begins="comparing benchmarks")
@click.argument("table", type=click.Path(path_type=Path, exists=True))
@click.argument("ours", nargs=-1, required=True, type=click.Path(path_type=Path, exists=True))
@click.option("--names", default="reality,simulation", show_default=True, metavar="A,B", help="Names of both.")
@click.option(
    "--threshold", "limit", default=0.5, show_default=True, type=click.FloatRange(-1, 1),
    help="Correlation that more policies are to show.",
)  # fmt: skip
@click.option("--no-plan", is_flag=True, help="Do not simulate how many policies would decide it.")
@option("seed", help="Seed of the interval's draws.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(
    table: Path, ours: tuple[Path, ...], names: str, limit: float, no_plan: bool, seed: int, as_json: bool
) -> None:  # fmt: skip
    r"""Say how well OURS predict the results of the same policies in TABLE, e.g. on real robots.

    \b
    roboxim correlate real.csv runs/evaluation
    roboxim correlate real.csv runs/so/card.json simulated.csv
    roboxim correlate runs/raster runs/tiny --names raster,tiny

    Both are tables (.csv or .json with policy, successes, trials and, for several tasks, cell), folders of evaluations
    or experiments, or cards. Policies are matched by name; those of an experiment are CONDITION and CONDITION.R.
    """
    import dataclasses
    import math

    from roboxim_core.errors import ConfigError
    from roboxim_eval.statistics.correlation import needed_policies, sentences
    from roboxim_runs.answers.correlating import correlated

    both = [word.strip() for word in names.split(",")]
    if len(both) != 2 or not all(both) or both[0] == both[1]:
        raise ConfigError(f"--names: expected two different names with a comma between them, got '{names}'")
    found = correlated(table, ours, seed=seed)
    needed = None if no_plan else needed_policies(found, limit=limit, seed=seed)
    found_sentences = sentences(found, (both[0], both[1]))
    if as_json:
        data = dataclasses.asdict(found) | {"needed": None if needed is None else dataclasses.asdict(needed)}
        data["pearson"]["value"] = None if math.isnan(found.pearson.value) else found.pearson.value
        print_json({**data, "sentences": found_sentences})
        return
    width = max(len(policy.name) for policy in found.policies)
    click.echo(f"{'':<{width}}  {both[0]:>12}  {both[1]:>12}")
    for policy in found.policies:
        one, two = (
            f"{100 * rate:.0f} % of {side[1]:.0f}"
            for rate, side in zip(policy.rates, (policy.first, policy.second), strict=True)
        )
        click.echo(f"{policy.name:<{width}}  {one:>12}  {two:>12}")
    if not all(policy.even for policy in found.policies):
        click.echo(
            "Cells have different numbers of rollouts: rates are means over cells, and the numbers are those of "
            "equally full cells that would give them as exactly."
        )
    for sentence in found_sentences:
        click.echo(sentence)
    if needed is not None:
        click.echo(needed.sentence)
