"""Write the next round of demonstrations as an experiment."""

from __future__ import annotations

from pathlib import Path

import click

from roboxim_cli import strict
from roboxim_cli.options import option


@strict.command("collect", begins="choosing demonstrations")
@click.argument("card", type=click.Path(path_type=Path, exists=True, dir_okay=False))
@click.option(
    "--demonstrations", type=click.IntRange(1), required=True, metavar="N", help="New demonstrations of each arm."
)
@click.option(
    "--condition", default="", help="Condition whose weak cells decide; default: the one that the card is for."
)
@option("out", required=True, metavar="FILE", help="Write the experiment, for 'experiment run FILE'.")
def collect(card: Path, demonstrations: int, condition: str, out: Path) -> None:
    r"""Write an experiment about which demonstrations to record next: where a policy failed, or evenly.

    \b
    roboxim experiment collect runs/so/card.json --demonstrations 90 --out round1.yaml
    roboxim experiment run round1.yaml --out runs/round1
    roboxim experiment collect runs/round1/card.json --demonstrations 90 --out round2.yaml

    Both arms have the demonstrations of before and N new ones, and at least three trainings. The expert records them.
    """
    from roboxim_eval.experiments.collection import next_round
    from roboxim_runs.experiments.files import checked_design, run_words, write_experiment
    from roboxim_runs.experiments.report import stored_card

    known = stored_card(card)
    found = next_round(known, demonstrations, condition)
    checked_design(out.stem, found.config, known.experiment.trainer)
    write_experiment(found.config, out)
    width = max(map(len, found.chosen))
    click.echo(f"{'new demonstrations':<{width}}  made to order  uniform  success so far")
    for cell, count in found.success.items():
        rate = f"{count.successes} of {count.episodes}"
        click.echo(f"{cell:<{width}}  {found.chosen[cell]:>13}  {found.even[cell]:>7}  {rate}")
    for sentence in known.warnings:  # e.g. that its failures are errors
        click.echo(f"The card warns: {sentence}")
    click.echo(f"wrote {out}: {run_words(out, found.config, known.experiment.trainer)}")
