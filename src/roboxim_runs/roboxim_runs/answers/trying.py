"""Runs single episodes from given tasks and scenes in this process, without bags."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from roboxim_core.config import from_plain
from roboxim_core.episode import (
    ActorPort,
    Draw,
    EpisodeInfo,
    EpisodeResult,
    EpisodeRunner,
    EpisodeStep,
    Ports,
    RecorderPort,
    RunConfig,
    SimPort,
)
from roboxim_core.errors import ConfigError, PolicyError
from roboxim_core.seeds import SeedPath
from roboxim_core.state import StateRecord

if TYPE_CHECKING:
    from roboxim_bringup.core_graph import CoreGraph, CoreSim  # a second to import: when it is needed
    from roboxim_runs.policies.specs import ChosenPolicy

IN_MEMORY = "/"
"""Output folder of a run that is kept in memory: the loop records only if it has one."""


class GivenScene:
    """The scene port of an episode whose task and scene are given."""

    def __init__(self, draw: Draw) -> None:
        """Give a draw."""
        self._draw = draw

    def draw(self, seed: SeedPath, task_config: str) -> Draw:
        """Return the draw, regardless of the seed."""
        return self._draw


class StateKeeper:
    """A recorder that keeps the states of an episode."""

    def __init__(self, sim: CoreSim) -> None:
        """Keep the states of a sim."""
        self._sim = sim
        self.states: list[StateRecord] = []
        """State of every tick."""
        self.info: EpisodeInfo | None = None
        """The episode; none: it did not begin."""

    def open(self, info: EpisodeInfo) -> None:
        """Begin an episode."""
        self.info, self.states = info, []

    def step(self, step: EpisodeStep) -> None:
        """Keep a tick."""
        self.states.append(self._sim.world.record)

    def wait_written(self) -> None:
        """Return at once: nothing is written."""

    def close(self, result: EpisodeResult, keep: str, received: Sequence[str] = ()) -> str:
        """End an episode; there is no bag."""
        return ""

    def abort(self) -> None:
        """End an episode."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Try:
    """An episode that was run."""

    result: EpisodeResult
    """How it ended."""
    states: tuple[StateRecord, ...]
    """State of every tick, those of settling included; empty if it was recorded."""
    info: EpisodeInfo | None
    """What defines it; none: it did not begin, or was recorded."""

    @property
    def success(self) -> bool:
        """Whether it succeeded."""
        return self.result.outcome == "success"

    @property
    def began(self) -> bool:
        """Whether it began: a scene that breaks a constraint does not."""
        return self.result.reason != "reset_infeasible"


def episode_loop(
    graph: CoreGraph, draw: Draw, actor: ActorPort, recorder: RecorderPort, *, config: RunConfig,
    sim: SimPort | None = None, **options: Any,
) -> EpisodeRunner:  # fmt: skip
    """Return the loop of an episode of a given task and scene.

    Args:
        graph: The cores; of this thread.
        draw: Task and scene.
        actor: Who acts.
        recorder: Keeps the episode.
        config: Configuration of the run; without an output folder, `IN_MEMORY` takes its place.
        sim: The simulator's port; none: the graph's.
        **options: Further arguments of `EpisodeRunner`.
    """
    ports = Ports(
        scenes=GivenScene(draw), sim=sim or graph.sim, actor=actor, judge=graph.tasks, recorder=recorder,
        clock=time.monotonic,
    )  # fmt: skip
    return EpisodeRunner(ports, replace(config, output_dir=config.output_dir or IN_MEMORY), **options)


class TryBench:
    """Cores to run episodes with. A context manager; belongs to the thread that made it."""

    def __init__(self) -> None:
        """Make the cores."""
        from roboxim_bringup.core_graph import CoreGraph

        self._folder = tempfile.TemporaryDirectory(prefix="roboxim-tries-", ignore_cleanup_errors=True)
        self.graph: CoreGraph = CoreGraph(Path(self._folder.name))
        self.runs = 0
        """Number of episodes so far."""

    def __enter__(self) -> TryBench:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Free everything."""
        self.graph.__exit__()
        self._folder.cleanup()

    @property
    def expert(self) -> ActorPort:
        """The expert."""
        return self.graph.ports.actor

    def actor(self, chosen: ChosenPolicy) -> ActorPort:
        """Make a policy.

        Raises:
            PolicyError: When it cannot be made.
        """
        from roboxim_bringup.core_graph import CoreActor

        make: Any = chosen.make
        return self.expert if make is None else CoreActor(make(**chosen.options))

    def run(
        self, draw: Draw, actor: ActorPort, seed: SeedPath, *, config: RunConfig | None = None,
        sim: SimPort | None = None, bags: Path | None = None, repeat: Sequence[Sequence[float]] = (),
    ) -> Try:  # fmt: skip
        """Run an episode to its end.

        Args:
            draw: Task and scene.
            actor: Who acts.
            seed: Names the episode, and seeds the actor.
            config: Configuration of the run; none: the default.
            sim: The simulator's port; none: the graph's.
            bags: Folder for a bag of it; none: there is none.
            repeat: Executed actions to begin with; see `executed_actions`.

        Raises:
            PolicyError: When the actor raises, or answers what cannot be executed: that is no failure at the task.
            RoboximError: On a fault of the simulator.
        """
        from roboxim_bringup.core_graph import CoreRecorder

        recorder_of_states = StateKeeper(self.graph.sim)
        recorder = recorder_of_states if bags is None else CoreRecorder(self.graph.sim, bags.absolute())
        given = replace(config or RunConfig(), output_dir=IN_MEMORY)
        runner = episode_loop(self.graph, draw, actor, recorder, config=given, sim=sim, repeat=repeat)
        self.runs += 1
        result = runner.run_attempt(seed)
        tried = Try(result=result, states=tuple(recorder_of_states.states), info=recorder_of_states.info)
        if result.outcome == "error" and tried.began:
            raise PolicyError(
                f"episode {result.episode_id} ended in an error of its policy ({result.reason}), which is no failure "
                f"at the task: {result.message}; mend the policy and run the command again"
            )
        return tried


def executed_actions(states: Sequence[StateRecord], tick: int) -> list[tuple[float, ...]]:
    """Return the actions that led to a tick, in the executed meaning.

    Args:
        states: States of an episode from tick 0, each with the action that led to it.
        tick: The tick.
    """
    return [state.action_executed for state in states[1 : tick + 1]]


def seed_of(info: EpisodeInfo) -> SeedPath:
    """Return the seed path of a recorded episode."""
    return SeedPath(run_seed=info.run_seed, purpose=info.purpose, index=info.index, attempt=info.attempt)


def recorded_run(info: EpisodeInfo) -> tuple[RunConfig, Draw]:
    """Return how a recorded episode was run, and its draw.

    Raises:
        ConfigError: When the bag does not say it, as bags of other programs do.
    """
    try:
        data = json.loads(info.config_json)
        config: RunConfig = from_plain(data["run"], RunConfig, source=f"the run of {info.episode_id}")
        limit = int(data["task"]["max_steps"])
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"the bag of {info.episode_id} does not say how it was run ({error!r})") from None
    config = replace(config, rate_hz=info.scene.control_rate_hz, max_steps=config.max_steps or limit, keep="all")
    task = json.dumps(data["task"])
    return config, Draw(task=info.task, scene=info.scene, max_steps=config.max_steps, config_json=task)
