"""Ablations of bc, or another family: trains each variant on a dataset without its last demonstrations.

Its errors on those, or on another dataset (``--new``), are measured. Each variant is ``NAME`` or
``NAME:field=value,field=value`` with fields of the family's configuration, e.g.::

    make bench-bc_ablation ARGS="--dataset runs/so-rlds --out runs/ablation --variant base --variant small:channels=32"

CPU time does not depend on other jobs. The headline is the 90th percentile of the grasp's position error, of the best
variant. Trainings are kept in ``--out`` and continue when they were interrupted.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import yaml
from benchmarks._harness import Bench

from roboxim_core.config import from_plain
from roboxim_core.vision.images import resized
from roboxim_datasets.formats import open_dataset
from roboxim_policies.learning.checkpoint import load_checkpoint
from roboxim_policies.learning.data import (
    Demonstration,
    Demonstrations,
    Images,
    Reading,
    assemble,
    read_demonstrations,
)
from roboxim_policies.learning.families import FAMILIES, config_class
from roboxim_policies.learning.train import Trainer
from roboxim_policies.learning.validation import validate

GOAL_MM = 10.0


def main() -> None:
    """Measure and print."""
    bench = Bench("bc_ablation", __doc__, _options)
    options = bench.options
    read = read_demonstrations(options.dataset, image_sizes=_largest(options.dataset))
    new = read_demonstrations(options.new, image_sizes=_largest(options.new)) if options.new else read
    split = len(read.episodes) - (0 if options.new else options.hold_out)
    of_family = config_class(options.family)
    worst = []
    for variant in options.variant or ["base"]:
        name, _, text = variant.partition(":")
        pairs = (part.partition("=") for part in text.split(",") if part)
        fields = {key: yaml.safe_load(value) for key, _, value in pairs}
        sizes = {
            **{name: of_family().side_of(name) for name in read.camera_sizes},
            **{k: fields.pop(k) for k in [*fields] if k in read.camera_sizes},
        }
        steps = 30 if bench.quick else int(fields.pop("steps", options.steps))
        config = replace(from_plain(fields, of_family, source=variant), steps=steps, image_sizes=sizes)
        train = _assembled(read, sizes, slice(0, split))
        trainer = Trainer(train, config, options.out / name)
        trainer.run(until=trainer.step + 1)  # compiles
        first, started = trainer.step, time.process_time()
        path = trainer.run()
        cpu_ms = 1e3 * (time.process_time() - started) / max(1, config.steps - first)
        held_out = slice(None) if options.new else slice(split, None)
        found = validate(load_checkpoint(path), _assembled(new, sizes, held_out, like=train))
        worst.append(found.grasp_p90_mm)
        errors = {key: round(value, 3) for key, value in asdict(found).items()}
        bench.row(variant=name, steps=steps, cpu_ms_per_step=round(cpu_ms), **errors)
        print(bench.rows[-1], flush=True)
    bench.finish("grasp position error, 90th percentile", min(worst), "mm", at_most=GOAL_MM)


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--dataset", type=Path, required=True, help="a dataset, e.g. of 'roboxim export rlds'")
    parser.add_argument("--out", type=Path, required=True, help="folder of the trainings")
    parser.add_argument("--family", choices=FAMILIES, default="bc", help="family of policies (default: bc)")
    parser.add_argument("--variant", action="append", help="NAME or NAME:field=value,...; may be repeated")
    parser.add_argument("--steps", type=int, default=1000, help="steps of each training (default: 1000)")
    parser.add_argument("--new", type=Path, help="dataset of other scenes to measure on; none: of those held out")
    parser.add_argument("--hold-out", type=int, default=36, help="last episodes, not trained on (default: 36)")


def _largest(dataset: Path) -> dict[str, int]:
    """Return the side of the dataset's images by camera; each variant resizes them."""
    return {name: size.width for name, size in open_dataset(dataset).features.cameras.items()}


def _assembled(read: Reading, sizes: dict[str, int], part: slice, like: Demonstrations | None = None) -> Demonstrations:
    episodes = (
        Demonstration(
            images={name: _resized(frames, sizes[name]) for name, frames in episode.images.items()},
            proprio=episode.proprio, actions=episode.actions, instruction=episode.instruction,
        )
        for episode in read.episodes[part]
    )  # fmt: skip
    return assemble(episodes, camera_sizes=read.camera_sizes, semantics=read.semantics, robot=read.robot, like=like)


def _resized(frames: Images, side: int) -> Images:
    return frames if frames.shape[1] == side else np.stack([resized(frame, side, side) for frame in frames])


if __name__ == "__main__":
    main()
