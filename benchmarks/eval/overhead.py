"""What an evaluation spends on anything but the policy and the simulator.

First the share of each port of the episode loop, in one process: drawing the scene, simulator, policy, judge, recorder
and the loop itself. Then a whole `evaluate` with two workers: the start of the graphs and the report, too.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks._harness import Bench

from roboxim_bringup.core_graph import CoreGraph
from roboxim_bringup.runs.evaluation import EvaluationConfig, evaluate
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_policies.base import load_policy


class _Timed:
    """A port whose calls are timed."""

    def __init__(self, port: Any, name_of: Callable[[str], str], seconds: Counter[str]) -> None:
        self._port, self._name_of, self._seconds = port, name_of, seconds

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._port, name)
        if not callable(found):
            return found

        def timed(*given: Any, **named: Any) -> Any:
            started = time.perf_counter()
            try:
                return found(*given, **named)
            finally:
                self._seconds[self._name_of(name)] += time.perf_counter() - started

        return timed


def main() -> None:
    """Measure both."""

    def options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--policy", default="zero", help="policy, e.g. bc with --checkpoint")
        parser.add_argument("--checkpoint", default="", help="checkpoint of the policy")
        parser.add_argument("--size", type=int, default=128, help="side of the images [px]")

    bench = Bench("overhead", __doc__, options)
    given = {"checkpoint": bench.options.checkpoint} if bench.options.checkpoint else {}
    episodes = 4 if bench.quick else 24
    with tempfile.TemporaryDirectory(prefix="roboxim-overhead-") as folder:
        seconds = _ports(Path(folder), bench, given, max(2, episodes // 4))
        whole = sum(seconds.values())
        for name, value in seconds.most_common():
            bench.row(part=name, percent=round(100 * value / whole, 1))
        own = 100 * (1 - (seconds["policy"] + seconds["simulator"]) / whole)
        spec: Any = f"{bench.options.policy}"
        if given:
            from roboxim_bringup.runs.policies import PolicySpec

            spec = PolicySpec(spec=bench.options.policy, options=given)
        started = time.perf_counter()
        found = evaluate(
            EvaluationConfig(
                policies=spec, task="pick_cube", out=Path(folder) / "evaluation", episodes=episodes, workers=2,
                size=bench.options.size,
            )
        )  # fmt: skip
        wall = time.perf_counter() - started
    busy = sum(result.wall_s for result in found.results) / 2
    bench.row(part="evaluate: episodes", percent=round(100 * busy / wall, 1))
    bench.row(part="evaluate: start and report", percent=round(100 * (wall - busy) / wall, 1))
    bench.finish("share of an episode beside policy and simulator", round(own, 1), "%", at_most=10)


def _ports(folder: Path, bench: Bench, given: dict[str, str], episodes: int) -> Counter[str]:
    """Return the wall time of each part of some episodes [s]."""
    seconds: Counter[str] = Counter()
    names = {"draw": "drawing the scene", "judge": "judge", "start": "judge"}
    policy = load_policy(bench.options.policy, **given)
    with CoreGraph(folder, policy=policy) as graph:
        ports = graph.ports
        timed: Any = replace(
            ports,
            scenes=_Timed(ports.scenes, lambda name: names[name], seconds),
            judge=_Timed(ports.judge, lambda name: "judge", seconds),
            sim=_Timed(ports.sim, lambda name: "simulator", seconds),
            actor=_Timed(ports.actor, lambda name: "policy", seconds),
            recorder=_Timed(ports.recorder, lambda name: "recorder", seconds),
        )
        side = bench.options.size
        config = RunConfig(output_dir=str(folder), image_width=side, image_height=side)
        runner = EpisodeRunner(timed, config)
        runner.run_index(1000)  # loads and compiles
        seconds.clear()
        started = time.perf_counter()
        for index in range(episodes):
            runner.run_index(index)
        seconds["loop"] = time.perf_counter() - started - sum(seconds.values())
    return seconds


if __name__ == "__main__":
    main()
