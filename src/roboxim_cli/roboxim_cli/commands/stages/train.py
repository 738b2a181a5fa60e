"""Train a policy on an exported dataset."""

from __future__ import annotations

from pathlib import Path

import click

from roboxim_cli import strict
from roboxim_cli.options import option


@strict.group()
def command() -> None:
    """Train a policy on an exported dataset."""


@command.command("bc", begins="training", old={"--limit": "--episodes"})
@click.argument("dataset", type=click.Path(path_type=Path))
@click.option(
    "--out", type=click.Path(path_type=Path), default="runs/bc", show_default=True, help="Folder of the checkpoint."
)
@click.option("--steps", type=click.IntRange(1), help="Optimiser steps; default: the configuration's.")
@click.option("--seed", type=click.IntRange(0), help="Seed of weights, order and augmentation.")
@click.option("--config", type=click.Path(path_type=Path), help="YAML file with BCConfig's fields.")
@click.option(
    "--set", "changes", multiple=True, metavar="FIELD=VALUE", help="A field of BCConfig, e.g. depth=2; may be repeated."
)
@click.option("--until", type=click.IntRange(1), default=None, help="End after this step for now; it can be continued.")
@option("episodes", type=click.IntRange(0), default=0, show_default="all", help="Largest number of episodes to use.")
def behaviour_cloning(
    dataset: Path, out: Path, steps: int | None, seed: int | None, config: Path | None, changes: tuple[str, ...],
    until: int | None, episodes: int,
) -> None:  # fmt: skip
    r"""Train a small behaviour-cloning network on a dataset of any format.

    \b
    roboxim train bc runs/demos-rlds --out runs/bc --steps 2000

    Ctrl-C saves a checkpoint. The same command continues from it and ends with the same weights. Processors suffice; a
    GPU is used where JAX has one.
    """
    from roboxim_bringup.parameters import parse_options
    from roboxim_bringup.process import keep_freed_memory
    from roboxim_cli.printer import EventPrinter
    from roboxim_runs.training.run import read_bc_config, train_bc

    given = {"steps": steps, "seed": seed}
    settings = read_bc_config(config, {**parse_options(changes), **{k: v for k, v in given.items() if v is not None}})
    keep_freed_memory()
    with EventPrinter() as printer:
        result = train_bc(dataset, out, settings, limit=episodes, until=until or 0, on_event=printer)
    if result.steps_now:
        click.echo(f"checkpoint after {result.steps} steps, {result.wall_s:.0f} s: {result.checkpoint}")
    else:
        click.echo(f"{result.checkpoint} has all {result.steps} steps already; nothing to do")
    click.echo(f"next: roboxim evaluate --policy bc --checkpoint {out} --policy random")
