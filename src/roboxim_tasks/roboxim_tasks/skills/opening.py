"""Open a drawer or a door by its handle: ``open_drawer``, ``open_door``.

Randomisation: the object's place, yaw and colour; where the end effector starts; distractors beside and in front of it.

Success: the part is open by more than ``open_m`` or ``open_rad`` and still, the object's other parts have moved by less
than 2 cm, and the robot does not touch the object, for ``hold_s``.

Non-obvious:
    - The hand approaches a drawer at 62 degrees: a steeper hand would hit the handle above, a flatter one needs joint 6
      beyond its limit. It turns with a door.
    - The expert pulls 2 cm or 0.1 rad farther than required.
    - A scene with an object in the part's path is refused.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from roboxim_core.errors import ConfigError
from roboxim_core.models.description import Handle, ObjectModel
from roboxim_core.specs import TaskSpec
from roboxim_core.state import StateRecord
from roboxim_tasks.components import Constraint, ResetContext
from roboxim_tasks.measures import Condition, Conditions, Measure, above, joint_position
from roboxim_tasks.motion import ExpertScene, Stage
from roboxim_tasks.reach import start_clear
from roboxim_tasks.sampling.generators import GenerationContext
from roboxim_tasks.skills.base import Evaluator, Role, Skill, parameters_of, register
from roboxim_tasks.skills.parts import (
    BEHIND_THE_MIDDLE,
    beyond_travel,
    generate_part_task,
    handle_of,
    handle_reachable,
    not_there_already,
    operated,
    part_in,
    part_rests,
    way_clear,
)


class PartSkill(Skill):
    """A skill about a part of the target: the drawer that the parameter ``drawer`` names, or its only door."""

    components = ("robot", "objects", "joints", "distractors", "cameras", "lights")
    reset = {"objects": BEHIND_THE_MIDDLE}
    rotations = 3
    max_steps = 150
    limit: ClassVar[str]
    """Parameter with the opening that separates success from failure."""
    opening: ClassVar[str]
    """Name of the measured opening."""

    def handle(self, model: ObjectModel, parameters: Any) -> Handle:
        """Return the handle of the part."""
        return handle_of(model, parameters.drawer) if "drawer" in self.words else model.handles[0]

    def check(self, parameters: Any, models: Mapping[str, Sequence[ObjectModel]]) -> None:
        """Refuse a drawer that one of the models lacks."""
        for model in models["target"] if "drawer" in self.words else ():
            self.handle(model, parameters)

    def generate(self, context: GenerationContext) -> TaskSpec:
        """Draw a task."""
        words = {word: getattr(context.parameters, word) for word in self.words}
        return generate_part_task(context, "".join(self.words), words)

    @abstractmethod
    def goal(self, opening: Measure, limit: float) -> Condition:
        """Return the condition on the part's opening."""

    def evaluator(self, task: TaskSpec, initial: StateRecord) -> Evaluator:
        """Judge: open or shut, still, let go, and no other part moved."""
        parameters = parameters_of(task, self.Parameters)
        opening = joint_position(task.objects["target"].entity, parameters.joint, self.opening)
        goal = self.goal(opening, getattr(parameters, self.limit))
        turns = self.limit.endswith("_rad")
        return Conditions(part_rests(task, initial, goal, turns=turns), hold_s=parameters.hold_s)


class OpeningSkill(PartSkill):
    """A skill that opens a part."""

    overshoot: ClassVar[float]
    """Way that the expert pulls farther than required [m or rad]."""

    def mismatch(self, parameters: Any, models: Mapping[str, ObjectModel]) -> str:
        """Return that the part does not open so far; else an empty text."""
        joint = self.handle(models["target"], parameters).joint
        return beyond_travel(models["target"], joint, self.limit, getattr(parameters, self.limit))

    def constraints(self, context: ResetContext) -> Sequence[Constraint]:
        """Require a part that is not open yet, that the arm can pull, and an empty path."""
        limit = getattr(parameters_of(context.task, self.Parameters), self.limit)
        goal = limit + self.overshoot
        return (
            not_there_already(context, "target", lambda position: position > limit),
            way_clear(context, "target", goal),
            handle_reachable(context, "target", lambda _: goal),
            start_clear(context),
        )

    def stages(self, scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
        """Grasp the handle, pull, let go, withdraw."""
        parameters, entity = parameters_of(scene.task, self.Parameters), scene.task.objects["target"].entity
        part = part_in(scene, entity, self.handle(scene.model_of(entity), parameters))
        goal = min(getattr(parameters, self.limit) + self.overshoot, part.joint.upper)
        for grasp in part.grasps():
            yield operated(scene, entity, part, grasp, goal)

    def goal(self, opening: Measure, limit: float) -> Condition:
        """Require more than the parameter."""
        return Condition(name="opened", measure=opening, least=above(limit))


@dataclass(frozen=True, kw_only=True)
class OpenDrawerParameters:
    """Drawer to open, and thresholds of success."""

    drawer: str = "top"
    """Name of the drawer, which is the name of its handle."""
    open_m: float = 0.10
    """Opening that the drawer must exceed [m]."""
    hold_s: float = 0.3
    """Time that the drawer must stay open [s]."""
    joint: str = ""
    """Name of the drawer's joint; set by the generator."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: When a threshold is out of range.
        """
        if self.open_m <= 0 or self.hold_s < 0:
            raise ConfigError(f"needs open_m > 0 and hold_s >= 0, got {self}")


@register
class OpenDrawer(OpeningSkill):
    """Generator, resetter, executor and evaluator of ``open_drawer``."""

    name = "open_drawer"
    roles = {"target": Role(affordance="openable", models=("cabinet",))}
    words = ("drawer",)
    templates = (
        "Open the {drawer} drawer",
        "Pull the {drawer} drawer open",
        "Open the {drawer} drawer of the {target}",
    )
    Parameters = OpenDrawerParameters
    limit = "open_m"
    opening = "drawer_m"
    overshoot = 0.02


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
class OpenDoor(OpeningSkill):
    """Generator, resetter, executor and evaluator of ``open_door``."""

    name = "open_door"
    roles = {"target": Role(affordance="hinged", models=("microwave",))}
    templates = ("Open the {target}", "Open the door of the {target}", "Pull the door of the {target} open")
    Parameters = OpenDoorParameters
    limit = "open_rad"
    opening = "door_rad"
    overshoot = 0.1
