"""Turn a knob clockwise or counter-clockwise (seen from above).

Randomisation: the box's place, yaw and colour; where its knob stands; where the end effector starts; distractors, other
knobs among them.

Success: the knob has turned by more than ``turn_rad`` in the direction from where it stood, turned by fingers of the
robot alone, and the robot does not touch it, for ``hold_s``. As in every task, joints of other objects have to stay.

Non-obvious: the way of the knob counts only in ticks in which nothing but fingers touches the box.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from roboxim_core.errors import ConfigError, one_of
from roboxim_core.models.description import ObjectModel
from roboxim_core.specs import TaskSpec
from roboxim_core.state import StateRecord
from roboxim_tasks.components import Constraint, ResetContext
from roboxim_tasks.measures import Conditions
from roboxim_tasks.motion import ExpertScene, Stage
from roboxim_tasks.reach import start_clear
from roboxim_tasks.sampling.generators import GenerationContext
from roboxim_tasks.skills.base import Evaluator, Role, Skill, parameters_of, register
from roboxim_tasks.skills.parts import (
    Part,
    beyond_travel,
    far_enough,
    generate_part_task,
    handle_reachable,
    operated,
    part_in,
    turned_by_fingers,
)
from roboxim_tasks.skills.rotate import DIRECTIONS

OVERSHOOT_RAD = 0.15


@dataclass(frozen=True, kw_only=True)
class TurnKnobParameters:
    """Direction, and thresholds of success."""

    direction: str = "clockwise"
    """``clockwise`` or ``counter-clockwise``, seen from above."""
    turn_rad: float = 0.8
    """Turn that the knob must exceed [rad]."""
    hold_s: float = 0.3
    """Time that the knob must stay turned [s]."""
    joint: str = ""
    """Name of the knob's joint; set by the generator."""
    fingers: str = ""
    """Names of the robot's finger links, separated by blanks; set by the generator."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: When the direction is unknown or a threshold is out of range.
        """
        if self.direction not in DIRECTIONS:
            raise ConfigError(f"unknown direction '{self.direction}'; {one_of(DIRECTIONS, self.direction)}")
        if self.turn_rad <= 0 or self.hold_s < 0:
            raise ConfigError(f"needs turn_rad > 0 and hold_s >= 0, got {self}")

    def left(self, part: Part) -> float:
        """Return how far a knob can turn in the direction [rad]."""
        return part.joint.upper - part.position if DIRECTIONS[self.direction] > 0 else part.position - part.joint.lower

    def goal(self, part: Part) -> float:
        """Return the position to which the expert turns a knob [rad]."""
        goal = part.position + DIRECTIONS[self.direction] * (self.turn_rad + OVERSHOOT_RAD)
        return min(max(goal, part.joint.lower), part.joint.upper)


@register
class TurnKnob(Skill):
    """Generator, resetter, executor and evaluator of ``turn_knob``."""

    name = "turn_knob"
    roles = {"target": Role(affordance="turnable", models=("knob",))}
    words = ("direction",)
    templates = ("Turn the {target} {direction}", "Turn {direction} the {target}", "Twist the {target} {direction}")
    components = ("robot", "objects", "joints", "distractors", "cameras", "lights")
    reset = {"joints": {"target": {"lower": 0.4, "upper": 0.6}}}
    rotations = 3
    max_steps = 120
    Parameters = TurnKnobParameters

    def mismatch(self, parameters: Any, models: Mapping[str, ObjectModel]) -> str:
        """Return that the knob does not turn so far; else an empty text."""
        return beyond_travel(models["target"], models["target"].handles[0].joint, "turn_rad", parameters.turn_rad)

    def generate(self, context: GenerationContext) -> TaskSpec:
        """Draw a task."""
        return generate_part_task(context, words={"direction": context.parameters.direction}, fingers=True)

    def constraints(self, context: ResetContext) -> Sequence[Constraint]:
        """Require that the knob can turn so far, and that the arm can grasp and turn it."""
        parameters: TurnKnobParameters = parameters_of(context.task, TurnKnobParameters)
        return (
            far_enough(context, "target", parameters.left, parameters.turn_rad),
            handle_reachable(context, "target", parameters.goal),
            start_clear(context),
        )

    def stages(self, scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
        """Grasp the knob, turn it, let go, withdraw."""
        parameters: TurnKnobParameters = parameters_of(scene.task, TurnKnobParameters)
        entity = scene.task.objects["target"].entity
        part = part_in(scene, entity, scene.model_of(entity).handles[0])
        for grasp in part.grasps():
            yield operated(scene, entity, part, grasp, parameters.goal(part))

    def evaluator(self, task: TaskSpec, initial: StateRecord) -> Evaluator:
        """Judge: turned by fingers, and let go."""
        parameters: TurnKnobParameters = parameters_of(task, TurnKnobParameters)
        sign = DIRECTIONS[parameters.direction]
        turned = turned_by_fingers(task, initial, "turned", parameters.turn_rad, sign)
        return Conditions(turned, hold_s=parameters.hold_s)
