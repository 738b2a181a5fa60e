"""What pairing trainings by their seed gains: the spread of differences between two arms.

Two arms train ``bc`` on six tenths of a dataset each and share half of that; a tenth is for validation. Each seed
trains both: they have the same initial weights and augmentation, and what they share in the same order. A row has, for
an error on the held-out demonstrations, the standard deviation of its difference between the arms over pairs of one
seed, and the one that pairs of different seeds would have. The headline is the ratio of both for the error of the
motion.

    make bench-pairs ARGS="--dataset runs/demo/rlds --pairs 8 --steps 400"
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import asdict, replace
from pathlib import Path

import click
import numpy as np
from benchmarks._harness import Bench

from roboxim_policies.bc.config import BCConfig
from roboxim_policies.learning.checkpoint import load_checkpoint
from roboxim_policies.learning.data import Demonstration, Demonstrations, assemble, read_demonstrations
from roboxim_policies.learning.train import Trainer
from roboxim_policies.learning.validation import validate

SIDE = 64
"""Side of the images [px]."""


def main() -> None:
    """Train and print."""
    bench = Bench("pairs", __doc__, _options)
    options = bench.options
    pairs, steps = (3, 30) if bench.quick else (options.pairs, options.steps)
    reading = read_demonstrations(options.dataset, side_of=lambda camera: SIDE)
    every = reading.assemble()
    config = BCConfig(steps=steps, checkpoint_every=steps, image_sizes=dict.fromkeys(every.images, SIDE))

    def arm(episodes: list[Demonstration]) -> Demonstrations:
        return assemble(
            episodes, camera_sizes=reading.camera_sizes, semantics=reading.semantics, robot=reading.robot, like=every
        )

    tenth = len(reading.episodes) // 10
    if not tenth:
        raise SystemExit(f"{options.dataset} has {len(reading.episodes)} demonstrations, expected at least 10")
    arms = arm(reading.episodes[: 6 * tenth]), arm(reading.episodes[3 * tenth : 9 * tenth])
    held_out = arm(reading.episodes[9 * tenth :])
    errors: list[list[dict[str, float]]] = [[], []]
    for seed in range(pairs):
        for found, data in zip(errors, arms, strict=True):
            found.append(_errors(data, held_out, replace(config, seed=seed)))
        click.echo(f"pair {seed + 1} of {pairs}", err=True)
    ratios = {}
    for name in errors[0][0]:
        one, other = (np.array([each[name] for each in found]) for found in errors)
        paired, apart = np.std(one - other, ddof=1), np.sqrt(np.var(one, ddof=1) + np.var(other, ddof=1))
        ratios[name] = float(paired / apart) if apart else float("nan")
        bench.row(
            error=name, mean=round(float(np.mean([one, other])), 3), sd_of_pairs=round(float(paired), 3),
            sd_of_other_seeds=round(float(apart), 3), correlation=round(float(np.corrcoef(one, other)[0, 1]), 2),
        )  # fmt: skip
    bench.finish("spread of differences, pairs of one seed relative to others", ratios["motion_mm"], "", at_most=1.0)


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--dataset", type=Path, required=True, metavar="DIR", help="demonstrations of one task")
    parser.add_argument("--pairs", type=int, default=8, metavar="N", help="number of seeds")
    parser.add_argument("--steps", type=int, default=400, metavar="N", help="training steps")


def _errors(data: Demonstrations, held_out: Demonstrations, config: BCConfig) -> dict[str, float]:
    with tempfile.TemporaryDirectory(prefix="roboxim-pairs-") as folder:
        return asdict(validate(load_checkpoint(Trainer(data, config, Path(folder)).run()), held_out))


if __name__ == "__main__":
    main()
