"""Put a toppled object upright: a can, a bottle, a mug, a carton.

Randomisation: which object and colour; where it lies, on which side and at what yaw; where the end effector starts;
distractors.

Success: the object's axis is within ``tilt_deg`` of the vertical, the right way up. It leans on nothing. It was set
down on the table and not dropped, it stands still, and the hand has left it, for ``hold_s``.

Non-obvious: the tool leans towards the foot of the lying object and away from that of the standing one; the two angles
add up to a right angle. A tool that first points straight down would have to be level at the end, and the arm cannot
get that low. The standing object may have any yaw, so the expert tries several.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from roboxim_core.errors import ConfigError
from roboxim_core.kinematics import ArmKinematics
from roboxim_core.models.description import ObjectModel, RobotModel
from roboxim_core.poses import Array, Pose, Vec3
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_core.state import StateRecord
from roboxim_tasks.components import Constraint, ResetContext
from roboxim_tasks.handling import DROP_M
from roboxim_tasks.measures import Condition, Conditions, Measure, above, stands_alone, table_force, tilt
from roboxim_tasks.motion import RELEASE_CLEARANCE_M, ExpertScene, Grasp, Stage, grasp_poses, retreated, shifted
from roboxim_tasks.reach import follows, start_clear
from roboxim_tasks.script import APPROACH_M, LIFT_M, Script
from roboxim_tasks.skills.base import Evaluator, Role, Skill, parameters_of, register
from roboxim_tasks.skills.placing import lies_still
from roboxim_tasks.skills.push_object import extent

YAWS = tuple(math.radians(angle) for angle in (0, 30, -30, 60, -60, 90, -90))
LEANS = tuple(math.radians(angle) for angle in (45, 37, 53, 30, 60))
"""Angles between the tool and the axis of the standing object, best first [rad]; with the lying object they add up to
90 degrees."""
LEVEL = 0.2
PALM_M = 0.0355
"""Distance between the tool centre point and the palm, along the tool [m]."""
PAD_M = 0.014
EVEN_M = 0.002
STEP_M = 0.015
OPENING_M = 0.08


@dataclass(frozen=True, kw_only=True)
class TurnUprightParameters:
    """Thresholds of success."""

    tilt_deg: float = 10.0
    """Largest angle between the object's axis and the vertical [degrees]."""
    drop_m: float = DROP_M
    """Largest free fall [m]."""
    hold_s: float = 0.5
    """Time that the object must stand still [s]."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: When a value is out of range.
        """
        if not 0 < self.tilt_deg <= 30 or self.hold_s < 0:
            raise ConfigError(f"needs 0 < tilt_deg <= 30 and hold_s >= 0, got {self}")


@register
class TurnUpright(Skill):
    """Generator, resetter, executor and evaluator of ``turn_upright``."""

    name = "turn_upright"
    roles = {"target": Role(affordance="upright", models=("soda_can",))}
    templates = ("Turn the {target} upright", "Put the {target} upright", "Stand the {target} up")
    components = ("robot", "objects", "toppled", "distractors", "cameras", "lights")
    rotations = 3
    max_steps = 150
    Parameters = TurnUprightParameters

    def constraints(self, context: ResetContext) -> Sequence[Constraint]:
        """Require that the arm reaches a grasp of the lying object, and the same grasp of the standing one."""
        entity = context.task.objects["target"].entity

        def reachable(scene: SceneSpec) -> bool:
            spec = scene.entity(entity)
            model, pose = context.library.entity_model(spec), scene.robot.pose.inverse() @ spec.pose
            return any(
                _follows(context.arm, pose @ grasp.pose, goal @ grasp.pose)
                for grasp in leaning_grasps(model, pose)
                for goal in standing(model, pose, grasp.pose)
            )

        return (Constraint(name="target_reachable", holds=reachable), start_clear(context))

    def stages(self, scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
        """Grasp the object with a leaning tool, lift, turn, put it down; likely reachable candidates first."""
        entity = scene.task.objects["target"].entity
        model, pose = scene.model_of(entity), scene.pose_of(entity)
        if scene.held == entity:
            for goal in standing(model, pose, Script(scene).held_in_tcp.inverse()):
                script = Script(scene)
                script.pick(entity, None)
                script.place(goal)
                yield script.stages
            return
        arm = _arm(scene.robot)
        doubtful: list[tuple[Grasp, Pose]] = []
        for grasp in leaning_grasps(model, pose):
            for goal in standing(model, pose, grasp.pose):
                if _follows(arm, pose @ grasp.pose, goal @ grasp.pose):
                    yield _turn_up(scene, grasp, pose, goal)
                else:
                    doubtful.append((grasp, goal))
        for grasp, goal in doubtful:
            yield _turn_up(scene, grasp, pose, goal)

    def evaluator(self, task: TaskSpec, initial: StateRecord) -> Evaluator:
        """Judge: upright, on the table, let go and at rest."""
        parameters: TurnUprightParameters = parameters_of(task, TurnUprightParameters)
        entity = task.objects["target"].entity
        lean = tilt(entity)
        degrees = Measure(name="tilt_deg", of=lambda state: math.degrees(lean.of(state)))
        stands = (
            Condition(name="upright", measure=degrees, most=parameters.tilt_deg),
            Condition(name="on_table", measure=table_force(entity), least=above(0.0)),
            stands_alone(entity),
        )
        return Conditions(lies_still(entity, initial, stands, drop_m=parameters.drop_m), hold_s=parameters.hold_s)


def _turn_up(scene: ExpertScene, grasp: Grasp, pose: Pose, goal: Pose) -> tuple[Stage, ...]:
    entity = scene.task.objects["target"].entity
    script = Script(scene)
    script.pick(entity, replace(grasp, pose=pose @ grasp.pose))
    script.place(goal)
    return script.stages


def _arm(robot: RobotModel) -> ArmKinematics:
    if robot.urdf not in _ARMS:
        _ARMS[robot.urdf] = ArmKinematics(robot)
    return _ARMS[robot.urdf]


_ARMS: dict[Path, ArmKinematics] = {}


def _follows(arm: ArmKinematics, lying: Pose, standing: Pose) -> bool:
    """Return whether an arm reaches the tool's poses at the lying and at the standing object from above."""
    return follows(
        arm, retreated(lying, APPROACH_M), lying, shifted(lying, LIFT_M), shifted(standing, LIFT_M), standing
    )


def leaning_grasps(model: ObjectModel, pose: Pose) -> list[Grasp]:
    """Return grasps that can put a toppled object upright, best first; poses are in the object's frame.

    Each is one of the model's grasps, turned about its closing axis so that the tool leans by some 45 degrees at both
    the lying and the standing object. The closing axis is level in both poses. Grasps across the object's axis are
    tried all along it.

    Args:
        model: The object.
        pose: Its pose in the base, lying.
    """
    x, y, z = pose.rotation.inv().apply([0.0, 0.0, -1.0]).round(2).tolist()
    return list(_leaning(model, (x, y, z)))


@lru_cache(maxsize=64)
def _leaning(model: ObjectModel, down: Vec3) -> tuple[Grasp, ...]:
    from scipy.spatial.transform import Rotation

    found: dict[tuple[float, ...], tuple[float, Grasp]] = {}
    for annotation in model.grasps:
        opening = min(1.0, (annotation.width_m + RELEASE_CLEARANCE_M) / OPENING_M)
        for grasp in grasp_poses(replace(model, grasps=(annotation,)), Pose(), Pose()):
            approach, closing = grasp.rotation.apply([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
            if abs(closing[2]) > LEVEL or abs(float(closing @ np.array(down))) > LEVEL:
                continue
            side = math.copysign(1.0, _angle(np.array(down), closing))
            for place, even in _places(model, grasp):
                for lean in LEANS:
                    turn = Rotation.from_euler("y", side * lean - _angle(approach, closing))
                    leaning = place @ Pose.from_arrays((0.0, 0.0, 0.0), turn)
                    key = tuple(round(value, 3) + 0.0 for value in (*leaning.position, *leaning.rotation.as_rotvec()))
                    if key not in found and _beyond_palm(model, leaning) <= 0.0:
                        way = Grasp(pose=leaning, release_opening=opening, name=annotation.name)
                        found[key] = (abs(lean - LEANS[0]) + (0.0 if even else math.pi), way)
    ordered = sorted(found.values(), key=lambda pair: (round(pair[0], 3), -pair[1].pose.position[2]))
    return tuple(grasp for _, grasp in ordered)


def standing(model: ObjectModel, pose: Pose, grasp: Pose) -> list[Pose]:
    """Return poses of the standing object at its present place, first those where the tool leans away from the robot.

    Args:
        model: The object.
        pose: Its pose in the base, lying.
        grasp: Pose of the tool in the object's frame.
    """
    from scipy.spatial.transform import Rotation

    x, y, _ = pose.position
    lean = grasp.rotation.apply([0.0, 0.0, 1.0])
    outwards = math.atan2(y, x) - math.atan2(lean[1], lean[0])
    position = (x, y, _floor(model, pose) + model.rest_height)
    return [Pose.from_arrays(position, Rotation.from_euler("z", outwards + yaw)) for yaw in YAWS]


def _places(model: ObjectModel, grasp: Pose) -> Iterator[tuple[Pose, bool]]:
    """Yield a grasp at places along the object's axis, from the top, if it lies on that axis; else the grasp alone.

    Each comes with whether the fingers touch even sides: over an edge a finger may be caught when it lets go.
    """
    x, y, _ = grasp.position
    if math.hypot(x, y) > 1e-3:
        yield grasp, True
        return
    closing = grasp.rotation.apply([0.0, 1.0, 0.0])
    for z in np.arange(model.size[2] - model.rest_height - PAD_M, PAD_M - model.rest_height, -STEP_M).tolist():
        widths = [_width(model, closing, z + offset) for offset in (-PAD_M, 0.0, PAD_M)]
        yield replace(grasp, position=(x, y, z)), max(widths) - min(widths) < EVEN_M


def _width(model: ObjectModel, closing: Array, z: float) -> float:
    """Return the extent of an upright object along the closing axis at a height in its frame [m]."""
    up = np.array([0.0, 0.0, 1.0])
    reach = 0.0
    for shape in model.links[0].collision:
        one = replace(model, links=(replace(model.links[0], collision=(shape,)),))
        if -extent(one, Pose(), -up) - 1e-6 <= z <= extent(one, Pose(), up) + 1e-6:
            reach = max(reach, extent(one, Pose(), closing))
    return reach


def _angle(vector: Array, axis: Array) -> float:
    """Return the angle about an axis from the object's downward axis to a vector [rad]."""
    foot = np.array([0.0, 0.0, -1.0])
    return math.atan2(float(np.cross(foot, vector) @ axis), float(foot @ vector))


def _beyond_palm(model: ObjectModel, grasp: Pose) -> float:
    """Return the depth to which an object would reach into the palm [m]."""
    back = -grasp.rotation.apply([0.0, 0.0, 1.0])
    return extent(model, Pose(), back) - float(np.array(grasp.position) @ back) - PALM_M


def _floor(model: ObjectModel, pose: Pose) -> float:
    """Return the height of the surface under a lying object, in the frame of its pose [m]."""
    return pose.position[2] - extent(model, pose, np.array([0.0, 0.0, -1.0]))
