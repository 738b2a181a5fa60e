"""Processor time of a training step of each family, with pictures encoded once and, for comparison, at every step.

Each measurement is a process of its own that trains the default network on random pictures, with one thread. The
headline is the time of a step of rt1s with features from disk, divided by that of a step that encodes its pictures.
"""

from __future__ import annotations

import multiprocessing
import os
import resource
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks._harness import Bench
from benchmarks.policies.bc_training import demonstrations

WARM = 5
"""Steps before the measurement: the first one compiles."""


def main() -> None:
    """Measure and print."""
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    bench = Bench("families", __doc__)
    steps = 10 if bench.quick else 60
    found = {}
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        for family in ("bc", "rt1s", "act"):
            found[family] = pool.apply(_step, (family, steps))
            encode_ms, step_ms, pictures = found[family]
            bench.row(
                family=family, ms_per_step=round(step_ms, 1), encoded_once_ms_per_picture=round(encode_ms, 2),
                encoded_at_every_step_ms=round(step_ms + encode_ms * pictures, 1),
            )  # fmt: skip
    encode_ms, step_ms, pictures = found["rt1s"]
    ratio = step_ms / (step_ms + encode_ms * pictures)
    bench.finish("a step of rt1s with cached features, relative to encoding at every step", ratio, "", at_most=0.5)


def _step(family: str, steps: int) -> tuple[float, float, int]:
    """Return the processor time of encoding a picture [ms] and of a step [ms], and a step's pictures."""
    from roboxim_policies.encoders import feature_cache
    from roboxim_policies.learning.families import config_class
    from roboxim_policies.learning.train import Trainer

    config: Any = config_class(family)(steps=1000, checkpoint_every=1000)
    sides = {"workspace": config.side_of("workspace"), "wrist": config.side_of("wrist")}
    data = demonstrations(4, 40, sides)
    with tempfile.TemporaryDirectory(prefix="roboxim-training-") as folder:
        feature_cache.cache_dir = lambda: Path(folder)
        encoding = 0.0
        if config.ENCODER:
            warm = {"wrist": np.zeros((1, sides["wrist"], sides["wrist"], 3), np.uint8)}
            feature_cache.features_of(warm)  # compiles
            before = _processor_s()
            feature_cache.features_of(data.images)
            encoding = 1000 * (_processor_s() - before) / sum(map(len, data.images.values()))
        trainer = Trainer(data, config, Path(folder) / "out")
        trainer.run(until=WARM)
        before = _processor_s()
        trainer.run(until=WARM + steps)
        return encoding, 1000 * (_processor_s() - before) / steps, config.batch * len(sides)


def _processor_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
