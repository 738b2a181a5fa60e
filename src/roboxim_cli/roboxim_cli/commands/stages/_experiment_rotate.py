"""Write the parts of a rotated design, and join their results."""

from __future__ import annotations

from pathlib import Path

import click

from roboxim_cli import strict
from roboxim_cli.named import Named
from roboxim_cli.options import option, print_json
from roboxim_core.errors import counted


@strict.command("rotate", begins="planning the parts")
@click.argument("name", type=Named("experiment"))
@option("scale")
@option("trainer")
@click.option("--sets", type=click.IntRange(3), required=True, help="Number of held-out sets, each a part.")
@click.option("--held-out", type=click.IntRange(1), required=True, help="Cells of each set.")
@click.option("--replicates", type=click.IntRange(1), default=1, show_default=True, help="Trainings of a part.")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Folder of the files to write.")
def rotate(name: str, scale: str, trainer: str, sets: int, held_out: int, replicates: int, out: Path) -> None:
    r"""Write an experiment whose held-out set rotates: a file for each set, and a benchmark of all of them.

    \b
    roboxim experiment rotate skill_object --scale laptop --sets 6 --held-out 3 --out mine
    ROBOXIM_CONFIG_PATH=mine roboxim benchmark mine/benchmark/skill_object_rotated.yaml --out runs/rotated
    roboxim experiment join runs/rotated/*/card.json

    The sets are disjoint. Each holds out the levels of every factor equally often, and leaves every level to be seen.
    """
    from roboxim_core.plain_data.shell import shell_line
    from roboxim_runs.experiments.files import load_experiment, run_words, write_rotated

    paths = write_rotated(name, scale, trainer, sets, held_out, replicates, out)
    for path in paths:
        click.echo(f"wrote {path}")
    run = run_words(paths[-1], load_experiment(str(paths[0])), trainer, "benchmark")
    click.echo(f"next: ROBOXIM_CONFIG_PATH={shell_line(out)} {run}")
    click.echo("then: roboxim experiment join OUT/*/card.json")


@strict.command("join", begins="joining")
@click.argument("cards", nargs=-1, required=True, type=click.Path(path_type=Path, exists=True, dir_okay=False))
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def join(cards: tuple[Path, ...], as_json: bool) -> None:
    """Print the scores of a rotated design from the cards of its parts, with both intervals of the gap."""
    from roboxim_eval.experiments.card_checks import plain_interval
    from roboxim_eval.experiments.rotation import joined
    from roboxim_runs.experiments.report import stored_card

    loaded = [stored_card(path) for path in cards]
    found = joined(loaded)
    for path, card in zip(cards, loaded, strict=True):
        for warning in card.warnings:
            click.echo(f"{path} warns: {warning}", err=True)
    sampled = found.gap_of_all_cells
    if as_json:
        intervals = {
            "absolute": found.absolute, "baseline": found.baseline, "gap_cells_random": sampled,
            "gap_cells_fixed": found.gap_of_these_cells,
        }  # fmt: skip
        sizes = {"sets": found.sets, "cells": found.cells, "trainings": found.trainings, "p": found.p_value}
        print_json(sizes | {key: plain_interval(one) for key, one in intervals.items()})
        return
    click.echo(
        f"{found.sets} held-out sets of {counted(found.cells, 'cell')}, "
        f"{counted(found.trainings, 'training')} of each condition a set"
    )
    click.echo(f"  absolute  {found.absolute}")
    click.echo(f"  baseline  {found.baseline}")
    click.echo(f"  gap       {sampled}, cells as a sample; p {found.p_value:.2g}")
    click.echo(f"  gap       {found.gap_of_these_cells}, these cells")
