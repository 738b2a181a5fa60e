"""Push an open door shut.

Randomisation: the object's place, yaw and colour; how far the door is open; where the end effector starts; distractors.

Success: the door is open by less than ``shut_rad`` and still, and the robot does not touch the object, for ``hold_s``.

Non-obvious:
    - The closed fingers push the handle's bar and turn with the door, as `close_drawer` pushes a drawer.
    - The hand's heading nearest to the present one comes first: after a larger turn the arm begins near its limits, and
      the noise of a demonstration may then stop it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from roboxim_core.errors import ConfigError
from roboxim_core.poses import distance
from roboxim_core.specs import TaskSpec
from roboxim_core.state import StateRecord
from roboxim_tasks.components import Constraint, ResetContext
from roboxim_tasks.measures import Condition, Conditions, joint_position
from roboxim_tasks.motion import ExpertScene, Stage
from roboxim_tasks.reach import start_clear
from roboxim_tasks.sampling.generators import GenerationContext
from roboxim_tasks.skills.base import Evaluator, Role, Skill, parameters_of, register
from roboxim_tasks.skills.parts import (
    BEHIND_THE_MIDDLE,
    FINGER_M,
    STANDOFF_M,
    generate_part_task,
    handle_reachable,
    not_there_already,
    part_in,
    part_rests,
    pushed_shut,
    way_clear,
)


@dataclass(frozen=True, kw_only=True)
class CloseDoorParameters:
    """Thresholds of success."""

    shut_rad: float = 0.05
    """Largest opening that counts as shut [rad]."""
    hold_s: float = 0.3
    """Time that the door must stay shut [s]."""
    joint: str = ""
    """Name of the door's joint; set by the generator."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: When a threshold is out of range.
        """
        if not 0 < self.shut_rad <= 0.2 or self.hold_s < 0:
            raise ConfigError(f"needs 0 < shut_rad <= 0.2 and hold_s >= 0, got {self}")


@register
class CloseDoor(Skill):
    """Generator, resetter, executor and evaluator of ``close_door``."""

    name = "close_door"
    roles = {"target": Role(affordance="hinged", models=("microwave",))}
    templates = ("Close the {target}", "Close the door of the {target}", "Push the door of the {target} shut")
    components = ("robot", "objects", "joints", "distractors", "cameras", "lights")
    reset = {"objects": BEHIND_THE_MIDDLE, "joints": {"target": {"lower": 0.3, "upper": 0.6}}}
    rotations = 3
    max_steps = 150
    Parameters = CloseDoorParameters

    def generate(self, context: GenerationContext) -> TaskSpec:
        """Draw a task."""
        return generate_part_task(context)

    def constraints(self, context: ResetContext) -> Sequence[Constraint]:
        """Require a door that is not shut yet, that the arm can push, and no object in its path."""
        shut_rad = parameters_of(context.task, CloseDoorParameters).shut_rad
        return (
            not_there_already(context, "target", lambda position: position <= shut_rad),
            way_clear(context, "target"),
            handle_reachable(context, "target", lambda part: part.joint.lower, FINGER_M + STANDOFF_M),
            start_clear(context),
        )

    def stages(self, scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
        """Approach the front of the handle with closed fingers, push it around, withdraw; least rotation first."""
        entity = scene.task.objects["target"].entity
        part = part_in(scene, entity, scene.model_of(entity).handles[0])
        for grasp in sorted(part.grasps(), key=lambda grasp: round(distance(scene.pose_tcp, grasp)[1], 3)):
            yield pushed_shut(scene, entity, part, grasp)

    def evaluator(self, task: TaskSpec, initial: StateRecord) -> Evaluator:
        """Judge: shut, still, and let go."""
        parameters: CloseDoorParameters = parameters_of(task, CloseDoorParameters)
        position = joint_position(task.objects["target"].entity, parameters.joint, "door_rad")
        shut = Condition(name="shut", measure=position, most=parameters.shut_rad)
        return Conditions(part_rests(task, initial, shut, turns=True), hold_s=parameters.hold_s)
