"""First answers of shell commands: processor time of each, and response times on a running graph.

A first answer is a command's first line of output. Its processor time is that of the process up to then; ``cpu_s`` is
the processor time of the whole command, its child processes included. ``tasks list`` and the other lists are measured
twice: ``new`` is the call after something has changed, which makes the catalogue of names again, ``kept`` the next one.
Commands find compiled modules (``.pyc``), as after any first call; ``PYTHONDONTWRITEBYTECODE`` is removed for them.

For comparison with commands on a running graph, in turns with them: a bare rclpy script that calls the same service
once, as a user would write it.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from statistics import median

from benchmarks._harness import Bench

from roboxim_ros.runs import find_run

ROBOXIM = (sys.executable, "-m", "roboxim_cli")
SERVICE = "/sim/get_simulator_features"
BARE = f"""
import rclpy
from simulation_interfaces.srv import GetSimulatorFeatures as Service
rclpy.init()
node = rclpy.create_node("bare")
client = node.create_client(Service, "{SERVICE}")
assert client.wait_for_service(10.0)
answer = client.call_async(Service.Request())
rclpy.spin_until_future_complete(node, answer)
print(answer.result())
"""
ON_A_GRAPH: Mapping[str, tuple[str, ...]] = {
    "service call": (*ROBOXIM, "service", "call", SERVICE),
    "node list": (*ROBOXIM, "node", "list"),
    "topic echo --once": (*ROBOXIM, "topic", "echo", "--once", "/sim/state"),
    "bare rclpy service call": (sys.executable, "-c", BARE),
}
LISTS = ("tasks list", "policy list", "policy conventions", "experiment list")
"""Commands that read the catalogue of names."""
ALONE = (
    "--help", "--version", "generate --help", "export rlds --help", "dataset convert lerobot --help", "runs",
    "interface list", "interface show roboxim_interfaces/srv/Tick", "policy describe libero", "tasks sample --seed 1",
    "planner dumps", "doctor",
)  # fmt: skip
"""Commands that need neither a graph nor data."""
WITH_DATA = ("runs {runs}", "bag info {bag}", "bag info {runs}", "dataset info {dataset}")


def main() -> None:
    """Measure and print."""
    bench = Bench("cli", __doc__, add_options)
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    slowest = max(first_answers(bench, Path(bench.options.runs) if bench.options.runs else None))
    response_times(bench, 2 if bench.quick else 12)
    bench.finish(f"slowest first answer, `roboxim {slowest[1]}`", slowest[0], "s of CPU", at_most=0.6)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the option of this benchmark."""
    parser.add_argument("--runs", metavar="DIR", help="recorded episodes to describe; default: two are recorded")


def first_answers(bench: Bench, runs: Path | None) -> list[tuple[float, str]]:
    """Add a row for each command that needs no graph; return processor times of first answers [s] and names."""
    found: list[tuple[float, str]] = []

    def add(name: str, words: str, *, new: bool = False) -> None:
        measured = []
        for _ in range(3 if bench.quick else 8):
            if new:
                shutil.rmtree(cache, ignore_errors=True)
            measured.append(used((*ROBOXIM, *words.split())))
        first, whole, wall = min(measured)
        bench.row(command=name, first_answer_cpu_s=round(first, 2), cpu_s=round(whole, 2), wall_s=round(wall, 2))
        found.append((first, name))

    with tempfile.TemporaryDirectory() as folder:
        cache = os.environ["XDG_CACHE_HOME"] = f"{folder}/cache"
        for name in LISTS:
            add(f"{name} (new)", name, new=True)
            add(f"{name} (kept)", name)
        for name in ALONE:
            add(name, name)
        places = example(Path(folder), runs)
        for name in WITH_DATA:
            add(name.format(runs="RUN", bag="BAG", dataset="DATASET"), name.format(**places))
    return found


def example(folder: Path, runs: Path | None) -> dict[str, Path]:
    """Return a run, its first bag and a dataset; record two episodes unless a run is given."""
    if runs is None:
        runs = folder / "demos"
        seconds((*ROBOXIM, "generate", "--episodes", "2", "--workers", "1", "--renderer", "tiny", "--out", str(runs)))
    dataset = folder / "dataset"
    seconds((*ROBOXIM, "export", "rlds", str(runs), "--out", str(dataset)))
    return {"runs": runs, "bag": min((runs / "episodes").iterdir()), "dataset": dataset}


def response_times(bench: Bench, count: int) -> None:
    """Add a row for each command on a running graph."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_RUNTIME_DIR"] = folder
        seconds((*ROBOXIM, "up", "--detach", "-p", "sim:renderer:=tiny"))
        try:
            find_run().join()
            rounds = [{name: seconds(command) for name, command in ON_A_GRAPH.items()} for _ in range(count)]
        finally:
            seconds((*ROBOXIM, "down"))
    for name in ON_A_GRAPH:
        times = [took[name] for took in rounds]
        bench.row(command=name, median_s=round(median(times), 2), worst_s=round(max(times), 2))


def used(command: tuple[str, ...]) -> tuple[float, float, float]:
    """Run a command that must succeed.

    Returns:
        Processor time up to its first line and of the whole command, children included; wall time of it [s].
    """
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        first = processor_time(process.pid)
        errors = process.communicate(timeout=300)[1]
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if process.returncode:
        raise SystemExit(f"`{' '.join(command[2:])}` failed: {errors.decode()[-500:]}")
    whole = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return min(first, whole), whole, time.perf_counter() - start


def processor_time(pid: int) -> float:
    """Return the processor time of a process that is alive or not yet waited for, with its ended children [s]."""
    values = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, values[11:15])) / os.sysconf("SC_CLK_TCK")


def seconds(command: tuple[str, ...]) -> float:
    """Return the wall time of a command that must succeed [s]."""
    start = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    took = time.perf_counter() - start
    if done.returncode:
        raise SystemExit(f"`{' '.join(command[:5])}` failed: {done.stderr.strip()[-500:]}")
    return took


if __name__ == "__main__":
    main()
