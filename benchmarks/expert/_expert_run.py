"""Execution of one expert episode through the cores, with the figures that the table reports."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from roboxim_bringup.core_graph import CoreGraph, CoreTasks
from roboxim_core.actions import ActionArray, ActionSemantics
from roboxim_core.episode import Draw, EpisodeRunner, Ports, RunConfig
from roboxim_core.models.library import ModelLibrary
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_core.state import StateRecord
from roboxim_sim.world import World
from roboxim_tasks.components.distractors import NearConfig, distance_to
from roboxim_tasks.config import parse_task_config
from roboxim_tasks.roles import task_distractors
from roboxim_tasks.sampling.visible import Visibility

NOISE_M, NOISE_RAD = 0.003, 0.01
DISTURBED_M = 0.01


@dataclass(kw_only=True)
class Outcome:
    """The outcome of one episode, written as a line of JSON."""

    cell: str
    index: int
    first_try: bool
    """Whether it succeeded without a second grasp, judged after settling."""
    recovered: bool
    reason: str
    """Reason of the failure; empty: it succeeded."""
    ticks: int
    reset_ms: float
    """Time from the seed to the settled scene [ms]."""
    draws: int
    rejections: Mapping[str, int]
    """Number of rejected placements by constraint."""
    seen_share: float
    """Smallest fraction of a named object's silhouette that the workspace camera sees at tick 0."""
    seen_px: int
    """Smallest number of pixels of a named object, in an image of 128 x 128."""
    near: bool
    """Whether a distractor starts close to the target, by the cell's own distance (default: 10 cm)."""
    disturbed: int
    """Number of distractors that moved by more than 1 cm."""
    replayed: bool | None
    """Whether an open-loop replay from the restored scene gave the same hashes and success; none: not replayed."""
    seconds: float


@dataclass
class _Watch:
    """A proxy between the loop and its ports that records the data for the outcome."""

    ports: Ports
    library: ModelLibrary
    sight: Visibility
    near_config: NearConfig
    states: list[StateRecord] = field(default_factory=list)
    actions: list[ActionArray] = field(default_factory=list)
    scene: SceneSpec | None = None
    task: TaskSpec | None = None
    reset_s: float = 0.0
    seen: tuple[float, int] = (0.0, 0)

    # the scenes' port
    def draw(self, seed: SeedPath, task_config: str) -> Draw:
        start = time.perf_counter()
        drawn = self.ports.scenes.draw(seed, task_config)
        self.reset_s, self.task = time.perf_counter() - start, drawn.task
        return drawn

    # the sim's port; cameras are looked through once
    def load(self, episode_id: str, scene: SceneSpec, semantics: ActionSemantics) -> StateRecord:
        self.scene = replace(scene, cameras=())
        start = time.perf_counter()
        state = self.ports.sim.load(episode_id, self.scene, semantics)
        self.reset_s += time.perf_counter() - start
        self.states, self.actions = [state], []
        assert self.task is not None
        sights = self.sight.look(self.task, scene, state)
        self.seen = min(sight.share for sight in sights), min(sight.pixels for sight in sights)
        return state

    def tick(self, episode_id: str, seq: int, action: ActionArray) -> StateRecord:
        state = self.ports.sim.tick(episode_id, seq, action)
        self.states.append(state)
        self.actions.append(np.array(state.action_executed, np.float32))
        return state

    def __getattr__(self, name: str) -> Any:
        return getattr(self.ports.sim, name)

    @property
    def moved(self) -> int:
        """Distractors that moved."""
        assert self.task is not None
        first, last = ({e.name: e.pose.position for e in self.states[i].entities} for i in (0, -1))
        names = [thing.entity for thing in task_distractors(self.task)]
        return sum(float(np.linalg.norm(np.subtract(first[n], last[n]))) > DISTURBED_M for n in names)

    @property
    def near(self) -> bool:
        """Whether a distractor starts close to the target."""
        assert self.task is not None
        assert self.scene is not None
        target = next(iter(self.task.objects.values())).entity  # the target, or what a longer task names first
        placed = {e.name: replace(self.scene.entity(e.name), pose=e.pose) for e in self.states[0].entities}
        distance = distance_to(placed[target], self.near_config, self.library)
        names = [thing.entity for thing in task_distractors(self.task)]
        return any(distance(placed[name]) <= self.near_config.distance_m for name in names)


class CellRunner:
    """Runs episodes of cells. Use it from the thread that created it; it lives until the process ends."""

    def __init__(self) -> None:
        """Make the cores."""
        self._folder = tempfile.TemporaryDirectory()
        self._library = ModelLibrary()
        self._cores = CoreGraph(Path(self._folder.name), renderer="tiny")
        self._sight = Visibility(self._cores.segmentation)
        self._world = World(self._library)

    def run(self, cell: str, config: str, index: int, *, replay: bool) -> Outcome:
        """Run the episode with the given index in a cell."""
        start = time.perf_counter()
        ports = self._cores.ports
        near = parse_task_config(config).at(index)[0].reset["distractors"].near or NearConfig()
        watch = _Watch(ports, self._library, self._sight, near)
        run = RunConfig(
            purpose="test", output_dir=self._folder.name, task_config=config, keep="none",
            noise_translation_m=NOISE_M, noise_rotation_rad=NOISE_RAD,
        )  # fmt: skip
        result = EpisodeRunner(replace(ports, scenes=watch, sim=watch), run).run_index(index)
        reset = self._cores.tasks.generator.last_reset
        succeeded = result.outcome == "success"
        return Outcome(
            cell=cell, index=index, first_try=succeeded and not result.recovered, recovered=result.recovered,
            reason="" if succeeded else f"{result.reason}: {result.message}".rstrip(": "), ticks=result.steps,
            reset_ms=1e3 * watch.reset_s, draws=reset.draws if reset else 0,
            rejections=dict(reset.rejections) if reset else {}, seen_share=watch.seen[0], seen_px=watch.seen[1],
            near=bool(watch.states) and watch.near, disturbed=watch.moved if watch.states else 0,
            replayed=self._replays(watch) if replay and succeeded else None,
            seconds=time.perf_counter() - start,
        )  # fmt: skip

    def _replays(self, watch: _Watch) -> bool:
        """Execute the recorded actions again in a fresh world."""
        assert watch.scene is not None
        assert watch.task is not None
        judge = CoreTasks(self._library)
        state = self._world.load(watch.scene, "replay")
        verdict = judge.start("replay", watch.task, state)
        for seq, (action, before) in enumerate(zip(watch.actions, watch.states[1:], strict=True), start=1):
            state = self._world.tick(seq, action, episode_id="replay")
            verdict = judge.judge(state)
            if state.state_hash != before.state_hash:
                return False
        return verdict.success


class ChunkWorker:
    """Runs several indices of a cell in each job; see `roboxim_runs.executors`."""

    def __init__(self, settings: None, number: int) -> None:
        """Make the cores."""
        self._runner = CellRunner()

    def run(self, job: Mapping[str, Any], note: Callable[[Any], None]) -> list[dict[str, Any]]:
        """Run a chunk, given ``cell``, ``config``, ``indices`` and ``replayed``, and report every episode."""
        outcomes = []
        for index in job["indices"]:
            outcomes.append(
                asdict(self._runner.run(job["cell"], job["config"], index, replay=index in job["replayed"]))
            )
            note(index)
        return outcomes

    def close(self) -> None:
        """Do nothing: the cores live until the process ends."""
