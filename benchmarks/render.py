"""Camera images: time per 256x256 pair (workspace and wrist), start-up and memory of every renderer."""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))

from _harness import Bench, rss_mib, time_ms
from render_scene import example_poses, example_scene
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import render_world
from roboxim_core.rendering import Renderer, RenderWorld
from roboxim_core.specs import LightSpec, LookSpec
from roboxim_sim.rendering import make_renderer

LIBRARY = ModelLibrary()
VARIANTS = {"rgb": (False, 256), "rgb+depth+segmentation": (True, 256), "rgb, 128x128": (False, 128)}
"""Row title to (depth and segmentation, size [px])."""


def world_of(shadow: bool) -> RenderWorld:
    """Return the README's scene, with or without shadows."""
    return render_world(replace(example_scene(256), look=LookSpec(lights=(LightSpec(shadow=shadow),))), LIBRARY)


def measure(renderer: Renderer, everything: bool, size: int, repeats: int) -> tuple[float, float]:
    """Return the median wall time and the mean processor time of a pair [ms]."""
    poses, cameras = example_poses(example_scene(size, depth=everything, segmentation=everything), LIBRARY)
    wall = time_ms(lambda: renderer.render(poses, cameras), repeats, warm_up=1)
    start = time.process_time()
    for _ in range(repeats):
        renderer.render(poses, cameras)
    return wall, 1e3 * (time.process_time() - start) / repeats


def main() -> None:
    """Measure and report."""
    bench = Bench("render", __doc__)
    headline = float("nan")
    worlds = {shadow: world_of(shadow) for shadow in (True, False)}
    for name, repeats in (("raster", 20 if bench.quick else 300), ("tiny", 2 if bench.quick else 30)):
        memory, start = rss_mib(), time.perf_counter()
        renderer = make_renderer(name)
        renderer.load(worlds[True])
        measure(renderer, everything=True, size=256, repeats=1)
        ready_s = time.perf_counter() - start
        for images, (everything, size) in VARIANTS.items():
            for shadow, world in worlds.items():
                renderer.load(world)
                wall, cpu = measure(renderer, everything, size, repeats)
                if (name, size, everything, shadow) == ("raster", 256, True, True):
                    headline = wall
                bench.row(
                    renderer=name,
                    images=images,
                    shadow="on" if shadow else "off",
                    wall_ms_per_pair=round(wall, 2),
                    cpu_ms_per_pair=round(cpu, 2),
                )
        load_ms = time_ms(lambda world=worlds[True], to=renderer: to.load(world), 5, warm_up=0)
        grown = rss_mib() - memory
        bench.row(renderer=name, start_s=round(ready_s, 2), load_ms=round(load_ms, 1), grown_mib=round(grown))
        renderer.close()
    bench.finish("raster, 256x256 pair of RGB + depth + segmentation, shadows", headline, "ms", at_most=20.0)


if __name__ == "__main__":
    main()
