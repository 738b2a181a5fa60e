"""What an evaluation spends on anything but the policy and the simulator, in processor time and in wall time.

First the share of each port of the episode loop, in one process: drawing the scene, simulator (building the world,
settling, physics, rendering), observation (proprioception), policy, judge, recorder and the loop itself. Then three
evaluations as an experiment runs them, with two workers: one whose workers start, a short one in the same processes,
and a longer one, which together tell the time of a start from that of an episode. The headline counts processor time,
since other jobs of the machine change it little. Both sides run the same episodes; the program ends with an error if
they take another number of steps.

Wall time is compared with one worker, by a short and a longer evaluation: the simulator alone draws with several
threads, so two workers on two cores slow each other down, and their wall time cannot be compared with that of one
process. What a worker does beside its simulator (compressing a tick while the next one is simulated) counts as
processor time but not as wall time. Wall times hold on a quiet machine only: look at the load that is printed.
"""

from __future__ import annotations

import argparse
import os
import resource
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks._harness import Bench

from roboxim_bringup.core_graph import CoreGraph
from roboxim_bringup.executors import KeptProcesses, LocalExecutor
from roboxim_bringup.runs.evaluation import EvaluationConfig, evaluate
from roboxim_bringup.runs.policies import PolicySpec
from roboxim_bringup.task_choice import task_text
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_policies.base import load_policy

SHORT = 2
"""Episodes of the short evaluations, one for each worker."""
TASK = "pick_cube"
TYPICAL = 120
"""Episodes of the evaluation that the headline is about: six held-out cells with 20 rollouts each."""


@dataclass(frozen=True, kw_only=True)
class Spent:
    """Time that something took."""

    cpu_s: float
    """Processor time [s]."""
    wall_s: float
    """Wall time [s]."""

    def __sub__(self, other: Spent) -> Spent:
        """Return the difference."""
        return Spent(cpu_s=self.cpu_s - other.cpu_s, wall_s=self.wall_s - other.wall_s)

    def __mul__(self, factor: float) -> Spent:
        """Return a multiple."""
        return Spent(cpu_s=factor * self.cpu_s, wall_s=factor * self.wall_s)


class _Timed:
    """A port whose calls are timed, in processor time and in wall time."""

    def __init__(self, port: Any, name_of: Callable[[str], str], cpu: Counter[str], wall: Counter[str]) -> None:
        self._port, self._name_of, self._cpu, self._wall = port, name_of, cpu, wall

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._port, name)
        if not callable(found):
            return found

        def timed(*given: Any, **named: Any) -> Any:
            cpu, wall = time.process_time(), time.monotonic()
            try:
                return found(*given, **named)
            finally:
                self._cpu[self._name_of(name)] += time.process_time() - cpu
                self._wall[self._name_of(name)] += time.monotonic() - wall

        return timed


def main() -> None:
    """Measure both."""

    def options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--policy", default="zero", help="policy, e.g. bc with --checkpoint")
        parser.add_argument("--checkpoint", default="", help="checkpoint of the policy")
        parser.add_argument("--size", type=int, default=128, help="side of the images [px]")

    bench = Bench("overhead", __doc__, options)
    given = {"checkpoint": bench.options.checkpoint} if bench.options.checkpoint else {}
    episodes = 2 if bench.quick else 12
    with tempfile.TemporaryDirectory(prefix="roboxim-overhead-") as name:
        folder = Path(name)
        cpu, wall, steps = _ports(folder, bench, given, range(SHORT, SHORT + episodes))
        spec = PolicySpec(spec=bench.options.policy, options=given)
        with KeptProcesses() as kept:

            def evaluated(name: str, count: int, workers: int) -> Spent:
                spent, found = _evaluation(folder / name, spec, count, workers, bench.options.size, kept)
                if found[SHORT:] not in ([], steps):
                    raise SystemExit(f"steps of the episodes: {found[SHORT:]} in {name}, {steps} in one process")
                return spent

            first, again = evaluated("first", SHORT, 2), evaluated("again", SHORT, 2)
            longer = evaluated("longer", SHORT + episodes, 2)
            alone, alone_longer = evaluated("alone", SHORT, 1), evaluated("alone-longer", SHORT + episodes, 1)
    for part, value in cpu.most_common():
        bench.row(
            part=f"episode in one process: {part}", cpu_s=round(value / episodes, 2),
            percent=_percent(value, cpu.total()), wall_s=round(wall[part] / episodes, 2),
        )  # fmt: skip
    wanted = Spent(cpu_s=_wanted(cpu) / episodes, wall_s=_wanted(wall) / episodes)
    episode, episode_alone = (longer - again) * (1 / episodes), (alone_longer - alone) * (1 / episodes)
    start, start_alone = again - episode * SHORT, alone - episode_alone * SHORT
    for part, spent in (
        ("episode of an evaluation, two workers", episode),
        ("start and end of the first evaluation, two workers", first - episode * SHORT),
        ("start and end of a further one, two workers", start),
        ("episode of an evaluation, one worker", episode_alone),
        ("start and end of a further one, one worker", start_alone),
    ):
        bench.row(part=part, cpu_s=round(spent.cpu_s, 2), percent="", wall_s=round(spent.wall_s, 2))
    bench.row(
        part=f"share beside policy and simulator, {TYPICAL} episodes, one worker: wall time", cpu_s="",
        percent=_percent(start_alone.wall_s + TYPICAL * (episode_alone.wall_s - wanted.wall_s),
                         start_alone.wall_s + TYPICAL * episode_alone.wall_s),
        wall_s="",
    )  # fmt: skip
    own = 1 - TYPICAL * wanted.cpu_s / (start.cpu_s + TYPICAL * episode.cpu_s)
    bench.finish(
        f"share beside policy and simulator in an experiment's evaluation of {TYPICAL} episodes, processor time",
        round(100 * own, 1), "%", at_most=10,
    )  # fmt: skip


def _wanted(seconds: Counter[str]) -> float:
    return seconds["policy"] + seconds["simulator"]


def _percent(part: float, whole: float) -> float:
    return round(100 * part / whole, 1)


def _evaluation(
    out: Path, policy: PolicySpec, episodes: int, workers: int, size: int, kept: KeptProcesses
) -> tuple[Spent, list[int]]:
    """Return the time of an evaluation, and the steps of its episodes."""
    config = EvaluationConfig(
        policies=policy, task=TASK, out=out, episodes=episodes, workers=workers, size=size, page=False
    )
    executor = LocalExecutor(workers, log_dir=out.with_name(f"{out.name}-logs"), kept=kept)
    cpu, wall = _cpu_s(kept), time.monotonic()
    result = evaluate(config, executor=executor)
    spent = Spent(cpu_s=_cpu_s(kept) - cpu, wall_s=time.monotonic() - wall)
    result.require_measured()
    return spent, [one.steps for one in sorted(result.first.results, key=lambda one: one.index)]


def _cpu_s(kept: KeptProcesses) -> float:
    """Return the processor time of this process, its ended children and the kept ones [s]."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    found = time.process_time() + ended.ru_utime + ended.ru_stime
    for pid in kept.pids():
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        found += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return found


def _ports(
    folder: Path, bench: Bench, given: dict[str, str], episodes: range
) -> tuple[Counter[str], Counter[str], list[int]]:
    """Return the processor time and the wall time of each part of some episodes [s], and their steps."""
    cpu: Counter[str] = Counter()
    wall: Counter[str] = Counter()
    names = {"draw": "drawing the scene", "judge": "judge", "start": "judge"}
    policy = load_policy(bench.options.policy, **given)
    with CoreGraph(folder, policy=policy) as graph:
        ports = graph.ports
        timed: Any = replace(
            ports,
            scenes=_Timed(ports.scenes, lambda name: names[name], cpu, wall),
            judge=_Timed(ports.judge, lambda name: "judge", cpu, wall),
            sim=_Timed(ports.sim, lambda name: "observation" if name == "observe" else "simulator", cpu, wall),
            actor=_Timed(ports.actor, lambda name: "policy", cpu, wall),
            recorder=_Timed(ports.recorder, lambda name: "recorder", cpu, wall),
        )
        side = bench.options.size
        config = RunConfig(task_config=task_text(TASK), output_dir=str(folder), image_width=side, image_height=side)
        runner = EpisodeRunner(timed, config)
        runner.run_index(0)  # loads and compiles
        cpu.clear()
        wall.clear()
        cpu_began, wall_began = time.process_time(), time.monotonic()
        steps = [runner.run_index(index).steps for index in episodes]
        cpu["loop"] = time.process_time() - cpu_began - cpu.total()
        wall["loop"] = time.monotonic() - wall_began - wall.total()
    return cpu, wall, steps


if __name__ == "__main__":
    main()
