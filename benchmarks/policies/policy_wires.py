"""Cost of a wire: a tick with a policy behind an instant server, compared with the same policy in process.

Both run the same episodes of two 224 x 224 cameras through the cores; the server is a process of its own (``roboxim
policy serve --wire openpi``). Episodes are interleaved. The headline is the ratio of the median wall times per tick.
Further rows: requests per second of 1 to 4 workers, processes of their own, that share one server.
"""

import multiprocessing
import re
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path
from statistics import median

import numpy as np
from benchmarks._harness import Bench

from roboxim_bringup.core_graph import CoreGraph
from roboxim_core.actions import ANY_RATE, ActionSemantics, hold_action
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_core.policies import CameraRequirement, EpisodeStart
from roboxim_policies import BasePolicy, load_policy
from roboxim_policies.remote import probe_window

SIDE = 224


class Instant(BasePolicy):
    """Looks at two cameras and answers at once."""

    cameras = tuple(CameraRequirement(name=name, width=SIDE, height=SIDE) for name in ("workspace", "wrist"))
    semantics = ActionSemantics(rate_hz=ANY_RATE)

    def act(self, window):
        """Return a small motion that depends on the pictures."""
        action = hold_action(1.0)
        action[:2] = [window.newest.images[camera.name][::16, ::16].mean() / 1e5 for camera in self.cameras]
        return action


@contextmanager
def serving():
    """Serve the policy in a process of its own; yield the address."""
    command = [sys.executable, "-m", "roboxim_cli", "policy", "serve", f"{__file__}:Instant"]
    command += ["--wire", "openpi", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            found = re.search(r"ws://[\d.]+:\d+", process.stdout.readline())
            if found is None:
                raise SystemExit("the server did not start")
            yield found[0]
        finally:
            process.terminate()


def remote(url):
    """Return the policy behind the server."""
    return load_policy("openpi", url=url, convention="server", version="benchmark")


def ask_many(url: str, count: int, ready, times) -> None:
    """Ask a server again and again, in a process of its own; put the seconds of each request into a queue."""
    with remote(url) as policy:
        policy.reset(EpisodeStart(episode_id="probe", instruction="x", seed=0))
        window = probe_window(policy.convention)
        policy.act(window)
        ready.wait()
        seconds = []
        for _ in range(count):
            before = time.perf_counter()
            policy.act(window)
            seconds.append(time.perf_counter() - before)
        times.put(seconds)


def measure_workers(url: str, workers: int, count: int) -> tuple[float, float]:
    """Return requests per second of all workers, and the median time of a request [ms]."""
    context = multiprocessing.get_context("spawn")
    ready, times = context.Barrier(workers + 1), context.Queue()
    processes = [context.Process(target=ask_many, args=(url, count, ready, times)) for _ in range(workers)]
    for process in processes:
        process.start()
    ready.wait()
    before = time.perf_counter()
    seconds = [times.get() for _ in processes]
    elapsed = time.perf_counter() - before
    for process in processes:
        process.join()
    return workers * count / elapsed, 1e3 * median(np.concatenate(seconds).tolist())


def main() -> None:
    """Measure and print."""
    bench = Bench("policy_wires", __doc__)
    episodes, steps = (3, 40) if bench.quick else (12, 80)
    times: dict[str, list[float]] = {"in process": [], "openpi": []}
    hashes: dict[str, list[str]] = {"in process": [], "openpi": []}
    with serving() as url:
        with tempfile.TemporaryDirectory() as folder, remote(url) as policy:
            here, there = CoreGraph(Path(folder), policy=Instant()), CoreGraph(Path(folder), policy=policy)
            config = RunConfig(output_dir="", max_steps=steps, settle_ticks=1)
            with here, there:
                runners = {"in process": here, "openpi": there}
                for index in range(episodes + 1):
                    for side, graph in runners.items():
                        before = time.perf_counter()
                        result = EpisodeRunner(graph.ports, config).run_index(index)
                        seconds = time.perf_counter() - before
                        hashes[side].append(result.final_state_hash)
                        if index > 0:  # the first one warms up
                            times[side].append(seconds / (result.last_seq + 1))
        if hashes["in process"] != hashes["openpi"]:
            raise SystemExit("the two ran different episodes; the comparison is void")
        for side, values in times.items():
            bench.row(policy=side, episodes=episodes, ms_per_tick=round(1e3 * median(values), 2))
        for workers in (1, 2, 4) if bench.quick else (1, 2, 3, 4):
            rate, ms = measure_workers(url, workers, 100 if bench.quick else 400)
            bench.row(policy="openpi", workers=workers, requests_per_s=round(rate), ms_per_request=round(ms, 2))
    ratio = median(times["openpi"]) / median(times["in process"])
    bench.finish("wall time per tick over the wire, over in process", ratio, "", at_most=1.15)


if __name__ == "__main__":
    main()
