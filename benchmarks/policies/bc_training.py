"""A training step of bc: processor time with and without keeping freed memory, in turns.

Each measurement is a process of its own that trains the default network (96 and 64 px, batch 64) on random images. The
headline is the step's processor time with `keep_freed_memory`, as ``roboxim train bc`` has it, divided by the time
without it.
"""

from __future__ import annotations

import multiprocessing
import resource
import tempfile
from collections.abc import Mapping
from pathlib import Path
from statistics import median

import numpy as np
from benchmarks._harness import Bench

from roboxim_bringup.process import keep_freed_memory
from roboxim_core.actions import ActionSemantics
from roboxim_core.proprioception import Proprioception
from roboxim_policies.bc.config import BCConfig
from roboxim_policies.learning.data import Demonstration, Demonstrations, assemble
from roboxim_policies.learning.train import Trainer

WARM = 10
"""Steps before the measurement: the first one compiles."""


def main() -> None:
    """Measure and print."""
    bench = Bench("bc_training", __doc__)
    rounds, steps = (1, 30) if bench.quick else (3, 100)
    spent: dict[bool, list[float]] = {False: [], True: []}
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        for number in range(rounds):
            for keeps in (False, True):
                user, system, faults, peak = pool.apply(_step, (keeps, steps))
                spent[keeps].append(user + system)
                bench.row(
                    freed_memory="kept" if keeps else "returned", round=number, user_ms_per_step=round(user, 1),
                    system_ms_per_step=round(system, 1), page_faults_per_step=round(faults), peak_mib=round(peak),
                )  # fmt: skip
    ratio = median(spent[True]) / median(spent[False])
    bench.finish("processor time of a step with freed memory kept, relative", ratio, "", at_most=1.0)


def _step(keeps: bool, steps: int) -> tuple[float, float, float, float]:
    """Return a step's time in user and kernel mode [ms] and its page faults, and the process's peak memory [MiB]."""
    if keeps and not keep_freed_memory():
        raise SystemExit("this C library is not glibc: it has no settings to compare")
    with tempfile.TemporaryDirectory(prefix="roboxim-training-") as folder:
        trainer = Trainer(demonstrations(), BCConfig(steps=1000, checkpoint_every=1000), Path(folder))
        trainer.run(until=WARM)
        before = resource.getrusage(resource.RUSAGE_SELF)
        trainer.run(until=WARM + steps)
        after = resource.getrusage(resource.RUSAGE_SELF)
    return (
        1000 * (after.ru_utime - before.ru_utime) / steps, 1000 * (after.ru_stime - before.ru_stime) / steps,
        (after.ru_minflt - before.ru_minflt) / steps, after.ru_maxrss / 1024,
    )  # fmt: skip


SIDES = {"workspace": 96, "wrist": 64}
"""Sides of bc's images [px]."""


def demonstrations(episodes: int = 20, length: int = 40, sides: Mapping[str, int] = SIDES) -> Demonstrations:
    """Return demonstrations with random images that close the gripper halfway.

    Args:
        episodes: Their number.
        length: Steps of each.
        sides: Camera to the side of its images [px].
    """
    rng = np.random.default_rng(0)
    actions = rng.normal(scale=0.01, size=(length, 7)).astype(np.float32)
    actions[:, 6] = np.arange(length) < length // 2
    places = np.cumsum(actions[:, :3], axis=0).tolist()
    proprio = np.stack(
        [
            Proprioception(tcp_position=(x, y, z), gripper_opening=opening).vector()
            for (x, y, z), opening in zip(places, actions[:, 6].tolist(), strict=True)
        ]
    )
    return assemble(
        (
            Demonstration(
                images={
                    name: rng.integers(0, 256, (length, side, side, 3), dtype=np.uint8) for name, side in sides.items()
                },
                proprio=proprio, actions=actions, instruction="Pick up the cube",
            )
            for _ in range(episodes)
        ),
        camera_sizes={name: (side, side) for name, side in sides.items()}, semantics=ActionSemantics(), robot="panda",
    )  # fmt: skip


if __name__ == "__main__":
    main()
