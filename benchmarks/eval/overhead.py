"""What an evaluation spends on anything but the policy and the simulator, in wall time and in processor time.

An evaluation runs as in an experiment, with one worker, whose process is ready from the evaluation before. Before every
tenth of its episodes, the next ten run without nodes in this process, while the worker waits. There the time of each
part is taken: choosing the scene, simulator (loading itself, building the world, settling, physics, rendering; the
pictures that tell what is visible in a scene are rendering), observation (proprioception), policy (loading it, reset,
answers), judge, recorder and the loop itself. The evaluation's own share is what it takes longer than simulator and
policy take here, its start and end included. Both sides begin with a process that has run episodes, and load simulator
and policy anew. Loading and the pictures that tell what is visible have rows of their own.

Both sides take turns within seconds, so a machine whose speed drifts is slow for both; the range over groups of
episodes tells what noise is left. This process has the settings of a worker: libraries with one thread each, and no
search for garbage among what is loaded.

The headline is the share of wall time. What a worker does beside its simulator (compressing a tick while the next one
is simulated) counts as processor time but not as wall time. The simulator draws with several threads, so two workers on
two cores slow each other down, and their wall time cannot be compared with that of one process. Wall times hold on a
quiet machine only: look at the load that is printed. The program ends with an error if the episodes of both sides take
another number of steps.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import os
import resource
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

from benchmarks._harness import Bench

from roboxim_bringup import core_graph
from roboxim_bringup.process import THREAD_COUNTS
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_policies.base import load_policy
from roboxim_runs.episodes.task_choice import task_text
from roboxim_runs.evaluation.run import EvaluationConfig, evaluate
from roboxim_runs.executors import KeptProcesses, LocalExecutor, local
from roboxim_runs.executors.worker_process import WorkerProcess
from roboxim_runs.policies.specs import PolicySpec

TASK = "pick_cube"
TYPICAL = 120
"""Episodes of an evaluation: six held-out cells with 20 rollouts each."""
GROUP = 20
"""Episodes of a group, whose share is printed."""
ONE_THREAD = dict.fromkeys(THREAD_COUNTS, "1")
"""Environment variables of a worker."""
LOADING, VISIBLE = "loading policy and simulator", "simulator: what is visible"
"""Parts that belong to policy and simulator: before the first episode, and while a scene is chosen."""
WANTED = ("policy", "simulator", VISIBLE)
"""Parts of an episode that are not the evaluation's own."""
TURN = 10
"""Episodes that one side runs before it is the other's turn: after a pause a process has cold caches."""


@dataclass(frozen=True, kw_only=True)
class Spent:
    """Time that something took."""

    cpu_s: float
    """Processor time [s]."""
    wall_s: float
    """Wall time [s]."""

    def __add__(self, other: Spent) -> Spent:
        """Return the sum."""
        return Spent(cpu_s=self.cpu_s + other.cpu_s, wall_s=self.wall_s + other.wall_s)

    def __sub__(self, other: Spent) -> Spent:
        """Return the difference."""
        return Spent(cpu_s=self.cpu_s - other.cpu_s, wall_s=self.wall_s - other.wall_s)


NOTHING = Spent(cpu_s=0.0, wall_s=0.0)


class Times:
    """Processor time and wall time of parts. What is within another part counts for the inner one alone."""

    def __init__(self) -> None:
        """Start at zero."""
        self.cpu: Counter[str] = Counter()
        """Processor time of each part [s]."""
        self.wall: Counter[str] = Counter()
        """Its wall time [s]."""
        self._inner = [NOTHING]

    @contextlib.contextmanager
    def of(self, part: str) -> Iterator[None]:
        """Count the block for a part."""
        self._inner.append(NOTHING)
        cpu, wall = time.process_time(), time.monotonic()
        try:
            yield
        finally:
            passed = Spent(cpu_s=time.process_time() - cpu, wall_s=time.monotonic() - wall)
            own = passed - self._inner.pop()
            self.cpu[part] += own.cpu_s  # type: ignore[assignment]
            self.wall[part] += own.wall_s  # type: ignore[assignment]
            self._inner[-1] += passed

    def timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that counts its calls for a part."""

        def timed(*given: Any, **named: Any) -> Any:
            with self.of(part):
                return function(*given, **named)

        return timed

    def total(self, *parts: str) -> Spent:
        """Return the sum over some parts."""
        return Spent(cpu_s=sum(self.cpu[part] for part in parts), wall_s=sum(self.wall[part] for part in parts))


class Ports:
    """Runs episodes in this process and takes the time of their parts; belongs to the thread that made it."""

    def __init__(self, folder: Path, size: int, policy: str, given: dict[str, str]) -> None:
        """Make the rooms and run an episode, which imports and compiles; then make the rooms that are measured.

        Args:
            folder: Folder of the bags.
            size: Side of the images [px].
            policy: The policy.
            given: Its arguments.
        """
        self.times = Times()
        """Times of the parts."""
        self.steps: list[int] = []
        """Steps of each episode."""
        self.wanted: list[Spent] = []
        """Time of policy and simulator in each episode."""
        config = RunConfig(task_config=task_text(TASK), output_dir=str(folder), image_width=size, image_height=size)
        with core_graph.CoreGraph(folder, policy=load_policy(policy, **given)) as before:
            EpisodeRunner(before.ports, replace(config, run_seed=1)).run_index(0)
        del before
        gc.collect()  # as a worker's process does when it rests
        with self.times.of(LOADING):
            loaded = load_policy(policy, **given)
        with patch.object(core_graph, "CoreSim", self.times.timed(LOADING, core_graph.CoreSim)):
            self.graph = core_graph.CoreGraph(folder, policy=loaded)
        self.loading = self.times.total(LOADING)
        """Time of loading policy and simulator, without what the first episode loads."""
        self._runner = EpisodeRunner(self._timed_ports(), config)

    def _timed_ports(self) -> Any:
        """Return the ports with the parts that their methods belong to."""
        timed, ports, segmentation = self.times.timed, self.graph.ports, self.graph.segmentation
        setattr(segmentation, "segment", timed(VISIBLE, segmentation.segment))  # noqa: B010 (replaced on purpose)
        names = {"draw": "choosing the scene", "judge": "judge", "start": "judge"}
        return replace(
            ports,
            scenes=_Timed(ports.scenes, names.__getitem__, timed),
            judge=_Timed(ports.judge, lambda name: "judge", timed),
            sim=_Timed(ports.sim, lambda name: "observation" if name == "observe" else "simulator", timed),
            actor=_Timed(ports.actor, lambda name: "policy", timed),
            recorder=_Timed(ports.recorder, lambda name: "recorder", timed),
        )

    def run(self, index: int) -> None:
        """Run an episode."""
        before = self.times.total(*WANTED)
        with self.times.of("loop"):
            self.steps.append(self._runner.run_index(index).steps)
        self.wanted.append(self.times.total(*WANTED) - before)
        if len(self.wanted) == 1:
            gc.collect()
            gc.freeze()  # as a worker's process does after its first episode


class _Timed:
    """A port whose calls are timed."""

    def __init__(self, port: Any, name_of: Callable[[str], str], timed: Callable[..., Any]) -> None:
        self._port, self._name_of, self._timed = port, name_of, timed

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._port, name)
        return self._timed(self._name_of(name), found) if callable(found) else found


class Turns:
    """Lets the episodes of an evaluation take turns with those of `Ports`."""

    def __init__(self, count: int, make: Callable[[], Ports], kept: KeptProcesses) -> None:
        """Begin with none.

        Args:
            count: Episodes of the evaluation, whose indices begin at 0.
            make: Makes the ports, in the thread that waits for the worker.
            kept: The worker's processes.
        """
        self.ports: Ports | None = None
        """The ports, made before the first episode."""
        self.episodes: list[Spent] = []
        """Time of each of the evaluation's episodes."""
        self.away = NOTHING
        """Time that the evaluation waited for the ports."""
        self._count, self._make, self._kept = count, make, kept

    @contextlib.contextmanager
    def waiting(self) -> Iterator[None]:
        """Count the time of the block as that for which the evaluation waits."""
        cpu, wall = time.process_time(), time.monotonic()
        yield
        self.away += Spent(cpu_s=time.process_time() - cpu, wall_s=time.monotonic() - wall)

    def worker(self) -> type[WorkerProcess]:
        """Return the class of the evaluation's worker."""
        turns = self

        class TakingTurns(WorkerProcess):
            def run(self, job: Any, on_note: Callable[[Any], None]) -> Any:
                with turns.waiting():
                    if turns.ports is None:
                        turns.ports = turns._make()
                    for index in range(job, min(job + TURN, turns._count)) if job % TURN == 0 else ():
                        turns.ports.run(index)
                cpu, wall = cpu_s(turns._kept), time.monotonic()
                try:
                    return super().run(job, on_note)
                finally:
                    turns.episodes.append(Spent(cpu_s=cpu_s(turns._kept) - cpu, wall_s=time.monotonic() - wall))

            def end(self) -> bool:
                with turns.waiting():
                    if turns.ports is not None:
                        turns.ports.graph.__exit__(None, None, None)
                return super().end()

        return TakingTurns


def main() -> None:
    """Measure both."""

    def options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--policy", default="zero", help="policy, e.g. bc with --checkpoint")
        parser.add_argument("--checkpoint", default="", help="checkpoint of the policy")
        parser.add_argument("--size", type=int, default=128, help="side of the images [px]")

    if not ONE_THREAD.items() <= os.environ.items():  # libraries read them when they are imported
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], {**os.environ, **ONE_THREAD})
    bench = Bench("overhead", __doc__, options)
    policy, size = bench.options.policy, bench.options.size
    given = {"checkpoint": bench.options.checkpoint} if bench.options.checkpoint else {}
    spec = PolicySpec(spec=policy, options=given)
    count = 8 if bench.quick else TYPICAL
    with tempfile.TemporaryDirectory(prefix="roboxim-overhead-") as name, KeptProcesses() as kept:
        folder = Path(name)
        first, _ = evaluation(folder / "first", spec, 2, size, kept)
        turns = Turns(count, lambda: Ports(folder / "ports", size, policy, given), kept)
        with patch.object(local, "WorkerProcess", turns.worker()):
            whole, steps = evaluation(folder / "typical", spec, count, size, kept)
    ports = turns.ports
    assert ports is not None
    if steps != ports.steps:
        raise SystemExit(f"steps of the episodes: {steps} in the evaluation, {ports.steps} in one process")
    whole -= turns.away
    wanted, episodes = _total(ports.wanted), _total(turns.episodes)
    parts = Counter({part: spent for part, spent in ports.times.cpu.items() if part != LOADING})
    for part, spent in parts.most_common():
        bench.row(
            part=f"episode in one process: {part}", cpu_ms=round(1000 * spent / count, 1),
            wall_ms=round(1000 * ports.times.wall[part] / count, 1), percent=_percent(spent, parts.total()),
        )  # fmt: skip
    for part, passed, times in (
        ("policy and simulator in one process", wanted, count),
        ("episode of an evaluation", episodes, count),
        (f"{LOADING} in one process", ports.loading, 1),
        ("start and end of an evaluation", whole - episodes, 1),
        ("start and end of the first one", first - _total(turns.episodes[:2]), 1),
    ):
        bench.row(
            part=part, cpu_ms=round(1000 * passed.cpu_s / times, 1), wall_ms=round(1000 * passed.wall_s / times, 1),
            percent="",
        )  # fmt: skip
    groups = [slice(at, at + GROUP) for at in range(0, count, GROUP)]
    shares = [_own(_total(ports.wanted[one]).wall_s, _total(turns.episodes[one]).wall_s) for one in groups]
    for part, share in (
        (f"share of wall time, without start and end: least of {len(groups)} groups", min(shares)),
        (f"share of wall time, without start and end: most of {len(groups)} groups", max(shares)),
        (
            f"share of processor time, {count} episodes, start and end included",
            _own((wanted + ports.loading).cpu_s, whole.cpu_s),
        ),
    ):
        bench.row(part=part, cpu_ms="", wall_ms="", percent=share)
    bench.finish(
        f"share of an evaluation's wall time beside policy and simulator, {count} episodes, start and end included",
        _own((wanted + ports.loading).wall_s, whole.wall_s), "%", at_most=10,
    )  # fmt: skip


def _total(spent: list[Spent]) -> Spent:
    return sum(spent, NOTHING)


def _own(wanted: float, whole: float) -> float:
    """Return the share of what is not wanted [%]."""
    return _percent(whole - wanted, whole)


def _percent(part: float, whole: float) -> float:
    return round(100 * part / whole, 1)


def evaluation(out: Path, policy: PolicySpec, episodes: int, size: int, kept: KeptProcesses) -> tuple[Spent, list[int]]:
    """Return the time of an evaluation, and the steps of its episodes."""
    config = EvaluationConfig(policies=policy, task=TASK, out=out, episodes=episodes, workers=1, size=size, page=False)
    executor = LocalExecutor(1, log_dir=out.with_name(f"{out.name}-logs"), kept=kept)
    cpu, wall = cpu_s(kept), time.monotonic()
    result = evaluate(config, executor=executor)
    spent = Spent(cpu_s=cpu_s(kept) - cpu, wall_s=time.monotonic() - wall)
    result.require_measured()
    return spent, [one.steps for one in sorted(result.first.results, key=lambda one: one.index)]


def cpu_s(kept: KeptProcesses) -> float:
    """Return the processor time of this process, its ended children and the kept ones [s]."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    found = time.process_time() + ended.ru_utime + ended.ru_stime
    for pid in kept.pids():
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        found += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return found


if __name__ == "__main__":
    main()
