"""Camera images: time per 256x256 pair (workspace and wrist) of raster, tiny and MuJoCo's renderer, start-up, memory.

The scene is the default look with all effects: Panda, table, floor, walls, five textured objects, a light with shadows;
the arm moves from pair to pair. MuJoCo (``make render-peers``) draws the same meshes and textures, RGB only.
``--pairs N`` also draws N pairs and reports the memory growth.
"""

from __future__ import annotations

import argparse
import pickle
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))

from benchmarks._harness import Bench
from benchmarks.peers._peer import Peer, installed
from benchmarks.render._mujoco_scene import write_scene

from render_scene import example_poses, example_scene
from roboxim_core.config import digest
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import render_world
from roboxim_core.specs import LightSpec, LookSpec
from roboxim_core.vision.renderer import RenderWorld
from roboxim_sim.rendering import make_renderer

FRAMES = 8
STEP_RAD = 0.02
LAMP = LightSpec(kind="lamp", position=(0.8, 0.8, 1.2), shadow=False)
HEADLINE = "raster, RGB + depth + segmentation"
NO_SHADOWS = "raster, no shadows"
TINY = "tiny, shadows"
MUJOCO = "MuJoCo, RGB, shadows"


@dataclass(frozen=True)
class Contender:
    """A renderer that draws pairs, and its times."""

    title: str
    draw: Callable[[int], tuple[list[float], list[float]]]
    """Draws a number of pairs and returns their wall and processor times [ms]."""
    share: float = 1.0
    """Fraction of a round's pairs that it draws: slow renderers draw fewer."""
    wall_ms: list[float] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)


def ours(
    title: str, name: str, look: LookSpec, size: int = 256, geometry: bool = True, share: float = 1.0
) -> Contender:
    """Return one of RoboXim's renderers with its own world."""
    library, scene = ModelLibrary(), replace(example_scene(size, depth=geometry, segmentation=geometry), look=look)
    frames = [example_poses(scene, library, STEP_RAD * i) for i in range(FRAMES)]
    renderer = make_renderer(name)
    renderer.load(render_world(scene, library))
    for frame in frames[:3]:
        renderer.render(*frame)

    def draw(pairs: int) -> tuple[list[float], list[float]]:
        wall, cpu = [], []
        for i in range(pairs):
            start, processor = time.perf_counter(), time.process_time()
            renderer.render(*frames[i % FRAMES])
            wall.append(1e3 * (time.perf_counter() - start))
            cpu.append(1e3 * (time.process_time() - processor))
        return wall, cpu

    return Contender(f"{title} [{renderer.device.split(' (')[0]}]" if name == "raster" else title, draw, share)


def mujoco(folder: Path) -> Contender:
    """Return MuJoCo's renderer on the same scene."""
    library, scene = ModelLibrary(), example_scene(256)
    frames = [example_poses(scene, library, STEP_RAD * i) for i in range(FRAMES)]
    write_scene(folder, render_world(scene, library), frames)
    peer = Peer("robosuite", "run_mujoco.py", str(folder), variables={"MUJOCO_GL": "egl"})

    def draw(pairs: int) -> tuple[list[float], list[float]]:
        answer = peer.ask(pairs=pairs)
        return answer["wall_ms"], answer["cpu_ms"]

    return Contender(MUJOCO, draw, 0.3)


FRESH = """
import pickle, sys, time
with open("/proc/self/stat") as file:
    begun = int(file.read().rsplit(")", 1)[1].split()[19]) / 100
sys.path.insert(0, sys.argv[3])
from benchmarks._harness import rss_mib
from roboxim_sim.rendering.raster import RasterRenderer
world, frames = pickle.load(open(sys.argv[1], "rb"))
renderer = RasterRenderer()
renderer.load(world)
renderer.render(*frames[0])
ready = time.clock_gettime(time.CLOCK_BOOTTIME) - begun
for i in range(100):
    renderer.render(*frames[i % len(frames)])
before = rss_mib()
for i in range(int(sys.argv[2])):
    renderer.render(*frames[i % len(frames)])
print("@@", ready, before, rss_mib() - before)
"""


def fresh(world: RenderWorld, frames: list[object], pairs: int, folder: Path) -> tuple[float, float, float]:
    """Return a new process's time to its first pair [s], its memory [MiB], and the growth over n pairs [MiB]."""
    path = folder / "world.pickle"
    path.write_bytes(pickle.dumps((world, frames)))
    # argv 3: the folder of the package `benchmarks`. The process's start time comes from /proc, to include the
    # interpreter's start.
    command = [sys.executable, "-c", FRESH, str(path), str(pairs), str(Path(__file__).parents[2])]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    ready, memory, growth = (float(word) for word in done.stdout.rpartition("@@")[2].split())
    return ready, memory, growth


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add this benchmark's own options."""
    parser.add_argument("--pairs", type=int, default=0, metavar="N", help="also draw N pairs and report the growth")


def main() -> None:
    """Measure and report."""
    bench = Bench("render", __doc__, add_options)
    look = LookSpec()
    dark = replace(look, lights=tuple(replace(light, shadow=False) for light in look.lights))
    contenders = [
        ours(HEADLINE, "raster", look),
        ours("raster, RGB", "raster", look, geometry=False),
        ours(NO_SHADOWS, "raster", dark),
        ours("raster, 128x128", "raster", look, size=128),
        ours("raster, two more lamps", "raster", replace(look, lights=(*look.lights, *[LAMP] * 2))),
        ours(TINY, "tiny", look, share=0.15),
    ]
    with tempfile.TemporaryDirectory(prefix="roboxim-") as name:
        if installed("robosuite"):
            contenders.append(mujoco(Path(name)))
        for _ in range(3 if bench.quick else 10):  # in turns, so that all run under the same load
            for each in contenders:
                wall, cpu = each.draw(max(2, round((20 if bench.quick else 30) * each.share)))
                each.wall_ms.extend(wall)
                each.cpu_ms.extend(cpu)
        for each in contenders:
            bench.row(
                contender=each.title,
                wall_ms_per_pair=round(median(each.wall_ms), 2),
                cpu_ms_per_pair=round(median(each.cpu_ms), 2),
                over_headline=round(median(each.wall_ms) / median(contenders[0].wall_ms), 2),
            )
        library, scene = ModelLibrary(), example_scene(256, depth=True, segmentation=True)
        frames = [example_poses(scene, library, STEP_RAD * i) for i in range(FRAMES)]
        ready, memory, growth = fresh(render_world(scene, library), frames, bench.options.pairs, Path(name))
        bench.row(contender="raster, a new process", first_pair_s=round(ready, 2), memory_mib=round(memory))
        if bench.options.pairs:
            bench.row(
                contender=f"raster, {bench.options.pairs} pairs", memory_mib=round(memory), grown_mib=round(growth, 2)
            )
    print(f"look {digest(look)}, scene {digest(replace(scene, cameras=()))}")
    if not installed("robosuite"):
        print("MuJoCo is not measured: `make render-peers` installs it")
    bench.finish(
        "256x256 pair of RGB + depth + segmentation, shadows", median(contenders[0].wall_ms), "ms", at_most=20.0
    )


LAMP = LightSpec(kind="lamp", position=(0.8, 0.8, 1.2), shadow=False)

if __name__ == "__main__":
    main()
