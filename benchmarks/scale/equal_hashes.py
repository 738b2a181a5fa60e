"""Hashes of the same run, made in different ways: workers, shards, a killed command, a Ray cluster that loses a node.

Each row has two hashes: of all recordings, and of all results without their times. All rows of a kind must be equal.
Needs ``make scale``.
"""

import hashlib
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks._harness import Bench
from planted_runs import add_ray_node, ray_cluster, recordings, repeatable_results

from roboxim_runs.episodes.generation import GenerationConfig, generate
from roboxim_runs.evaluation.run import EvaluationConfig, evaluate
from roboxim_runs.events import EpisodeFinished, Event
from roboxim_runs.executors.ray_cluster import RayExecutor

SIZE = 64
ROLLOUT_STEPS = 20
SHARDS = 3
ROBOXIM = (sys.executable, "-m", "roboxim_cli")
WORDS = {
    "demonstrations": ("generate", "--size", str(SIZE)),
    "rollouts": ("evaluate", "--policy", "random", "--max-steps", str(ROLLOUT_STEPS), "--size", str(SIZE)),
}
"""The command of each kind."""


def main() -> None:
    """Run all and print."""
    bench = Bench("equal_hashes", __doc__)
    episodes = 6 if bench.quick else 40
    ways: dict[str, Callable[[Path, str, int], object]] = {
        "1 worker": lambda out, kind, count: run(out, kind, count, "--workers", "1"),
        "2 workers": lambda out, kind, count: run(out, kind, count, "--workers", "2"),
        f"{SHARDS} shards, merged": in_shards,
        "2 workers, command killed, the same command again": killed,
        "Ray, 3 nodes, one killed": on_ray,
    }
    different = 0
    with tempfile.TemporaryDirectory(prefix="roboxim-hashes-") as folder:
        for kind in WORDS:
            first: tuple[str, str] | None = None
            for number, (name, make) in enumerate(ways.items()):
                out = Path(folder) / kind / str(number)
                make(out, kind, episodes)
                made = out if kind == "demonstrations" else out / "random"
                found = digest(recordings(made)), digest(repeatable_results(made))
                first = first or found
                different += found != first
                bench.row(
                    run=kind, way=name, episodes=len(recordings(made)), recordings=found[0], results=found[1],
                )  # fmt: skip
    bench.finish("runs whose recordings or results differ from the first", different, "", at_most=0)


def digest(value: object) -> str:
    """Return the first 16 digits of a value's SHA-256."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]


def command(out: Path, kind: str, episodes: int, *more: str) -> Sequence[str]:
    """Return a run's command."""
    return (*ROBOXIM, *WORDS[kind], "--episodes", str(episodes), "--out", str(out), *more)


def run(out: Path, kind: str, episodes: int, *more: str) -> None:
    """Make a run by its command."""
    subprocess.run(command(out, kind, episodes, *more), check=True, stdout=subprocess.DEVNULL)


def in_shards(out: Path, kind: str, episodes: int) -> None:
    """Make a run in shards, and merge them."""
    parts = [out.with_name(f"{out.name}-{number}") for number in range(1, SHARDS + 1)]
    for number, part in enumerate(parts, start=1):
        run(part, kind, episodes, "--workers", "1", "--shard", f"{number}/{SHARDS}")
    subprocess.run((*ROBOXIM, "merge", *map(str, parts), "--out", str(out)), check=True, stdout=subprocess.DEVNULL)


def killed(out: Path, kind: str, episodes: int) -> None:
    """Make a run whose command is killed after a fifth of the episodes, and continued."""
    results = (out if kind == "demonstrations" else out / "random") / "results.jsonl"
    with subprocess.Popen(command(out, kind, episodes, "--workers", "2"), stdout=subprocess.DEVNULL) as process:
        while not results.exists() or results.read_text().count("\n") < episodes // 5:
            if process.poll() is not None:
                raise SystemExit("the command ended before it was killed")
            time.sleep(0.05)
        process.kill()
    run(out, kind, episodes, "--workers", "2")


def on_ray(out: Path, kind: str, episodes: int) -> None:
    """Make a run on a cluster of three nodes of this machine; one is killed after a fifth of the episodes."""
    cluster = ray_cluster(2)
    doomed, done = [add_ray_node(cluster)], 0

    def lose(event: Event) -> None:
        nonlocal done
        done += isinstance(event, EpisodeFinished)
        if done > episodes // 5 and doomed:
            cluster.remove_node(doomed.pop(), allow_graceful=False)

    try:
        executor = RayExecutor(3, address=cluster.address)
        if kind == "demonstrations":
            generate(GenerationConfig(out=out, episodes=episodes, size=SIZE), executor=executor, on_event=lose)
        else:
            config = EvaluationConfig(policies="random", out=out, episodes=episodes, max_steps=ROLLOUT_STEPS, size=SIZE)
            evaluate(config, executor=executor, on_event=lose)
    finally:
        cluster.shutdown()
    if doomed:
        raise SystemExit("no node was killed")


if __name__ == "__main__":
    main()
