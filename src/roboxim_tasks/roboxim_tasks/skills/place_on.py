"""Place an object on another: a plate, a tray, a block.

Randomisation: which objects and colours; where both lie and at what yaw; where the end effector starts; distractors.

Success: the object touches the support and not the table, its origin is within ``within_m`` of the surface's middle,
the robot does not touch it, and it lies still for ``hold_s``.

Non-obvious: ``within_m`` follows from the support's surface unless it is given; the generator puts it into the task's
arguments, so that a bag is judged without the models. An object longer than the surface is let go above the support's
highest point, because a rim may be in its way.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from roboxim_core.errors import ConfigError
from roboxim_core.models.description import ObjectModel
from roboxim_core.specs import TaskSpec
from roboxim_core.state import StateRecord
from roboxim_tasks.components import Constraint, ResetContext
from roboxim_tasks.generators import GenerationContext, generate_task
from roboxim_tasks.motion import ExpertScene, Stage
from roboxim_tasks.predicates import Condition, Conditions, above, force, horizontal_distance, table_force
from roboxim_tasks.reach import above_reachable, graspable, start_clear
from roboxim_tasks.skills.base import Evaluator, Role, Skill, parameters_of, register
from roboxim_tasks.skills.placing import GOAL_YAWS, fits, lies_still, put, raised, region_of, region_pose, upright

LONGEST = 2.4
"""Longest side of an object that makes sense on a support, over the longest side of its surface or of its rim."""


@dataclass(frozen=True, kw_only=True)
class PlaceOnParameters:
    """Thresholds of success."""

    within_m: float = 0.0
    """Largest distance from the middle of the surface [m]; 0: half of the surface's shorter side."""
    hold_s: float = 0.3
    """How long it must lie still [s]."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: When a threshold makes no sense.
        """
        if self.within_m < 0 or self.hold_s < 0:
            raise ConfigError(f"needs within_m >= 0 and hold_s >= 0, got {self}")


@register
class PlaceOn(Skill):
    """Generator, resetter, executor and evaluator of ``place_on``."""

    name = "place_on"
    roles = {"support": Role(affordance="support", models=("plate",)), "target": Role(affordance="graspable")}
    templates = (
        "Place the {target} on the {support}",
        "Put the {target} on the {support}",
        "Set the {target} down on the {support}",
    )
    max_steps = 200
    Parameters = PlaceOnParameters

    def mismatch(self, parameters: Any, models: Mapping[str, ObjectModel]) -> str:
        """Tell of a target that is so long that it tips off the support, or off its rim."""
        target, support = models["target"], models["support"]
        room_m = max(max(region.size[:2]) for region in support.regions if region.kind in ("surface", "interior"))
        if max(target.size[:2]) > LONGEST * room_m:
            return f"the {target.name} is too long to lie on the {support.name}"
        return ""

    def generate(self, context: GenerationContext) -> TaskSpec:
        """Draw a task and the bound on the distance that follows from its support."""
        task = generate_task(context)
        support = task.objects["support"]
        surface = region_of(context.library.object(support.model, support.modifiers), "surface")
        within_m = task.arguments["within_m"] or min(surface.size[:2]) / 2
        return replace(task, arguments=task.arguments | {"within_m": within_m})

    def constraints(self, context: ResetContext) -> Sequence[Constraint]:
        """The arm reaches the target, and a target's grasp above the support."""
        return (graspable(context, "target"), above_reachable(context, "support"), start_clear(context))

    def stages(self, scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
        """Pick it up, put it in the middle of the surface; the yaw that it has first."""
        target, support = (scene.task.objects[role].entity for role in ("target", "support"))
        model, base = scene.model_of(target), scene.model_of(support)
        surface = region_of(base, "surface")
        middle = region_pose(scene, support, surface)
        height = middle.position[2]
        if not fits(model, surface):
            height = max(height, scene.pose_of(support).position[2] + base.size[2] - base.rest_height)
        position = raised(middle, height + model.rest_height).position
        goals = [upright(scene.pose_of(target), position, yaw) for yaw in GOAL_YAWS]
        return put(scene, target, goals, onto=support)

    def evaluator(self, task: TaskSpec, initial: StateRecord) -> Evaluator:
        """On the support, near its middle, let go and at rest."""
        parameters: PlaceOnParameters = parameters_of(task, PlaceOnParameters)
        return Conditions(placed_on(task, initial, parameters.within_m), hold_s=parameters.hold_s)


def placed_on(task: TaskSpec, initial: StateRecord, within_m: float) -> tuple[Condition, ...]:
    """Return the conditions that a task's target lies on its support."""
    target, support = (task.objects[role].entity for role in ("target", "support"))
    placed = (
        Condition(name="on_support", measure=force(target, support, "support_force_n"), least=above(0.0)),
        Condition(name="off_table", measure=table_force(target), most=0.0, reason="touches_table"),
        Condition(name="centred", measure=horizontal_distance(target, support), most=within_m),
    )
    return lies_still(target, initial, placed, support)
