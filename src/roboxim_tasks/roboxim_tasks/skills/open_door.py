"""Open a door by its handle.

Randomisation: the object's place, yaw and colour; where the end effector starts; distractors beside and in front of it.

Success: the door is open by more than ``open_rad`` and still, and the robot does not touch the object, for ``hold_s``.

Non-obvious:
    - The hand turns with the door.
    - The expert pulls 0.1 rad farther than required.
    - A scene with an object in the door's path is refused.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from roboxim_core.errors import ConfigError
from roboxim_core.models.description import ObjectModel
from roboxim_core.specs import TaskSpec
from roboxim_core.state import StateRecord
from roboxim_tasks.components import Constraint, ResetContext
from roboxim_tasks.measures import Condition, Conditions, above, joint_position
from roboxim_tasks.motion import ExpertScene, Stage
from roboxim_tasks.reach import start_clear
from roboxim_tasks.sampling.generators import GenerationContext
from roboxim_tasks.skills.base import Evaluator, Role, Skill, parameters_of, register
from roboxim_tasks.skills.parts import (
    BEHIND_THE_MIDDLE,
    beyond_travel,
    generate_part_task,
    handle_reachable,
    not_there_already,
    operated,
    part_in,
    part_rests,
    way_clear,
)

OVERSHOOT_RAD = 0.1


@dataclass(frozen=True, kw_only=True)
class OpenDoorParameters:
    """Thresholds of success."""

    open_rad: float = 0.7
    """Opening that the door must exceed [rad]."""
    hold_s: float = 0.3
    """Time that the door must stay open [s]."""
    joint: str = ""
    """Name of the door's joint; set by the generator."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: When a threshold is out of range.
        """
        if self.open_rad <= 0 or self.hold_s < 0:
            raise ConfigError(f"needs open_rad > 0 and hold_s >= 0, got {self}")


@register
class OpenDoor(Skill):
    """Generator, resetter, executor and evaluator of ``open_door``."""

    name = "open_door"
    roles = {"target": Role(affordance="hinged", models=("microwave",))}
    templates = ("Open the {target}", "Open the door of the {target}", "Pull the door of the {target} open")
    components = ("robot", "objects", "joints", "distractors", "cameras", "lights")
    reset = {"objects": BEHIND_THE_MIDDLE}
    rotations = 3
    max_steps = 150
    Parameters = OpenDoorParameters

    def mismatch(self, parameters: Any, models: Mapping[str, ObjectModel]) -> str:
        """Return that the door does not open so far; else an empty text."""
        return beyond_travel(models["target"], models["target"].handles[0].joint, "open_rad", parameters.open_rad)

    def generate(self, context: GenerationContext) -> TaskSpec:
        """Draw a task."""
        return generate_part_task(context)

    def constraints(self, context: ResetContext) -> Sequence[Constraint]:
        """Require a door that is not open yet, that the arm can pull, and an empty path."""
        open_rad = parameters_of(context.task, OpenDoorParameters).open_rad
        goal = open_rad + OVERSHOOT_RAD
        return (
            not_there_already(context, "target", lambda position: position > open_rad),
            way_clear(context, "target", goal),
            handle_reachable(context, "target", lambda _: goal),
            start_clear(context),
        )

    def stages(self, scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
        """Grasp the handle, pull it around, let go, withdraw."""
        parameters: OpenDoorParameters = parameters_of(scene.task, OpenDoorParameters)
        entity = scene.task.objects["target"].entity
        part = part_in(scene, entity, scene.model_of(entity).handles[0])
        goal = min(parameters.open_rad + OVERSHOOT_RAD, part.joint.upper)
        for grasp in part.grasps():
            yield operated(scene, entity, part, grasp, goal)

    def evaluator(self, task: TaskSpec, initial: StateRecord) -> Evaluator:
        """Judge: open far enough, still, and let go."""
        parameters: OpenDoorParameters = parameters_of(task, OpenDoorParameters)
        position = joint_position(task.objects["target"].entity, parameters.joint, "door_rad")
        opened = Condition(name="opened", measure=position, least=above(parameters.open_rad))
        return Conditions(part_rests(task, initial, opened, turns=True), hold_s=parameters.hold_s)
