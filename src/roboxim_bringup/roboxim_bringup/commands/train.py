"""Train a policy on an exported dataset."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from roboxim_policies.bc.config import BCConfig


@click.group()
def command() -> None:
    """Train a policy on an exported dataset."""


@command.command("bc")
@click.argument("dataset", type=click.Path(path_type=Path))
@click.option(
    "--out", type=click.Path(path_type=Path), default="runs/bc", show_default=True, help="Folder of the checkpoint."
)
@click.option("--steps", type=click.IntRange(1), help="Optimiser steps; default: the configuration's.")
@click.option("--seed", type=click.IntRange(0), help="Seed of weights, order and augmentation.")
@click.option("--config", type=click.Path(path_type=Path), help="YAML file with BCConfig's fields.")
@click.option("--limit", type=click.IntRange(0), default=0, help="Use at most so many episodes; 0: all.")
def behaviour_cloning(
    dataset: Path, out: Path, steps: int | None, seed: int | None, config: Path | None, limit: int
) -> None:
    r"""Train a small behaviour-cloning network on an RLDS export, on CPU.

    \b
    roboxim train bc runs/demos-rlds --out runs/bc --steps 2000

    Ctrl-C saves a checkpoint; the same command goes on and ends in the same weights.
    """
    from roboxim_bringup.progress import ProgressLine
    from roboxim_bringup.run_folder import make_folder
    from roboxim_policies.bc.data import load_rlds
    from roboxim_policies.bc.train import Trainer, TrainProgress

    settings = _settings(config)
    given: dict[str, Any] = {key: value for key, value in {"steps": steps, "seed": seed}.items() if value is not None}
    settings = replace(settings, **given)
    if out.is_file():
        make_folder(out)  # says so
    started = time.monotonic()
    with ProgressLine("reading demonstrations", 1) as bar:
        data = load_rlds(
            dataset, image_sizes=settings.image_sizes, limit=limit, progress=lambda n, total: bar.update(n, total=total)
        )
    make_folder(out)
    trainer = Trainer(data, settings, out)
    if trainer.step >= settings.steps:
        click.echo(f"{trainer.path} has all {trainer.step} steps already; nothing to do")
        click.echo(f"next: {_evaluate(out)}")
        return
    if trainer.step:
        click.echo(f"going on from step {trainer.step}")
    try:
        with ProgressLine("training", settings.steps, trainer.step, unit="steps") as bar:

            def show(progress: TrainProgress) -> None:
                bar.update(progress.step, f"loss {progress.loss:.3f}, {progress.steps_per_s:.1f} steps/s")

            path = trainer.run(show)
    except KeyboardInterrupt:
        click.echo(
            f"checkpoint after {trainer.step} of {settings.steps} steps: {trainer.path}; the same command goes on",
            err=True,
        )
        raise
    click.echo(f"checkpoint after {trainer.step} steps, {time.monotonic() - started:.0f} s: {path}")
    click.echo(f"next: {_evaluate(out)}")


def _evaluate(out: Path) -> str:
    return f"roboxim evaluate --policy bc --checkpoint {out} --policy random"


def _settings(file: Path | None) -> BCConfig:
    """Read a training's configuration; none: the defaults.

    Raises:
        ConfigError: When the file is missing, empty or wrong.
    """
    from roboxim_core.config import load_config, load_yaml
    from roboxim_core.errors import ConfigError
    from roboxim_policies.bc.config import BCConfig

    if file is None:
        return BCConfig()
    if load_yaml(file) is None:
        raise ConfigError(f"{file} is empty; expected fields such as 'steps: 500', or leave --config out")
    return load_config(file, BCConfig)
