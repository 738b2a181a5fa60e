"""What an evaluation spends on anything but the policy and the simulator, in wall time and in processor time.

In each of several rounds, episodes run in one process, where the time of each port of the episode loop is taken:
drawing the scene, simulator (building the world, settling, physics, rendering), observation (proprioception), policy,
judge, recorder and the loop itself. Then the same episodes run as evaluations, as an experiment runs them, whose
workers are ready from the evaluation before: a short and a longer one with one worker, and both with two. The
difference of the two tells the time of an episode, the rest is that of a start and an end. The rounds take turns, so
that a machine whose speed drifts is slow for all of them; the sums of the rounds are compared, and the range over the
rounds is printed.

The headline is the share of the wall time of one worker. The simulator alone draws with several threads, so two workers
on two cores slow each other down, and their wall time cannot be compared with that of one process; of two workers the
processor time is compared. What a worker does beside its simulator (compressing a tick while the next one is
simulated) counts as processor time but not as wall time. Wall times hold on a quiet machine only: look at the load that
is printed. The program ends with an error if the episodes of both sides take another number of steps.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
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
    episodes, rounds = (2, 1) if bench.quick else (12, 5)
    spec = PolicySpec(spec=bench.options.policy, options=given)
    with (
        tempfile.TemporaryDirectory(prefix="roboxim-overhead-") as name,
        KeptProcesses() as one,
        KeptProcesses() as two,
    ):
        folder, kept = Path(name), {1: one, 2: two}
        first, _ = _evaluation(folder / "first", spec, SHORT, 2, bench.options.size, two)
        _evaluation(folder / "first-alone", spec, SHORT, 1, bench.options.size, one)
        with _Ports(folder / "ports", bench, given) as ports:
            found = [_round(folder / f"round{number}", ports, spec, episodes, kept) for number in range(rounds)]
        cpu, wall = ports.cpu, ports.wall
    for part, value in cpu.most_common():
        bench.row(
            part=f"episode in one process: {part}", cpu_s=round(value / episodes / rounds, 3),
            percent=_percent(value, cpu.total()), wall_s=round(wall[part] / episodes / rounds, 3),
        )  # fmt: skip
    both = _mean(found)
    for part, spent in (
        ("episode of an evaluation, one worker", both.one.episode),
        ("start and end of an evaluation, one worker", both.one.start),
        ("episode of an evaluation, two workers", both.two.episode),
        ("start and end of an evaluation, two workers", both.two.start),
        ("start and end of the first evaluation, two workers", first - both.two.episode * SHORT),
    ):
        bench.row(part=part, cpu_s=round(spent.cpu_s, 3), percent="", wall_s=round(spent.wall_s, 3))
    for part, share_of in (("one worker: wall time", _wall_share), ("two workers: processor time", _cpu_share)):
        shares = sorted(share_of(one) for one in found)
        bench.row(
            part=f"share beside policy and simulator, {TYPICAL} episodes, {part}; rounds {shares[0]} to {shares[-1]}",
            cpu_s="", percent=share_of(both), wall_s="",
        )  # fmt: skip
    bench.finish(
        f"share beside policy and simulator in an evaluation of {TYPICAL} episodes with one worker, wall time",
        _wall_share(both), "%", at_most=10,
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Cost:
    """Time of evaluations with some number of workers."""

    episode: Spent
    """Of an episode."""
    start: Spent
    """Of a start and an end."""


@dataclass(frozen=True, kw_only=True)
class Round:
    """Times of a round."""

    wanted: Spent
    """Of an episode's policy and simulator in one process."""
    one: Cost
    """Of evaluations with one worker."""
    two: Cost
    """With two."""


def _mean(rounds: Sequence[Round]) -> Round:
    def mean(pick: Callable[[Round], Spent]) -> Spent:
        found = [pick(one) for one in rounds]
        return Spent(cpu_s=fmean(one.cpu_s for one in found), wall_s=fmean(one.wall_s for one in found))

    return Round(
        wanted=mean(lambda one: one.wanted),
        one=Cost(episode=mean(lambda one: one.one.episode), start=mean(lambda one: one.one.start)),
        two=Cost(episode=mean(lambda one: one.two.episode), start=mean(lambda one: one.two.start)),
    )


def _wall_share(found: Round) -> float:
    """Return the share of the wall time of a typical evaluation with one worker [%]."""
    whole = found.one.start.wall_s + TYPICAL * found.one.episode.wall_s
    return _percent(whole - TYPICAL * found.wanted.wall_s, whole)


def _cpu_share(found: Round) -> float:
    """Return the share of the processor time of a typical evaluation with two workers [%]."""
    whole = found.two.start.cpu_s + TYPICAL * found.two.episode.cpu_s
    return _percent(whole - TYPICAL * found.wanted.cpu_s, whole)


def _round(folder: Path, ports: _Ports, spec: PolicySpec, episodes: int, kept: Mapping[int, KeptProcesses]) -> Round:
    wanted, steps = ports.run(range(SHORT, SHORT + episodes))

    def evaluated(name: str, count: int, workers: int) -> Spent:
        spent, found = _evaluation(folder / name, spec, count, workers, ports.size, kept[workers])
        if found[SHORT:] not in ([], steps):
            raise SystemExit(f"steps of the episodes: {found[SHORT:]} in {name}, {steps} in one process")
        return spent

    def cost(workers: int) -> Cost:
        short = evaluated(f"{workers}-short", SHORT, workers)
        longer = evaluated(f"{workers}-longer", SHORT + episodes, workers)
        episode = (longer - short) * (1 / episodes)
        return Cost(episode=episode, start=short - episode * SHORT)

    return Round(wanted=wanted, one=cost(1), two=cost(2))


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


class _Ports:
    """Runs episodes in this process and takes the time of their parts."""

    def __init__(self, folder: Path, bench: Bench, given: dict[str, str]) -> None:
        self.cpu: Counter[str] = Counter()
        """Processor time of each part [s]."""
        self.wall: Counter[str] = Counter()
        """Its wall time [s]."""
        self.size = side = bench.options.size
        names = {"draw": "drawing the scene", "judge": "judge", "start": "judge"}
        self._folder = folder
        self._graph = CoreGraph(folder, policy=load_policy(bench.options.policy, **given))
        ports = self._graph.ports

        def timed(port: Any, name_of: Callable[[str], str]) -> Any:
            return _Timed(port, name_of, self.cpu, self.wall)

        self._ports = replace(
            ports,
            scenes=timed(ports.scenes, lambda name: names[name]),
            judge=timed(ports.judge, lambda name: "judge"),
            sim=timed(ports.sim, lambda name: "observation" if name == "observe" else "simulator"),
            actor=timed(ports.actor, lambda name: "policy"),
            recorder=timed(ports.recorder, lambda name: "recorder"),
        )
        config = RunConfig(task_config=task_text(TASK), output_dir=str(folder), image_width=side, image_height=side)
        self._runner = EpisodeRunner(self._ports, config)
        self._runner.run_index(0)  # loads and compiles
        self.cpu.clear()
        self.wall.clear()

    def __enter__(self) -> _Ports:
        return self

    def __exit__(self, *error: object) -> None:
        self._graph.__exit__(*error)

    def run(self, episodes: range) -> tuple[Spent, list[int]]:
        """Return the time of policy and simulator in an episode, and the steps of the episodes."""
        before = self._wanted(), self.cpu.total(), self.wall.total()
        cpu_began, wall_began = time.process_time(), time.monotonic()
        steps = [self._runner.run_index(index).steps for index in episodes]
        self.cpu["loop"] += time.process_time() - cpu_began - (self.cpu.total() - before[1])
        self.wall["loop"] += time.monotonic() - wall_began - (self.wall.total() - before[2])
        for bag in self._folder.glob("*/eval-*"):  # the next round records them again
            shutil.rmtree(bag)
        return (self._wanted() - before[0]) * (1 / len(episodes)), steps

    def _wanted(self) -> Spent:
        return Spent(
            cpu_s=self.cpu["policy"] + self.cpu["simulator"], wall_s=self.wall["policy"] + self.wall["simulator"]
        )


if __name__ == "__main__":
    main()
