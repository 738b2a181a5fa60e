"""Train a policy on a broad mix of demonstrations, as a start for fine-tuning."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from roboxim_cli import strict
from roboxim_cli.options import ABSENT_IS_ZERO, option
from roboxim_core.errors import counted
from roboxim_policies.learning.families import FAMILIES


@strict.command(begins="pre-training")
@click.argument("family", type=click.Choice(list(FAMILIES)))
@option("out", default="runs/pretrain", help="Folder of everything.")
@click.option("--name", default="", help="Name of the checkpoint; default: that of the folder.")
@option("suite", default="pretrain", show_default=True, help="Suite of config/suites that is demonstrated.")
@option("episodes", **ABSENT_IS_ZERO, show_default="the suite's", help="Number of demonstrations.")
@click.option("--steps", type=click.IntRange(1), help="Optimiser steps; default: the configuration's.")
@click.option("--config", type=click.Path(path_type=Path), help="YAML file with fields of the family's configuration.")
@click.option(
    "--set",
    "changes",
    multiple=True,
    metavar="FIELD=VALUE",
    help="A field of the configuration, e.g. chunk=4; may be repeated.",
)
@option("seed", default=None, show_default="0, or that of --config or --set")
@option("size", default="128", help="Image size.")
@option("workers", default=2)
@option("renderer", default="raster")
def command(
    family: str, steps: int | None, config: Path | None, changes: tuple[str, ...], seed: int | None, size: Any,
    **options: Any,
) -> None:  # fmt: skip
    r"""Train a policy of FAMILY on a broad mix of skills, objects, rooms and cameras.

    \b
    roboxim pretrain act --out runs/broad --episodes 288 --steps 8000
    roboxim train act runs/demos-rlds --from runs/broad/broad.npz --steps 1000

    Ctrl-C stops; the same command continues. OUT/NAME.npz has the weights, and what was demonstrated:
    OUT/exposure.json counts skills, objects, looks and cameras in the recorded episodes.
    """
    from roboxim_bringup.process import keep_freed_memory
    from roboxim_cli.field_options import training_fields
    from roboxim_cli.options import parse_size
    from roboxim_cli.printer import EventPrinter
    from roboxim_core.plain_data.shell import shell_line
    from roboxim_runs.training.pretraining import PretrainConfig, pretrain
    from roboxim_runs.training.run import read_config

    learning = read_config(family, config, training_fields(changes, seed=seed, steps=steps))
    keep_freed_memory()
    with EventPrinter() as printer:
        result = pretrain(
            PretrainConfig(learning=learning, size=parse_size(size), seed=learning.seed, **options), on_event=printer
        )
    exposure = result.exposure
    click.echo(
        f"{result.checkpoint}: {counted(exposure['episodes'], 'demonstration')} of "
        f"{counted(len(exposure['skills']), 'skill')} with {counted(len(exposure['objects']), 'object')} in "
        f"{counted(len(exposure['looks']), 'look')}; {counted(result.training.steps, 'step')}"
    )
    click.echo(f"next: roboxim train {family} DATASET --from {shell_line(result.checkpoint)} --steps 1000")
