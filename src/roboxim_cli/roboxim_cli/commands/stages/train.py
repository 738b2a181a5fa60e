"""Train a policy on an exported dataset."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from roboxim_cli import strict
from roboxim_cli.options import ABSENT_IS_ZERO, option, with_options


@strict.group()
def command() -> None:
    """Train a policy on an exported dataset."""


def _training(family: str, config: str) -> Callable[[Callable[[], None]], click.Command]:
    """Make a command that trains a family; its help is the decorated function's.

    Args:
        family: Name of the family and of the command.
        config: Name of the family's configuration class.
    """
    options = [
        click.argument("dataset", type=click.Path(path_type=Path)),
        option("out", default=f"runs/{family}", help="Folder of the checkpoint."),
        click.option("--steps", type=click.IntRange(1), help="Optimiser steps; default: the configuration's."),
        click.option("--seed", type=click.IntRange(0), help="Seed of weights, order and augmentation."),
        click.option(
            "--from", "start", type=click.Path(exists=True, path_type=Path), metavar="CHECKPOINT",
            help=f"Fine-tune a checkpoint of {family}: its weights and, unless given, its configuration.",
        ),
        click.option("--config", type=click.Path(path_type=Path), help=f"YAML file with {config}'s fields."),
        click.option(
            "--set", "changes", multiple=True, metavar="FIELD=VALUE",
            help=f"A field of {config}, e.g. chunk=4; may be repeated.",
        ),
        click.option(
            "--until", type=click.IntRange(1), default=None, help="End after this step for now; it can be continued."
        ),
        option(
            "episodes", **ABSENT_IS_ZERO, show_default="all", help="Largest number of episodes to use."
        ),
    ]  # fmt: skip

    def decorate(described: Callable[[], None]) -> click.Command:
        def train(**options: Any) -> None:
            _train(family, **options)

        train.__doc__ = described.__doc__
        return command.command(family, begins="training")(with_options(*options)(train))

    return decorate


@_training("bc", "BCConfig")
def behaviour_cloning() -> None:
    r"""Train a small behaviour-cloning network on a dataset of any format.

    \b
    roboxim train bc runs/demos-rlds --out runs/bc --steps 2000

    Ctrl-C saves a checkpoint. The same command continues from it and ends with the same weights. Processors suffice; a
    GPU is used where JAX has one.
    """


@_training("rt1s", "RT1SConfig")
def rt1s() -> None:
    r"""Train a small relative of RT-1: pre-trained encoders, tokens, a causal transformer over a history.

    \b
    roboxim train rt1s runs/demos-rlds --out runs/rt1s --steps 4000

    Needs the extra roboxim[pretrained]. The pictures are encoded once, at the first training on them; later ones find
    the result on disk. Ctrl-C saves a checkpoint, and the same command continues.
    """


@_training("act", "ACTConfig")
def act() -> None:
    r"""Train action chunks by a transformer (ACT) on pre-trained encoders.

    \b
    roboxim train act runs/demos-rlds --out runs/act --steps 4000

    Needs the extra roboxim[pretrained]. The pictures are encoded once, at the first training on them; later ones find
    the result on disk. Ctrl-C saves a checkpoint, and the same command continues.
    """


def _train(
    family: str, dataset: Path, out: Path, steps: int | None, seed: int | None, start: Path | None,
    config: Path | None, changes: tuple[str, ...], until: int | None, episodes: int,
) -> None:  # fmt: skip
    from roboxim_bringup.process import keep_freed_memory
    from roboxim_cli.field_options import training_fields
    from roboxim_cli.printer import EventPrinter
    from roboxim_core.plain_data.shell import shell_line
    from roboxim_runs.training.run import read_config, train_policy

    settings = read_config(family, config, training_fields(changes, steps=steps, seed=seed), start=start)
    keep_freed_memory()
    with EventPrinter() as printer:
        result = train_policy(
            dataset, out, settings, start=start or "", limit=episodes, until=until or 0, on_event=printer
        )
    if result.steps_now:
        click.echo(f"checkpoint after {result.steps} steps, {result.wall_s:.0f} s: {result.checkpoint}")
    else:
        reached = ""
        if until and until <= result.steps < settings.steps:
            reached = f", as --until {until} asks"
        elif result.steps < settings.steps:
            reached = ", after which the held-out loss no longer fell"
        click.echo(f"{result.checkpoint} has {result.steps} of {settings.steps} steps already{reached}; nothing to do")
    if result.chosen:
        click.echo(f"the policy has the weights of {result.chosen}")
    click.echo(f"next: roboxim evaluate --policy {family} --checkpoint {shell_line(out)} --policy random")
