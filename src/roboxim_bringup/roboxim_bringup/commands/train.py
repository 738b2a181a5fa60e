"""Train a policy on an exported dataset."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import click


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
    from roboxim_core.config import load_config
    from roboxim_policies.bc.config import BCConfig
    from roboxim_policies.bc.data import load_rlds
    from roboxim_policies.bc.train import Trainer, TrainProgress

    settings = load_config(config, BCConfig) if config else BCConfig()
    settings = replace(settings, **{k: v for k, v in {"steps": steps, "seed": seed}.items() if v is not None})
    started = time.monotonic()
    with ProgressLine("reading demonstrations", 1) as bar:
        data = load_rlds(
            dataset, image_sizes=settings.image_sizes, limit=limit, progress=lambda n, total: bar.update(n, total=total)
        )
    out.mkdir(parents=True, exist_ok=True)
    trainer = Trainer(data, settings, out)
    if trainer.step:
        click.echo(f"going on from step {trainer.step}")
    with ProgressLine("training", settings.steps, trainer.step) as bar:

        def show(progress: TrainProgress) -> None:
            bar.update(progress.step, f"loss {progress.loss:.3f}, {progress.steps_per_s:.1f} steps/s")

        path = trainer.run(show)
    click.echo(f"checkpoint after {trainer.step} steps, {time.monotonic() - started:.0f} s: {path}")
    click.echo(f"next: roboxim evaluate --policy bc --checkpoint {out} --policy random")
