"""Place an object to the left of, to the right of, in front of or behind another one: one skill per relation.

Randomisation: which objects and colours; where both lie and at what yaw; where the end effector starts; distractors.

Success, for ``hold_s``:
    - Seen from the reference, the object lies more than ``along_m`` and at most ``farthest_m`` in the direction, and
      less than ``lateral_ratio`` of that to the side.
    - The object was set down on the table and not dropped, the robot has let go of it, and it is at rest.
    - The reference has moved by less than ``reference_shift_m``.

Non-obvious: directions are those of the robot's base, seen from the robot: left = +y, in front of = towards the base.
With ``viewpoint: facing`` they are those of a person across the table who looks at the robot. The generator writes the
direction in the world into the task's arguments, so that a bag can be judged without the scene.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from roboxim_core.errors import ConfigError, one_of
from roboxim_core.models.description import ObjectModel
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Array, Pose
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_core.state import StateRecord
from roboxim_tasks.components import Constraint, ResetContext
from roboxim_tasks.handling import DROP_M
from roboxim_tasks.measures import Condition, Conditions, Measure, above, offset, shift, table_force
from roboxim_tasks.motion import ExpertScene, Stage, with_poses
from roboxim_tasks.reach import downward_reachable, graspable, start_clear
from roboxim_tasks.sampling.generators import GenerationContext, generate_task
from roboxim_tasks.sampling.placement import Room
from roboxim_tasks.skills.base import Evaluator, Role, Skill, parameters_of, register
from roboxim_tasks.skills.placing import GOAL_YAWS, lies_still, put, upright
from roboxim_tasks.standing import nothing_else_put, rests_alone, stays_upright, upright_arguments

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

VIEWPOINTS = ("robot", "facing")
GAPS_M = (0.05, 0.08, 0.03, 0.12, 0.16)
SLOPES = (0.0, 0.25, -0.25, 0.45, -0.45)
FREE_GAP_M = 0.012
GOALS = 10
WIDE_M = 0.12
"""Length of the shorter side above which the expert first tries to align a side with the direction, which needs the
least room [m]."""
BORDER_M = 0.05
OTHERS_M = 0.1
"""Distance that another object must have moved to count as put to the same side [m]."""
NEAREST_M, FARTHEST_M = 0.32, 0.74
"""Smallest and largest distance from the robot's axis at which it places objects from above at any yaw [m]."""
FARTHEST_X_M, FARTHEST_Y_M = 0.72, 0.32
"""Area of the table in the workspace camera's view, in front of the robot and to its sides."""


@dataclass(frozen=True, kw_only=True)
class RelationParameters:
    """Viewpoint of the directions, and thresholds of success."""

    viewpoint: str = "robot"
    """Viewpoint of left and right: ``robot``, or ``facing``, a person across the table who looks at the robot."""
    along_m: float = 0.03
    """Smallest distance from the reference in the direction [m]."""
    lateral_ratio: float = 0.7
    """Largest distance to the side, as a fraction of the distance in the direction."""
    farthest_m: float = 0.35
    """Largest distance in the direction [m]."""
    reference_shift_m: float = 0.03
    """Largest displacement of the reference [m]."""
    drop_m: float = DROP_M
    """Largest free fall [m]."""
    hold_s: float = 0.3
    """Time that the object must lie still [s]."""
    direction_x: float = 0.0
    """The direction in the world; set by the generator."""
    direction_y: float = 0.0
    """The direction in the world; set by the generator."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: When the viewpoint is unknown or a threshold is out of range.
        """
        if self.viewpoint not in VIEWPOINTS:
            raise ConfigError(f"unknown viewpoint; {one_of(VIEWPOINTS, self.viewpoint)}")
        if not 0 < self.along_m < self.farthest_m or self.lateral_ratio <= 0 or self.hold_s < 0:
            raise ConfigError(f"needs 0 < along_m < farthest_m, lateral_ratio > 0 and hold_s >= 0, got {self}")


class PlaceRelation(Skill):
    """Generator, resetter, executor and evaluator of the four relations."""

    direction: ClassVar[tuple[float, float]]
    """The direction in the robot's base, seen by the robot."""
    roles = {"reference": Role(), "target": Role(affordance="graspable")}
    max_steps = 200
    Parameters = RelationParameters

    def generate(self, context: GenerationContext) -> TaskSpec:
        """Draw a task, and record the direction in the world."""
        task = generate_task(context)
        robot = context.config.base_scene().robot.pose
        sign = 1.0 if task.arguments["viewpoint"] == "robot" else -1.0
        x, y, _ = robot.rotation.apply((*self.direction, 0.0)) * sign
        toward = {"direction_x": float(x), "direction_y": float(y)}
        return replace(task, arguments=task.arguments | toward | upright_arguments(task, context.library))

    def constraints(self, context: ResetContext) -> Sequence[Constraint]:
        """Require that the relation does not hold yet, and that the arm reaches a free place where it would."""
        target, reference = (context.task.objects[role].entity for role in ("target", "reference"))
        parameters: RelationParameters = parameters_of(context.task, RelationParameters)
        direction = np.array([parameters.direction_x, parameters.direction_y])

        def unsolved(scene: SceneSpec) -> bool:
            away = np.subtract(scene.entity(target).pose.position, scene.entity(reference).pose.position)[:2]
            along, lateral = _components(away, direction)
            return not (along > 0.0 and lateral < parameters.lateral_ratio * along)

        last: dict[tuple[Pose, Pose], Pose] = {}

        def free(scene: SceneSpec) -> bool:
            """Return whether there is a free place; keep the one found before unless a new distractor has taken it."""
            key = scene.entity(target).pose, scene.entity(reference).pose
            if key in last and not _taken(scene, target, last[key], context.library):
                return True
            base = scene.robot.pose.inverse()
            for goal in free_goals(scene, target, reference, direction, parameters, context.library):
                if downward_reachable(context, (base @ goal).position):
                    last.clear()
                    last[key] = goal
                    return True
            return False

        return (
            graspable(context, "target"),
            Constraint(name="not_there_already", holds=unsolved),
            Constraint(name="free_place", holds=free, room=True),
            start_clear(context),
        )

    def stages(self, scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
        """Pick up the object and place it at a free place in the direction, the nearest comfortable one first."""
        target, reference = (scene.task.objects[role].entity for role in ("target", "reference"))
        parameters: RelationParameters = parameters_of(scene.task, RelationParameters)
        direction = np.array([parameters.direction_x, parameters.direction_y])
        now = with_poses(scene.scene, scene.state)
        goals = free_goals(now, target, reference, direction, parameters, scene.library)
        return put(scene, target, [scene.in_base(goal) for goal in goals])

    def evaluator(self, task: TaskSpec, initial: StateRecord) -> Evaluator:
        """Judge: in the direction, on the table, let go and at rest, the reference not moved."""
        parameters: RelationParameters = parameters_of(task, RelationParameters)
        target, reference = (task.objects[role].entity for role in ("target", "reference"))
        direction = np.array([parameters.direction_x, parameters.direction_y])

        def components(state: StateRecord, entity: str = target) -> tuple[float, float]:
            return _components(offset(state, entity, reference)[:2], direction)

        def put_there(state: StateRecord, entity: str) -> bool:
            """Return whether another object is in the direction; after tick 0, whether it was also brought there."""
            way, lateral = components(state, entity)
            before, now = initial.entity(entity).pose.position, state.entity(entity).pose.position
            brought = state.seq == initial.seq or math.dist(before, now) > OTHERS_M
            return brought and way > parameters.along_m and lateral < parameters.lateral_ratio * way

        along = Measure(name="along_m", of=lambda state: components(state)[0])
        ratio = Measure(name="lateral_ratio", of=lambda state: components(state)[1] / max(components(state)[0], 1e-6))
        placed = (
            Condition(
                name="reference_stayed", measure=shift(reference, initial, "reference_shift_m"),
                most=parameters.reference_shift_m, reason="moved_reference",
            ),
            Condition(
                name="in_direction", measure=along, least=above(parameters.along_m), most=parameters.farthest_m
            ),
            Condition(name="not_beside", measure=ratio, most=parameters.lateral_ratio, reason="too_far_to_the_side"),
            Condition(name="on_table", measure=table_force(target), least=above(0.0)),
            *stays_upright(task, initial),
            rests_alone(target, initial),
            nothing_else_put(task, initial, put_there),
        )  # fmt: skip
        return Conditions(lies_still(target, initial, placed, reference, parameters.drop_m), hold_s=parameters.hold_s)


def free_goals(
    scene: SceneSpec,
    target: str,
    reference: str,
    direction: Array,
    parameters: RelationParameters,
    library: ModelLibrary,
) -> Iterator[Pose]:
    """Yield up to `GOALS` poses of the target in the world that satisfy the relation and touch nothing, best first.

    All are at comfortable places, see `comfortable`.
    """
    spec, other = scene.entity(target), scene.entity(reference)
    model, other_model = library.entity_model(spec), library.entity_model(other)
    side = np.array([-direction[1], direction[0]])
    room = _room_without(scene, target, library)
    height = scene.table.center[2] + model.rest_height
    yaws = (*aligning_yaws(model, spec.pose, direction), *GOAL_YAWS[:3])
    turns = [upright(spec.pose, (0.0, 0.0, 0.0), yaw) for yaw in yaws]
    reaches = [half_extent(model, turn.rotation, direction) for turn in turns]
    edge = half_extent(other_model, other.pose.rotation, direction)
    found = 0
    for gap_m in GAPS_M:
        for slope in SLOPES:
            for turn, reach in zip(turns, reaches, strict=True):
                along = max(reach + gap_m + edge, parameters.along_m + 0.02)
                if along > parameters.farthest_m - 0.02 or abs(slope) > parameters.lateral_ratio - 0.15:
                    continue
                x, y = (np.array(other.pose.position[:2]) + direction * along + side * slope * along).tolist()
                goal = replace(turn, position=(x, y, height))
                if comfortable(scene, goal) and not room.refusal(replace(spec, pose=goal)):
                    yield goal
                    found += 1
                    if found == GOALS:
                        return


def _room_without(scene: SceneSpec, target: str, library: ModelLibrary) -> Room:
    others = replace(scene, entities=tuple(entity for entity in scene.entities if entity.name != target))
    return Room.of(others, library, FREE_GAP_M)


def _taken(scene: SceneSpec, target: str, goal: Pose, library: ModelLibrary) -> bool:
    """Return whether another object occupies the target's goal."""
    return bool(_room_without(scene, target, library).refusal(replace(scene.entity(target), pose=goal)))


def aligning_yaws(model: ObjectModel, pose: Pose, direction: Array) -> tuple[float, ...]:
    """Return the turns that align a wide object's shorter or longer side with a direction [rad]; none for others."""
    if min(model.size[:2]) <= WIDE_M:
        return ()
    x, y, _ = pose.rotation.apply((1.0, 0.0, 0.0) if model.size[0] <= model.size[1] else (0.0, 1.0, 0.0))
    turn = math.atan2(direction[1], direction[0]) - math.atan2(y, x)
    return tuple(math.remainder(turn + more, math.pi) for more in (0.0, math.pi / 2))


def comfortable(scene: SceneSpec, goal: Pose) -> bool:
    """Return whether a place is in the workspace, neither too near to the robot nor too far for any grasp."""
    lower, upper = (np.array(corner[:2]) for corner in (scene.workspace.lower, scene.workspace.upper))
    xy = np.array(goal.position[:2])
    inside = bool(np.all(xy >= lower + BORDER_M) and np.all(xy <= upper - BORDER_M))
    x, y, _ = (scene.robot.pose.inverse() @ goal).position
    return inside and x <= FARTHEST_X_M and abs(y) <= FARTHEST_Y_M and NEAREST_M <= math.hypot(x, y) <= FARTHEST_M


def half_extent(model: ObjectModel, rotation: Rotation, direction: Array) -> float:
    """Return the extent of an upright object from its origin in a horizontal direction [m]."""
    x, y, _ = rotation.inv().apply((*direction, 0.0))
    return float(abs(x) * model.size[0] + abs(y) * model.size[1]) / 2


def _components(away: Array, direction: Array) -> tuple[float, float]:
    along = float(away @ direction)
    return along, float(abs(away[0] * direction[1] - away[1] * direction[0]))


@register
class PlaceLeftOf(PlaceRelation):
    """``place_left_of``."""

    name = "place_left_of"
    direction = (0.0, 1.0)
    templates = (
        "Place the {target} to the left of the {reference}",
        "Put the {target} left of the {reference}",
        "Move the {target} to the left side of the {reference}",
    )


@register
class PlaceRightOf(PlaceRelation):
    """``place_right_of``."""

    name = "place_right_of"
    direction = (0.0, -1.0)
    templates = (
        "Place the {target} to the right of the {reference}",
        "Put the {target} right of the {reference}",
        "Move the {target} to the right side of the {reference}",
    )


@register
class PlaceInFrontOf(PlaceRelation):
    """``place_in_front_of``."""

    name = "place_in_front_of"
    direction = (-1.0, 0.0)
    templates = (
        "Place the {target} in front of the {reference}",
        "Put the {target} before the {reference}",
        "Move the {target} to the front of the {reference}",
    )


@register
class PlaceBehind(PlaceRelation):
    """``place_behind``."""

    name = "place_behind"
    direction = (1.0, 0.0)
    templates = (
        "Place the {target} behind the {reference}",
        "Put the {target} at the back of the {reference}",
        "Move the {target} behind the {reference}",
    )
