"""Place an object on another: a plate, a tray, a block.

Randomisation: which objects and colours; where both lie and at what yaw; where the end effector starts; distractors.

Success: the object touches the support and not the table, its origin is above the support's surface, it was set down
and not dropped, the hand has left it, and it lies still for ``hold_s``.

Non-obvious: the generator writes the shape of the support's surface into the task's arguments, so that a bag can be
judged without the models. The gripper releases an object that is longer than the surface above the support's highest
point, because a rim may be in its way.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from roboxim_core.errors import ConfigError
from roboxim_core.models.articulation import object_link_poses
from roboxim_core.models.description import ObjectModel
from roboxim_core.poses import Array
from roboxim_core.specs import Scalar, TaskSpec
from roboxim_core.state import StateRecord
from roboxim_tasks.components import Constraint, ResetContext
from roboxim_tasks.handling import DROP_M
from roboxim_tasks.measures import Condition, Conditions, Measure, above, force, table_force
from roboxim_tasks.motion import ExpertScene, Stage
from roboxim_tasks.reach import above_reachable, graspable, start_clear
from roboxim_tasks.sampling.generators import GenerationContext, generate_task
from roboxim_tasks.skills.base import Evaluator, Role, Skill, parameters_of, register
from roboxim_tasks.skills.placing import GOAL_YAWS, fits, lies_still, put, raised, region_of, region_pose, upright
from roboxim_tasks.standing import nothing_else_put, rests_alone, rests_on, stays_upright, upright_arguments

SURFACE_SHARE = 0.9
"""Largest distance of the object's origin from the middle of the surface, as a share of the distance to the edge.

An object that is wholly on the surface is within, one that hangs over the edge by half is not."""
LONGEST = 2.4
"""Largest ratio of an object's longest side to the longest side of the support's surface or rim."""


@dataclass(frozen=True, kw_only=True)
class PlaceOnParameters:
    """Thresholds of success."""

    within_m: float = 0.0
    """Largest distance of the origin from the middle of the surface [m]; 0: anywhere above the surface."""
    drop_m: float = DROP_M
    """Largest free fall [m]; the height of a rim is added, because wide objects are released above it."""
    hold_s: float = 0.3
    """Time that the object must lie still [s]."""
    surface_x_m: float = 0.0
    """Middle of the surface in the support's base [m]; set by the generator."""
    surface_y_m: float = 0.0
    """As ``surface_x_m``."""
    surface_yaw_rad: float = 0.0
    """Angle of the surface's sides in the support's base [rad]; set by the generator."""
    half_x_m: float = 0.0
    """Half of the surface's extent along x [m]; set by the generator."""
    half_y_m: float = 0.0
    """Half of the surface's extent along y [m]; set by the generator."""
    round: bool = False
    """Whether the surface is a disc instead of a rectangle; set by the generator."""
    rim_m: float = 0.0
    """Height of the support's highest point above the surface [m]; set by the generator."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: When a threshold is out of range.
        """
        if self.within_m < 0 or self.drop_m <= 0 or self.hold_s < 0:
            raise ConfigError(f"needs within_m >= 0, drop_m > 0 and hold_s >= 0, got {self}")


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
        """Return that a target is so long that it would tip off the support or its rim; else an empty text."""
        target, support = models["target"], models["support"]
        room_m = max(max(region.size[:2]) for region in support.regions if region.kind in ("surface", "interior"))
        if max(target.size[:2]) > LONGEST * room_m:
            return f"the {target.name} is too long to lie on the {support.name}"
        return ""

    def generate(self, context: GenerationContext) -> TaskSpec:
        """Draw a task and record the shape of the support's surface."""
        task = generate_task(context)
        support = task.objects["support"]
        surface = surface_arguments(context.library.object(support.model, support.modifiers))
        return replace(task, arguments=task.arguments | surface | upright_arguments(task, context.library))

    def constraints(self, context: ResetContext) -> Sequence[Constraint]:
        """Require that the arm reaches the target, and a grasp of the target above the support."""
        return (graspable(context, "target"), above_reachable(context, "support"), start_clear(context))

    def stages(self, scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
        """Pick up the object and put it in the middle of the surface; its present yaw comes first."""
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
        """Judge: on the support, above its surface, set down, let go and at rest."""
        parameters: PlaceOnParameters = parameters_of(task, PlaceOnParameters)
        return Conditions(placed_on(task, initial, parameters), hold_s=parameters.hold_s)


def placed_on(task: TaskSpec, initial: StateRecord, parameters: PlaceOnParameters) -> tuple[Condition, ...]:
    """Return the conditions that a task's target was placed on its support."""
    target, support = (task.objects[role].entity for role in ("target", "support"))

    def from_middle(state: StateRecord) -> Array:
        """Return the target's origin relative to the surface's middle, along the surface's sides, shape (2,) [m]."""
        base = state.entity(support).pose.inverse()
        x, y, _ = base.apply(state.entity(target).pose.position)
        dx, dy = x - parameters.surface_x_m, y - parameters.surface_y_m
        cosine, sine = math.cos(parameters.surface_yaw_rad), math.sin(parameters.surface_yaw_rad)
        return np.array([cosine * dx + sine * dy, cosine * dy - sine * dx])

    def share(state: StateRecord) -> float:
        shares = from_middle(state) / (parameters.half_x_m, parameters.half_y_m)
        return float(np.linalg.norm(shares) if parameters.round else np.abs(shares).max())

    distance = Measure(name="middle_distance_m", of=lambda state: float(np.linalg.norm(from_middle(state))))
    placed = [
        Condition(name="on_support", measure=force(target, support, "support_force_n"), least=above(0.0)),
        Condition(name="off_table", measure=table_force(target), most=0.0, reason="touches_table"),
        Condition(name="centred", measure=Measure(name="surface_share", of=share), most=SURFACE_SHARE),
    ]
    placed += (
        *stays_upright(task, initial),
        rests_alone(target, initial, support),
        nothing_else_put(task, initial, lambda state, name: rests_on(state, name, support)),
    )
    if parameters.within_m:
        placed.append(Condition(name="near_middle", measure=distance, most=parameters.within_m, reason="not_centred"))
    return lies_still(target, initial, placed, support, parameters.drop_m + parameters.rim_m)


def surface_arguments(model: ObjectModel) -> dict[str, Scalar]:
    """Return the position and shape of a support's surface as scalars."""
    surface = region_of(model, "surface")
    middle = object_link_poses(model, {})[surface.link or model.links[0].name] @ surface.pose
    along = middle.rotation.apply([1.0, 0.0, 0.0])
    disc = surface.shape == "disc"
    half_x, half_y = (min(surface.size[:2]) / 2,) * 2 if disc else (surface.size[0] / 2, surface.size[1] / 2)
    return {
        "surface_x_m": middle.position[0], "surface_y_m": middle.position[1],
        "surface_yaw_rad": math.atan2(along[1], along[0]), "half_x_m": half_x, "half_y_m": half_y, "round": disc,
        "rim_m": max(0.0, model.size[2] - model.rest_height - middle.position[2]),
    }  # fmt: skip
