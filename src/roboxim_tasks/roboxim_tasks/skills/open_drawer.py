"""Open a drawer by its handle.

Randomisation: the cabinet's place, yaw and colour; where the end effector starts; distractors beside and
in front of it.

Success: the drawer is open by more than ``open_m`` and still, the other drawers have moved by less than 2 cm, and the
robot does not touch the cabinet, for ``hold_s``.

Non-obvious:
    - The hand approaches at 62 degrees: a steeper hand would hit the handle above, a flatter one needs joint 6 beyond
      its limit.
    - The expert pulls 2 cm farther than required.
    - A scene with an object in the drawer's path is refused.
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
    handle_of,
    handle_reachable,
    not_there_already,
    operated,
    part_in,
    part_rests,
    way_clear,
)

OVERSHOOT_M = 0.02


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
class OpenDrawer(Skill):
    """Generator, resetter, executor and evaluator of ``open_drawer``."""

    name = "open_drawer"
    roles = {"target": Role(affordance="openable", models=("cabinet",))}
    words = ("drawer",)
    templates = (
        "Open the {drawer} drawer",
        "Pull the {drawer} drawer open",
        "Open the {drawer} drawer of the {target}",
    )
    components = ("robot", "objects", "joints", "distractors", "cameras", "lights")
    reset = {"objects": BEHIND_THE_MIDDLE}
    rotations = 3
    max_steps = 150
    Parameters = OpenDrawerParameters

    def check(self, parameters: Any, models: Mapping[str, Sequence[ObjectModel]]) -> None:
        """Refuse a drawer that one of the models lacks."""
        for model in models["target"]:
            handle_of(model, parameters.drawer)

    def mismatch(self, parameters: Any, models: Mapping[str, ObjectModel]) -> str:
        """Return that the drawer does not open so far; else an empty text."""
        joint = handle_of(models["target"], parameters.drawer).joint
        return beyond_travel(models["target"], joint, "open_m", parameters.open_m)

    def generate(self, context: GenerationContext) -> TaskSpec:
        """Draw a task."""
        return generate_part_task(context, "drawer", {"drawer": context.parameters.drawer})

    def constraints(self, context: ResetContext) -> Sequence[Constraint]:
        """Require a drawer that is not open yet, that the arm can pull, and an empty path."""
        open_m = parameters_of(context.task, OpenDrawerParameters).open_m
        goal_m = open_m + OVERSHOOT_M
        return (
            not_there_already(context, "target", lambda position_m: position_m > open_m),
            way_clear(context, "target", goal_m),
            handle_reachable(context, "target", lambda _: goal_m),
            start_clear(context),
        )

    def stages(self, scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
        """Grasp the handle, pull, let go, withdraw."""
        parameters: OpenDrawerParameters = parameters_of(scene.task, OpenDrawerParameters)
        cabinet = scene.task.objects["target"].entity
        part = part_in(scene, cabinet, handle_of(scene.model_of(cabinet), parameters.drawer))
        goal_m = min(parameters.open_m + OVERSHOOT_M, part.joint.upper)
        for grasp in part.grasps():
            yield operated(scene, cabinet, part, grasp, goal_m)

    def evaluator(self, task: TaskSpec, initial: StateRecord) -> Evaluator:
        """Judge: open far enough, still, let go, and no other drawer moved."""
        parameters: OpenDrawerParameters = parameters_of(task, OpenDrawerParameters)
        position = joint_position(task.objects["target"].entity, parameters.joint, "drawer_m")
        opened = Condition(name="opened", measure=position, least=above(parameters.open_m))
        return Conditions(part_rests(task, initial, opened), hold_s=parameters.hold_s)
