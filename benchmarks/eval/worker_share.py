"""What an evaluation's worker spends on anything but the policy and the simulator, counted within the worker.

One worker runs episodes in this process. The simulator is what building and settling the world, physics and drawing
take, with the rasteriser's threads; drawing includes the poses of bodies and cameras, and the pictures of a scene that
tell what is visible in it, which have a row of their own. The policy is what its reset and its answers take, with its
library's threads. Everything else is the evaluation's own: choosing and planning the scene, the loop, the judge,
messages, the recorder, the middleware. `overhead` compares workers with episodes in another process, so other jobs of
the machine change it more than this share, which divides times of the same seconds.

In wall time, an evaluation's own share is the time in which neither the simulator nor the policy works. What the
recorder does while the next tick is simulated counts as processor time but not as wall time. Where it slows the
simulator down, that is the simulator's time here; `overhead` counts it. Both shares are printed; the headline is that
of wall time.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import os
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

from benchmarks._harness import Bench

import roboxim_sim.node
from roboxim_bringup.graph import GraphConfig, PolicyLaunch
from roboxim_core.config import to_plain
from roboxim_core.episode import RunConfig
from roboxim_core.policy_guard import GuardedPolicy
from roboxim_ros.runs import free_domain
from roboxim_runs.episodes.task_choice import task_text
from roboxim_runs.episodes.worker import EpisodeWorker
from roboxim_sim.node import SimNode
from roboxim_sim.rendering.camera_effects import CameraRig
from roboxim_sim.rendering.states import StateRenderer
from roboxim_sim.world import World

TASK = "pick_cube"
WARM = 2
"""Episodes before the measurement, in which libraries are loaded and policies compiled."""
NATIVE = {"simulator": ("llvmpipe",), "policy": ("XLA",)}
"""Parts of the names of the threads that libraries start, by what they work for."""


class Counted:
    """Processor time of the calling threads in some functions, by what they belong to [s], and when they ran."""

    def __init__(self) -> None:
        """Start at zero."""
        self.spent: Counter[str] = Counter()
        self.spans: list[tuple[float, float]] = []
        self.wall: Counter[str] = Counter()
        self._inside = threading.local()

    def count(self, owner: Any, name: str, part: str) -> None:
        """Count a function of a class or a module from now on; calls within counted calls are not counted twice."""
        function = getattr(owner, name)

        def counted(*given: Any, **named: Any) -> Any:
            if getattr(self._inside, "now", False):
                return function(*given, **named)
            self._inside.now, began, began_s = True, time.monotonic(), time.thread_time()
            try:
                return function(*given, **named)
            finally:
                self.spent[part] += time.thread_time() - began_s
                self.spans.append((began, time.monotonic()))
                self.wall[name] += time.monotonic() - began
                self._inside.now = False

        setattr(owner, name, counted)

    def wall_s(self) -> float:
        """Return the time in which at least one of the functions ran [s]."""
        covered, until = 0.0, 0.0
        for began, ended in sorted(self.spans):
            covered += max(0.0, ended - max(began, until))
            until = max(until, ended)
        return covered


def main() -> None:
    """Measure and print."""

    def options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--policy", default="zero", help="policy, e.g. bc with --checkpoint")
        parser.add_argument("--checkpoint", default="", help="checkpoint of the policy")
        parser.add_argument(
            "--answer-ms", type=float, default=0.0, metavar="MS",
            help="let each answer last that much longer without using a processor, as on a GPU or a server",
        )  # fmt: skip
        parser.add_argument("--size", type=int, default=128, help="side of the images [px]")

    bench = Bench("worker_share", __doc__, options)
    counted = Counted()
    if bench.options.answer_ms:
        _answer_later(bench.options.answer_ms / 1000)
    for owner, name, part in (
        (World, "load", "simulator"), (World, "tick", "simulator"), (roboxim_sim.node, "render_world", "simulator"),
        (CameraRig, "load", "simulator"), (SimNode, "_capture", "simulator"), (StateRenderer, "draw", "simulator"),
        (GuardedPolicy, "reset", "policy"), (GuardedPolicy, "act", "policy"),
    ):  # fmt: skip
        counted.count(owner, name, part)
    with tempfile.TemporaryDirectory(prefix="roboxim-share-") as out, free_domain() as domain:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        worker = _worker(bench, out)
        for index in range(WARM):
            worker.run(index, lambda _: None)
        gc.collect()
        gc.freeze()  # as a worker's process does after its first episode
        counted.spent.clear()
        counted.spans.clear()
        counted.wall.clear()
        before, began, began_wall = _threads(), time.process_time(), time.monotonic()
        episodes = range(WARM, WARM + (2 if bench.quick else 12))
        ticks = sum(worker.run(index, lambda _: None)["last_seq"] + 1 for index in episodes)
        total, wall, threads = time.process_time() - began, time.monotonic() - began_wall, _threads() - before
        worker.close()
    for part, names in NATIVE.items():
        counted.spent[part] += sum(s for thread, s in threads.items() if any(name in thread for name in names))
    own = total - counted.spent.total()
    for part, seconds in (*counted.spent.items(), ("everything else", own), ("all", total)):
        bench.row(part=part, ms_per_tick=round(1000 * seconds / ticks, 2), percent=round(100 * seconds / total, 1))
    own_wall = wall - counted.wall_s()
    bench.row(
        part="wall time, neither policy nor simulator", ms_per_tick=round(1000 * own_wall / ticks, 2),
        percent=round(100 * own_wall / wall, 1),
    )  # fmt: skip
    checks = counted.wall["draw"]
    bench.row(
        part="wall time, pictures that tell what is visible", ms_per_tick=round(1000 * checks / ticks, 2),
        percent=round(100 * checks / wall, 1),
    )  # fmt: skip
    for thread, seconds in threads.most_common(8):
        percent = round(100 * seconds / total, 1)
        bench.row(part=f"thread {thread}", ms_per_tick=round(1000 * seconds / ticks, 2), percent=percent)
    bench.finish(
        "share of a worker's wall time beside policy and simulator", round(100 * own_wall / wall, 1), "%", at_most=10
    )


def _answer_later(seconds: float) -> None:
    """Let every policy's answer last longer."""
    act = GuardedPolicy.act

    def later(*given: Any, **named: Any) -> Any:
        time.sleep(seconds)
        return act(*given, **named)

    setattr(GuardedPolicy, "act", later)  # noqa: B010 (a method is replaced on purpose)


def _worker(bench: Bench, out: str) -> EpisodeWorker:
    """Start a worker as an evaluation does."""
    given = {"checkpoint": bench.options.checkpoint} if bench.options.checkpoint else {}
    graph = GraphConfig(
        policies=(PolicyLaunch(spec=bench.options.policy, options=given),),
        parameters={"recorder": {"output_root": out}, "sim": {"scene": "", "publish_unheard": False}},
    )
    run = RunConfig(
        task_config=task_text(TASK), output_dir=out, image_width=bench.options.size, image_height=bench.options.size,
        purpose="eval", actor="policy", keep="all", policy_timeout_s=120.0,
    )  # fmt: skip
    return EpisodeWorker({"graph": to_plain(graph), "config": to_plain(run)}, 0)


def _threads() -> Counter[str]:
    """Return the processor time of this process's threads by name [s]."""
    names = {thread.native_id: thread.name for thread in threading.enumerate()}
    found: Counter[str] = Counter()
    for folder in Path("/proc/self/task").iterdir():
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # that of an episode ends about now
            nanoseconds, name = (folder / "schedstat").read_text().split()[0], (folder / "comm").read_text().strip()
            found[names.get(int(folder.name), f"{name} (native)")] += int(nanoseconds) / 1e9
    return found


if __name__ == "__main__":
    main()
