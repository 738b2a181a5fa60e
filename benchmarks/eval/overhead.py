"""What an evaluation spends on anything but the policy and the simulator, in processor time.

First the share of each port of the episode loop, in one process: drawing the scene, simulator, policy, judge, recorder
and the loop itself. Then three evaluations as an experiment runs them: one whose workers start, a short one in the same
processes, and a longer one, which together tell the time of a start from that of an episode. Processor time is counted
since other jobs of the machine change it little.
"""

from __future__ import annotations

import argparse
import os
import resource
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks._harness import Bench

from roboxim_bringup.core_graph import CoreGraph
from roboxim_bringup.executors import KeptProcesses, LocalExecutor
from roboxim_bringup.runs.evaluation import EvaluationConfig, evaluate
from roboxim_bringup.runs.policies import PolicySpec
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_policies.base import load_policy

SHORT = 2
"""Episodes of the short evaluations, one for each worker."""
TYPICAL = 120
"""Episodes of the evaluation that the headline is about: six held-out cells with 20 rollouts each."""


class _Timed:
    """A port whose calls are timed."""

    def __init__(self, port: Any, name_of: Callable[[str], str], seconds: Counter[str]) -> None:
        self._port, self._name_of, self._seconds = port, name_of, seconds

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._port, name)
        if not callable(found):
            return found

        def timed(*given: Any, **named: Any) -> Any:
            started = time.process_time()
            try:
                return found(*given, **named)
            finally:
                self._seconds[self._name_of(name)] += time.process_time() - started

        return timed


def main() -> None:
    """Measure both."""

    def options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--policy", default="zero", help="policy, e.g. bc with --checkpoint")
        parser.add_argument("--checkpoint", default="", help="checkpoint of the policy")
        parser.add_argument("--size", type=int, default=128, help="side of the images [px]")

    bench = Bench("overhead", __doc__, options)
    given = {"checkpoint": bench.options.checkpoint} if bench.options.checkpoint else {}
    episodes = 2 if bench.quick else 6
    with tempfile.TemporaryDirectory(prefix="roboxim-overhead-") as name:
        folder = Path(name)
        seconds = _ports(folder, bench, given, episodes)
        spec = PolicySpec(spec=bench.options.policy, options=given)
        with KeptProcesses() as kept:
            first, again, longer = (
                _evaluation(folder / str(number), spec, count, bench.options.size, kept)
                for number, count in enumerate((SHORT, SHORT, SHORT + 2 * episodes))
            )
    whole = sum(seconds.values())
    for part, value in seconds.most_common():
        bench.row(
            part=f"episode in one process: {part}", cpu_s=round(value / episodes, 2), percent=_percent(value, whole)
        )
    wanted = (seconds["policy"] + seconds["simulator"]) / episodes
    episode = (longer - again) / (2 * episodes)
    start = again - SHORT * episode
    bench.row(part="episode of an evaluation", cpu_s=round(episode, 2), percent="")
    bench.row(part="start and end of the first evaluation", cpu_s=round(first - SHORT * episode, 2), percent="")
    bench.row(part="start and end of a further one", cpu_s=round(start, 2), percent="")
    own = 1 - TYPICAL * wanted / (start + TYPICAL * episode)
    bench.finish(
        f"share beside policy and simulator in an experiment's evaluation of {TYPICAL} episodes",
        round(100 * own, 1), "%", at_most=10,
    )  # fmt: skip


def _percent(part: float, whole: float) -> float:
    return round(100 * part / whole, 1)


def _evaluation(out: Path, policy: PolicySpec, episodes: int, size: int, kept: KeptProcesses) -> float:
    """Return the processor time of an evaluation with two workers [s]."""
    config = EvaluationConfig(
        policies=policy, task="pick_cube", out=out, episodes=episodes, workers=2, size=size, page=False
    )
    before = _cpu_s(kept)
    evaluate(config, executor=LocalExecutor(2, log_dir=out.with_name(f"{out.name}-logs"), kept=kept)).require_measured()
    return _cpu_s(kept) - before


def _cpu_s(kept: KeptProcesses) -> float:
    """Return the processor time of this process, its ended children and the kept ones [s]."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    found = time.process_time() + ended.ru_utime + ended.ru_stime
    for pid in kept.pids():
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        found += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return found


def _ports(folder: Path, bench: Bench, given: dict[str, str], episodes: int) -> Counter[str]:
    """Return the processor time of each part of some episodes [s]."""
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
        started = time.process_time()
        for index in range(episodes):
            runner.run_index(index)
        seconds["loop"] = time.process_time() - started - sum(seconds.values())
    return seconds


if __name__ == "__main__":
    main()
