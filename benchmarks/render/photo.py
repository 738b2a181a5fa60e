"""Photo-realistic images: processor time per 256x256 image of Blender's Cycles, RGB + depth + segmentation.

The scene is that of ``benchmarks/render/render.py``. Needs ``make photo``.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from statistics import median

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))

import numpy as np
from benchmarks._harness import Bench

from render_scene import example_poses, example_scene
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import render_world
from roboxim_sim.rendering.photo import PhotoRenderer

STEP_RAD = 0.02


def main() -> None:
    """Measure and report."""
    bench = Bench("photo", __doc__)
    library, scene = ModelLibrary(), example_scene(256, depth=True, segmentation=True)
    started = time.perf_counter()
    renderer = PhotoRenderer()
    renderer.load(render_world(scene, library))
    first = renderer.render(*example_poses(scene, library))
    ready_s = time.perf_counter() - started
    cpu_s, wall_s = [], []
    for i in range(3 if bench.quick else 12):
        frame = example_poses(scene, library, STEP_RAD * (i + 1))
        before = time.perf_counter()
        renderer.render(*frame)
        wall_s.append((time.perf_counter() - before) / len(frame[1]))
        cpu_s.append(renderer.cpu_s / len(frame[1]))
    again = renderer.render(*example_poses(scene, library))
    device = renderer.device
    renderer.close()
    bench.row(
        renderer=device,
        cpu_s_per_image=round(median(cpu_s), 2),
        wall_s_per_image=round(median(wall_s), 2),
        start_and_first_pair_s=round(ready_s, 1),
        same_bits=str(all(np.array_equal(first[name].rgb, again[name].rgb) for name in first)),
    )
    bench.finish("256x256 image, RGB + depth + segmentation", median(cpu_s), "CPU-s", at_most=3.0)


if __name__ == "__main__":
    main()
