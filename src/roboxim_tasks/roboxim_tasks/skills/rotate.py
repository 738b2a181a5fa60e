"""Rotate an object about the vertical, clockwise or counter-clockwise (seen from above), by an angle.

Randomisation: which object and colour; where it lies and at what yaw; where the end effector starts; distractors.

Success, for ``hold_s``:
    - The object has been turned by the angle within ``tolerance_deg``.
    - The side that was up is still up, and its origin is within ``shift_m`` of its initial position.
    - It was set down on the table and not dropped, it lies still, and the hand has left it.

Non-obvious: the rotation accumulates over the ticks, so 270 degrees in the other direction do not count as 90. The
expert lifts the object first, because an object that is turned on the table drifts.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from roboxim_core.errors import ConfigError, one_of
from roboxim_core.poses import Pose
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_core.state import StateRecord
from roboxim_tasks.components import Constraint, ResetContext
from roboxim_tasks.handling import DROP_M
from roboxim_tasks.measures import Condition, Conditions, Measure, above, shift, table_force, turned
from roboxim_tasks.motion import TABLE, ExpertScene, Grasp, Stage, grasp_poses, grasps_of, retreated, shifted
from roboxim_tasks.reach import reaches_in_lines, start_clear
from roboxim_tasks.sampling.generators import GenerationContext, generate_task
from roboxim_tasks.sampling.placement import Room
from roboxim_tasks.script import APPROACH_M, SLOW, Script
from roboxim_tasks.skills.base import Evaluator, Role, Skill, parameters_of, register
from roboxim_tasks.skills.placing import lies_still
from roboxim_tasks.standing import kept_upright, rests_alone, upright_arguments

DIRECTIONS = {"clockwise": -1.0, "counter-clockwise": 1.0}
"""Direction in the instruction to the sign of the rotation about the upward vertical."""
LIFTS_M = (0.05, 0.10, 0.15)
LOWERED_M = 0.002
STEP_RAD = math.radians(120)
FREE_GAP_M = 0.01


@dataclass(frozen=True, kw_only=True)
class RotateParameters:
    """Rotation to perform, and thresholds of success."""

    direction: str = "clockwise"
    """``clockwise`` or ``counter-clockwise``, seen from above."""
    angle_deg: float = 90.0
    """How far [degrees]."""
    tolerance_deg: float = 5.0
    """Largest deviation from the angle [degrees]."""
    shift_m: float = 0.05
    """Largest displacement of the object [m]."""
    drop_m: float = DROP_M
    """Largest free fall [m]."""
    hold_s: float = 0.3
    """Time that the object must lie still [s]."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: When the direction is unknown or a number is out of range.
        """
        if self.direction not in DIRECTIONS:
            raise ConfigError(f"unknown direction '{self.direction}'; {one_of(DIRECTIONS, self.direction)}")
        if not 0 < self.tolerance_deg < self.angle_deg <= 180 or self.shift_m <= 0 or self.hold_s < 0:
            raise ConfigError(f"needs 0 < tolerance_deg < angle_deg <= 180, shift_m > 0 and hold_s >= 0, got {self}")

    @property
    def angle_rad(self) -> float:
        """Rotation about the upward vertical [rad]."""
        return DIRECTIONS[self.direction] * math.radians(self.angle_deg)


@register
class Rotate(Skill):
    """Generator, resetter, executor and evaluator of ``rotate``."""

    name = "rotate"
    roles = {"target": Role(affordance="graspable")}
    words = ("direction", "angle")
    templates = (
        "Rotate the {target} {direction} by {angle} degrees",
        "Turn the {target} by {angle} degrees {direction}",
        "Turn the {target} {direction} by {angle} degrees",
    )
    max_steps = 150
    Parameters = RotateParameters

    def generate(self, context: GenerationContext) -> TaskSpec:
        """Draw a task."""
        parameters: RotateParameters = context.parameters
        words = {"direction": parameters.direction, "angle": f"{parameters.angle_deg:g}"}
        task = generate_task(context, words=words)
        return replace(task, arguments=task.arguments | upright_arguments(task, context.library))

    def constraints(self, context: ResetContext) -> Sequence[Constraint]:
        """Require that the arm reaches a grasp, and the same grasp after the rotation."""
        parameters: RotateParameters = parameters_of(context.task, RotateParameters)
        entity, one_jaw = context.task.objects["target"].entity, context.arm.model.gripper.one_jaw

        def reachable(scene: SceneSpec) -> bool:
            spec = scene.entity(entity)
            pose = scene.robot.pose.inverse() @ spec.pose
            home = context.arm.fk(context.arm.model.home)
            for grasp in grasp_poses(context.library.entity_model(spec), pose, home, one_jaw=one_jaw):
                way = [_turned(pose, angle) @ pose.inverse() @ grasp for angle in _steps(parameters.angle_rad)]
                lifted = [shifted(turn, LIFTS_M[0]) for turn in way]
                if reaches_in_lines(context, retreated(grasp, APPROACH_M), grasp, *lifted, way[-1]):
                    return True
            return False

        def free(scene: SceneSpec) -> bool:
            spec = scene.entity(entity)
            others = replace(scene, entities=tuple(e for e in scene.entities if e.name != entity))
            room = Room.of(others, context.library, FREE_GAP_M)
            turns = (replace(spec, pose=_turned(spec.pose, angle)) for angle in _steps(parameters.angle_rad))
            return not any(room.refusal(turn) for turn in turns)

        return (
            Constraint(name="free_to_turn", holds=free, room=True),
            Constraint(name="target_reachable", holds=reachable),
            start_clear(context),
        )

    def stages(self, scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
        """Pick up the object, turn it, put it down at its initial place; low lifts first."""
        parameters: RotateParameters = parameters_of(scene.task, RotateParameters)
        entity = scene.task.objects["target"].entity
        begin = scene.in_base(scene.scene.entity(entity).pose)
        now = scene.pose_of(entity)
        # An angle is known but for whole rounds, and the verdict counts on: take the one within the way to the goal.
        seen, half = float((now.rotation * begin.rotation.inv()).as_rotvec()[2]), parameters.angle_rad / 2
        done = half + math.remainder(seen - half, math.tau)
        goal = Pose(position=begin.position, quat_xyzw=now.quat_xyzw)
        grasps: Sequence[Grasp | None] = [None] if scene.held == entity else grasps_of(scene, entity)
        for grasp in grasps:
            for lift_m in LIFTS_M:
                script = Script(scene)
                if grasp is not None:
                    script.pick(entity, grasp, lift_m=0.0)
                in_hand = script.held_in_tcp.inverse()
                script.move(shifted(script.pose, lift_m), name="lift", speed=SLOW, touching=((entity, TABLE),))
                for angle in _steps(parameters.angle_rad - done):
                    script.move(shifted(_turned(goal, angle) @ in_hand, lift_m), name="turn")
                end = shifted(_turned(goal, parameters.angle_rad - done), LOWERED_M)
                script.move(end @ in_hand, name="lower", speed=SLOW, touching=((entity, TABLE),))
                script.release(end)
                yield script.stages

    def evaluator(self, task: TaskSpec, initial: StateRecord) -> Evaluator:
        """Judge: turned far enough but not too far, at its initial place, on the table, let go and at rest."""
        parameters: RotateParameters = parameters_of(task, RotateParameters)
        entity, sign = task.objects["target"].entity, DIRECTIONS[parameters.direction]
        turn = turned(entity, initial)
        degrees = Measure(name="turned_deg", of=lambda state: sign * math.degrees(turn.of(state)))
        placed = (
            Condition(
                name="turned", measure=degrees, least=parameters.angle_deg - parameters.tolerance_deg,
                most=parameters.angle_deg + parameters.tolerance_deg,
            ),
            Condition(name="on_table", measure=table_force(entity), least=above(0.0)),
            kept_upright(entity, initial),
            rests_alone(entity, initial),
            Condition(name="stayed", measure=shift(entity, initial), most=parameters.shift_m, reason="moved_away"),
        )  # fmt: skip
        return Conditions(lies_still(entity, initial, placed, drop_m=parameters.drop_m), hold_s=parameters.hold_s)


def _steps(angle_rad: float) -> list[float]:
    """Return rotations up to an angle in steps so small that the shortest arc of each has the right direction."""
    count = max(1, math.ceil(abs(angle_rad) / STEP_RAD))
    return [angle_rad * step / count for step in range(1, count + 1)]


def _turned(pose: Pose, angle_rad: float) -> Pose:
    """Return a pose turned about the vertical through its origin."""
    from scipy.spatial.transform import Rotation

    return Pose.from_arrays(pose.position, Rotation.from_euler("z", angle_rad) * pose.rotation)
