"""What if: executes a recorded episode again up to a tick, then continues with another actor or one change."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from roboxim_core.actions import ActionArray, ActionSemantics
from roboxim_core.episode import ActorPort, Draw, RunConfig
from roboxim_core.errors import ConfigError, ErrorCode, SimError, one_of
from roboxim_core.policies import ActionChunk, EpisodeStart, Observation, ObservationWindow, PolicyDescription
from roboxim_core.poses import Pose
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_core.state import StateRecord
from roboxim_runs.answers.trying import executed_actions
from roboxim_studio.acting.take import OnTick, take
from roboxim_studio.episode.film import Film
from roboxim_tasks.roles import task_distractors

if TYPE_CHECKING:
    from roboxim_bringup.core_graph import CoreGraph

RECORDED = "recorded actions"
EXPERT = "expert"
ACTORS = (RECORDED, EXPERT)
"""Who may continue; policies by name besides."""
MORE_STEPS = 200
"""Largest number of actions after the tick."""


@dataclass(frozen=True, kw_only=True)
class Question:
    """What to try."""

    tick: int
    """Tick up to which everything is as recorded."""
    actor: str = EXPERT
    """Who acts from there: ``recorded actions``, ``expert``, or a policy by name."""
    moved: str = ""
    """Entity that is moved at the tick; empty: none."""
    by_m: tuple[float, float] = (0.0, 0.0)
    """By how much it is moved, along x and y of the world [m]."""
    without: str = ""
    """Distractor that is left out from the start; empty: none."""

    @property
    def words(self) -> str:
        """The question in words; different ones for different questions."""
        moved = f", {self.moved} moved by {self.by_m[0]:g} {self.by_m[1]:g} m" if self.moved else ""
        return f"{self.actor} from tick {self.tick}{moved}{f', without {self.without}' if self.without else ''}"


def first_difference(one: Film, other: Film) -> int | None:
    """Return the first tick whose states differ, or that one of them lacks; None: all are the same, bit for bit."""
    pairs = itertools.zip_longest(one.states, other.states)
    return next((n for n, (a, b) in enumerate(pairs) if a is None or b is None or a.state_hash != b.state_hash), None)


def simulate(
    graph: CoreGraph, film: Film, question: Question, actor: ActorPort | None = None, *,
    on_tick: OnTick = lambda *_: None, cancelled: Callable[[], bool] = lambda: False,
) -> Film:  # fmt: skip
    """Execute an episode again up to a tick, continue as the question demands, and return the other episode.

    Args:
        graph: The cores; of this thread.
        film: The episode.
        question: What to try.
        actor: Who acts from the tick on; none: the recorded actions.
        on_tick: Called with every tick.
        cancelled: Called before every tick; True ends the episode.

    Raises:
        ConfigError: On a tick, an entity or an actor that the episode does not allow; the message lists the allowed.
        SimError: With code ``DIVERGED`` when the simulator does not repeat the recording up to the tick.
        RoboximError: On a fault of the simulator, or on cancellation.
    """
    task, scene = _checked(film, question, actor)
    same = not question.without
    repeat = executed_actions(film.states, film.result.steps if actor is None else question.tick)
    sim = Disturbing(graph.sim, film, question, require_same=same)
    info = film.info
    seed = SeedPath(run_seed=info.run_seed, purpose=info.purpose, index=info.index, attempt=info.attempt)
    max_ticks = film.result.steps if actor is None else question.tick + MORE_STEPS
    draw = Draw(task=task, scene=scene, max_steps=max_ticks)
    config = RunConfig(
        run_seed=info.run_seed, purpose=info.purpose, max_steps=max_ticks, rate_hz=scene.control_rate_hz,
        stop_on_success=actor is not None,
    )  # fmt: skip
    other = take(
        graph, draw, actor or _Recorded(film), seed, config=config, sim=sim, on_tick=on_tick, cancelled=cancelled,
        repeat=repeat,
    )  # fmt: skip
    return replace(other, title=f"{info.episode_id}: {question.words}")


def _checked(film: Film, question: Question, actor: ActorPort | None) -> tuple[TaskSpec, SceneSpec]:
    """Return the task and the scene to execute in; refuse a question that makes no sense."""
    task, scene = film.info.task, film.info.scene
    if not 0 <= question.tick < len(film):
        raise ConfigError(f"tick must be 0..{len(film) - 1}, got {question.tick}")
    names = [entity.name for entity in scene.entities]
    if question.moved and question.moved not in names:
        raise ConfigError(f"no entity '{question.moved}' in the scene; {one_of(names, question.moved)}")
    if question.without:
        distractors = [thing.entity for thing in task_distractors(film.info.task)]
        if question.without not in distractors:
            raise ConfigError(
                f"only a distractor can be left out, not '{question.without}'; {one_of(distractors, question.without)}"
            )
        kept = tuple(entity for entity in scene.entities if entity.name != question.without)
        scene = replace(scene, entities=kept)
        objects = {role: thing for role, thing in task.objects.items() if thing.entity != question.without}
        task = replace(task, objects=objects)
    if actor is not None:
        declared = actor.describe().semantics
        executed = declared.executed(scene.control_rate_hz)
        recorded = film.info.semantics.executed(scene.control_rate_hz)
        if executed != recorded:
            raise ConfigError(
                f"'{question.actor}' acts by {executed.control}, the episode was recorded by {recorded.control}; "
                "choose an actor of the same control mode"
            )
    return task, scene


class _Recorded:
    """Who acted in an episode that is repeated to its last action."""

    def __init__(self, film: Film) -> None:
        self._info = film.info

    def describe(self) -> PolicyDescription:
        """Return the description of the recorded actions."""
        name, info = RECORDED.replace(" ", "_"), self._info
        return PolicyDescription(name=name, semantics=info.semantics, version=info.actor_version)

    def reset(self, start: EpisodeStart) -> None:
        """Start an episode."""

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Never called: the loop repeats the actions."""
        raise AssertionError("every action is recorded")


class Disturbing:
    """The simulator's port; moves an entity at a tick, and makes sure that everything before is as recorded."""

    def __init__(self, sim: Any, film: Film, question: Question, *, require_same: bool) -> None:
        """Watch a simulator.

        Args:
            sim: Its port.
            film: The recording.
            question: What happens at which tick.
            require_same: Whether the states up to the tick must be the recorded ones.
        """
        self._sim, self._film, self._question, self._same = sim, film, question, require_same

    def __getattr__(self, name: str) -> Any:
        """Return what the simulator has."""
        return getattr(self._sim, name)

    @property
    def renderer(self) -> str:
        """Renderer and device."""
        return str(self._sim.renderer)

    def load(self, episode_id: str, scene: SceneSpec, semantics: ActionSemantics) -> StateRecord:
        """Build the scene."""
        return self._checked(self._sim.load(episode_id, scene, semantics))

    def tick(self, episode_id: str, seq: int, action: ActionArray) -> StateRecord:
        """Execute an action; first move the entity, if it is time."""
        question = self._question
        if question.moved and seq == question.tick + 1:
            pose = self._sim.world.record.entity(question.moved).pose
            x, y, z = pose.position
            place = (x + question.by_m[0], y + question.by_m[1], z)
            self._sim.world.set_entity_state(question.moved, Pose(position=place, quat_xyzw=pose.quat_xyzw))
        return self._checked(self._sim.tick(episode_id, seq, action))

    def observe(self, state: StateRecord, cameras: tuple[str, ...]) -> Observation:
        """Return a tick's observation."""
        observation: Observation = self._sim.observe(state, cameras)
        return observation

    def release(self, episode_id: str) -> None:
        """Give the lease back."""
        self._sim.release(episode_id)

    def _checked(self, state: StateRecord) -> StateRecord:
        if self._same and state.seq <= self._question.tick:
            recorded = self._film.states[state.seq]
            if recorded.state_hash != state.state_hash:
                raise SimError(
                    f"the simulator does not repeat the recording: tick {state.seq} differs (recorded "
                    f"{recorded.state_hash}, now {state.state_hash}); models or versions have changed since",
                    ErrorCode.DIVERGED,
                )
        return state
