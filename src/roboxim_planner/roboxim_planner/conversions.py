"""Messages to the planner's values and back."""

from __future__ import annotations

import json
import math
import time
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import Pose as PoseMsg
from roboxim_interfaces.msg import ContactPair as ContactPairMsg
from roboxim_interfaces.msg import MotionPlan as MotionPlanMsg
from sensor_msgs.msg import JointState
from shape_msgs.msg import SolidPrimitive
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from roboxim_core.errors import ErrorCode, InvalidRequestError, PlannerError, one_of
from roboxim_core.models.description import RobotModel, Shape
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import IDENTITY, Pose
from roboxim_core.specs import EntitySpec
from roboxim_planner.constraint import Upright
from roboxim_planner.contacts import ContactPair
from roboxim_planner.pipeline import MotionOptions, Plan, Planner
from roboxim_planner.queries import (
    Answer,
    IkQuery,
    JointsQuery,
    LineQuery,
    PoseQuery,
    Query,
    RetimeQuery,
    SequenceQuery,
)
from roboxim_planner.retime import DEFAULT_TOLERANCE_RAD
from roboxim_planner.robot import PlannerRobot
from roboxim_planner.scene import (
    AllowedContact,
    Attached,
    Body,
    BodyShape,
    PlanningScene,
    PointHull,
    TriangleMesh,
    model_shapes,
)
from roboxim_planner.sequence import Stage, StageGoal
from roboxim_ros.conversions import fill_pose, pose_from_msg

Array = npt.NDArray[np.float64]
WORLD = "world"
TCP = "tcp"


def optional_pose(msg: PoseMsg) -> Pose:
    """Convert a pose; one whose numbers are all zero is the identity."""
    p, q = msg.position, msg.orientation
    return pose_from_msg(msg) if any((p.x, p.y, p.z, q.x, q.y, q.z, q.w)) else IDENTITY


def joints_from_msg(msg: JointState, robot: RobotModel, *, what: str) -> Array:
    """Return arm joints in the model's order from a joint state in any order.

    Raises:
        InvalidRequestError: On a wrong number of joints or a name that is unknown, missing or given twice.
    """
    positions = list(msg.position)
    names = list(msg.name)
    if not names:
        if len(positions) != len(robot.joint_names):
            raise InvalidRequestError(
                f"{what}: robot '{robot.id}' has {len(robot.joint_names)} arm joints, got {len(positions)} positions"
            )
        return np.array(positions, dtype=float)
    if len(names) != len(positions) or len(set(names)) != len(names):
        raise InvalidRequestError(f"{what}: needs one position per name, each name once; got {len(names)} names "
                                  f"and {len(positions)} positions")  # fmt: skip
    known = (*robot.joint_names, *robot.gripper.joint_names)
    for name in names:
        if name not in known:
            raise InvalidRequestError(f"{what}: robot '{robot.id}' has no joint '{name}'; {one_of(known, name)}")
    missing = [name for name in robot.joint_names if name not in names]
    if missing:
        raise InvalidRequestError(f"{what}: no position for joint {', '.join(missing)}")
    return np.array([positions[names.index(name)] for name in robot.joint_names], dtype=float)


def joints_to_msg(joints: Array, robot: RobotModel) -> JointState:
    """Return a joint state of the arm."""
    msg = JointState()
    msg.name = list(robot.joint_names)
    msg.position = joints.tolist()
    return msg


def pose_in_world(msg: Any, frame: str, robot: PlannerRobot, robot_pose: Pose, start: Array | None = None) -> Pose:
    """Convert a target pose to the world.

    Args:
        msg: ``geometry_msgs/Pose``.
        frame: ``world`` or empty, ``<robot>_base`` or the robot's base link, or ``tcp`` (at the start).
        robot: The robot.
        robot_pose: Its base in the world.
        start: Arm configuration at the start, for the frame ``tcp``; none: that frame is unknown here.

    Raises:
        PlannerError: ``UNKNOWN_FRAME``.
    """
    base = f"{robot.description.id}_base"
    pose = pose_from_msg(msg)
    if frame in ("", WORLD):
        return pose
    if frame in (base, robot.description.base_link):
        return robot_pose @ pose
    if frame == TCP and start is not None:
        return robot_pose @ robot.fk(start) @ pose
    known = (WORLD, base) if start is None else (WORLD, base, TCP)
    raise PlannerError(f"unknown frame '{frame}'; {one_of(known, frame)}", ErrorCode.UNKNOWN_FRAME)


def scene_from_msg(msg: Any, named: PlanningScene | None, library: ModelLibrary) -> PlanningScene:
    """Build a request's scene.

    Args:
        msg: ``PlanningScene`` message.
        named: The simulated revision that it names; none: it names none.
        library: Where objects that name a model come from.
    """
    scene = named or PlanningScene(robot_pose=optional_pose(msg.robot_pose_in_world))
    scene = scene.without(msg.ignored_objects)
    scene = scene.with_bodies(_body_from_msg(item, library) for item in msg.objects)
    for item in msg.attached:
        links = tuple(item.touch_links)
        if not item.entity:
            scene = scene.holding(Attached(body=_body_from_msg(item.object, library), touch_links=links))
        elif scene.pose_tcp is None:
            raise InvalidRequestError(
                f"attached entity '{item.entity}' needs a scene named by episode_id; give its geometry in 'object'"
            )
        else:
            scene = scene.attach(item.entity, scene.pose_tcp, links)
    opening = _opening(msg)
    scene = scene.with_contacts(_allowed(msg))
    return scene if opening is None else scene.with_opening(opening)


def _allowed(msg: Any) -> tuple[AllowedContact, ...]:
    return tuple(AllowedContact(body_a=item.body_a, body_b=item.body_b) for item in msg.allowed_contacts)


def _opening(msg: Any) -> float | None:
    if len(msg.gripper_opening) > 1:
        raise InvalidRequestError(f"gripper_opening holds one number or none, got {len(msg.gripper_opening)}")
    return float(msg.gripper_opening[0]) if len(msg.gripper_opening) else None


def _body_from_msg(msg: Any, library: ModelLibrary) -> Body:
    shapes: list[BodyShape] = []
    if msg.model:
        modifiers = {item.key: _scalar(msg.name, item) for item in msg.modifiers}
        positions = {item.name: float(item.value) for item in msg.joint_positions}
        entity = EntitySpec(name=msg.name, model=msg.model, modifiers=modifiers, joint_positions=positions)
        shapes += model_shapes(library.entity_model(entity), positions)
    for primitive, pose in _posed(msg, msg.primitives, msg.primitive_poses):
        shapes.append(_primitive(msg.name, primitive, pose))
    for hull, pose in _posed(msg, msg.hulls, msg.hull_poses):
        shapes.append(PointHull(points=_points(hull), pose=pose))
    for mesh, pose in _posed(msg, msg.meshes, msg.mesh_poses):
        corners = tuple(tuple(int(k) for k in triangle.vertex_indices) for triangle in mesh.triangles)
        shapes.append(TriangleMesh(vertices=_points(mesh), triangles=corners, pose=pose))
    return Body(name=msg.name, shapes=tuple(shapes), pose=optional_pose(msg.pose))


def _scalar(name: str, item: Any) -> Any:
    try:
        return json.loads(item.value)
    except ValueError:
        raise InvalidRequestError(
            f"object '{name}': modifier '{item.key}' must be JSON, e.g. '\"red\"' or '1.2', got '{item.value}'"
        ) from None


def _posed(msg: Any, shapes: Sequence[Any], poses: Sequence[Any]) -> list[tuple[Any, Pose]]:
    if len(poses) not in (0, len(shapes)):
        raise InvalidRequestError(f"object '{msg.name}': give one pose per shape, or none at all")
    return list(zip(shapes, [optional_pose(pose) for pose in poses] or [IDENTITY] * len(shapes), strict=True))


def _points(mesh: Any) -> tuple[tuple[float, float, float], ...]:
    return tuple((p.x, p.y, p.z) for p in mesh.vertices)


def _primitive(name: str, primitive: SolidPrimitive, pose: Pose) -> Shape | PointHull:
    size = tuple(float(value) for value in primitive.dimensions)
    if primitive.type == SolidPrimitive.CONE:
        if len(size) != 2 or not all(0.0 < value < 100.0 for value in size):
            raise InvalidRequestError(f"object '{name}': a cone has height and radius between 0 and 100 m, got {size}")
        return PointHull(points=_cone(*size), pose=pose)
    if primitive.type not in _KINDS:
        raise InvalidRequestError(
            f"object '{name}': primitive type must be BOX (1), SPHERE (2), CYLINDER (3) or CONE (4), got "
            f"{primitive.type}; give other shapes as hulls or meshes"
        )
    if primitive.type == SolidPrimitive.CYLINDER and len(size) == 2:
        size = size[1], size[0]  # the message has the height first
    return Shape(kind=_KINDS[primitive.type], size=size, pose=pose)


def _cone(height: float, radius: float, sides: int = 32) -> tuple[tuple[float, float, float], ...]:
    """Return the corners of a pyramid around a cone along z whose origin is in the middle of its height."""
    angles = 2.0 * math.pi * np.arange(sides) / sides
    outside = radius / math.cos(math.pi / sides)
    rim = [(outside * math.cos(a), outside * math.sin(a), -0.5 * height) for a in angles.tolist()]
    return (*rim, (0.0, 0.0, 0.5 * height))


_KINDS = {SolidPrimitive.BOX: "box", SolidPrimitive.SPHERE: "sphere", SolidPrimitive.CYLINDER: "cylinder"}


def options_from_msg(msg: Any) -> MotionOptions:
    """Convert a ``MotionRequest``'s limits; zero means the default."""
    numbers = {
        "velocity_scaling": (msg.max_velocity_scaling_factor, 1.0),
        "acceleration_scaling": (msg.max_acceleration_scaling_factor, 1.0),
        "max_tcp_speed_m_s": (msg.max_tcp_speed, math.inf),
        "max_tcp_rot_speed_rad_s": (msg.max_tcp_rot_speed, math.inf),
    }
    values = {name: default if value == 0.0 else float(value) for name, (value, default) in numbers.items()}
    padding = None if msg.scene.padding == 0.0 else float(msg.scene.padding)
    named = {"planner": msg.planner_id} if msg.planner_id else {}
    upright = _upright(msg.path_constraints)
    return MotionOptions(**values, **named, padding_m=padding, upright=upright, seed=int(msg.seed))


def _upright(msg: Any) -> Upright | None:
    if msg.tilt_tolerance == 0.0:
        return None
    given = {"tool_axis": _vector(msg.tool_axis), "world_axis": _vector(msg.world_axis)}
    axes = {name: axis for name, axis in given.items() if any(axis)}
    return Upright(tolerance_rad=float(msg.tilt_tolerance), **axes)


def _vector(msg: Any) -> tuple[float, float, float]:
    return msg.x, msg.y, msg.z


def _limited(options: MotionOptions, msg: Any) -> MotionOptions:
    """Return options with those limits that a ``MotionStage`` gives."""
    numbers = {
        "velocity_scaling": msg.max_velocity_scaling_factor,
        "acceleration_scaling": msg.max_acceleration_scaling_factor,
        "max_tcp_speed_m_s": msg.max_tcp_speed,
        "max_tcp_rot_speed_rad_s": msg.max_tcp_rot_speed,
    }
    given: dict[str, Any] = {name: float(value) for name, value in numbers.items() if value != 0.0}
    upright = _upright(msg.path_constraints)
    return replace(options, **given, upright=options.upright if upright is None else upright)


def sample_period(msg: Any) -> float:
    """Return a ``MotionRequest``'s sampling period [s].

    Raises:
        InvalidRequestError: When it is out of range.
    """
    period = float(msg.sample_period) or 0.01
    if not 0.001 <= period <= 0.1:
        raise InvalidRequestError(f"sample_period must be 0.001..0.1 s, got {period}")
    return period


@dataclass(frozen=True, kw_only=True)
class Common:
    """What all motion requests have in common, checked and converted."""

    planner: Planner
    """Planner of the robot."""
    scene: PlanningScene
    """What to avoid."""
    start: Array | None
    """Arm joints at the start, shape (dof,) [rad]; none: the request needs none."""
    options: MotionOptions
    """Limits, padding, seed."""
    period_s: float
    """Time between the points of the answer [s]."""
    tcp_poses: bool
    """Whether the answer has the tcp's poses."""

    def target(self, stamped: Any, frame: str) -> Pose:
        """Return a goal of the tcp in the world."""
        return pose_in_world(stamped, frame, self.planner.robot, self.scene.robot_pose, self.start)

    def fields(self) -> dict[str, Any]:
        """Return the fields of every query."""
        start = () if self.start is None else tuple(self.start.tolist())
        robot = self.planner.robot.description.id
        return {"robot": robot, "scene": self.scene, "start": start, "options": self.options}


def start_from_msg(msg: JointState, robot: PlannerRobot, scene: PlanningScene, *, what: str = "start_state") -> Array:
    """Return a request's arm configuration; an empty one is the joint command of the scene's revision.

    Raises:
        InvalidRequestError: When it does not fit the robot, or is empty without a revision.
    """
    if len(msg.position):
        return robot.check_joints(joints_from_msg(msg, robot.description, what=what), what=what)
    if not scene.joint_command:
        raise InvalidRequestError(f"{what} is empty; it may be only when the scene is named by episode_id and seq")
    return robot.check_joints(scene.joint_command, what=what)


def pose_query(common: Common, poses: Sequence[Any], frame: str) -> Query:
    """Return the query of a motion to any of some poses of a frame."""
    return PoseQuery(**common.fields(), targets=tuple(common.target(pose, frame) for pose in poses))


def joints_query(common: Common, target: JointState, named_state: str) -> Query:
    """Return the query of a motion to joint positions or a named state."""
    return JointsQuery(**common.fields(), goal=_joint_goal(common.planner, target, named_state))


def _joint_goal(planner: Planner, target: JointState, named_state: str) -> tuple[float, ...]:
    if len(target.position):
        goal = joints_from_msg(target, planner.robot.description, what="target")
        return tuple(planner.robot.check_joints(goal, what="target").tolist())
    if named_state:
        return tuple(planner.named_state(named_state).tolist())
    raise InvalidRequestError("give a target or a named_state")


def line_query(common: Common, msg: Any) -> Query:
    """Return the query of straight lines; ``msg`` is a request or goal with ``waypoints``."""
    return LineQuery(
        **common.fields(),
        waypoints=tuple(common.target(stamped.pose, stamped.header.frame_id) for stamped in msg.waypoints),
        min_fraction=float(msg.min_fraction) or 1.0,
        ignore_collisions=bool(msg.ignore_collisions),
    )


MAKERS: dict[str, Callable[[Common, Any], Query]] = {
    "plan_to_pose": lambda common, msg: pose_query(
        common, [msg.target.pose, *msg.alternatives], msg.target.header.frame_id
    ),
    "plan_to_joints": lambda common, msg: joints_query(common, msg.target, msg.named_state),
    "plan_cartesian": lambda common, msg: line_query(common, msg),
    "plan_sequence": lambda common, msg: sequence_query(common, msg.stages),
    "retime_path": lambda common, msg: retime_query(common, msg),
    "plan_motion": lambda common, msg: motion_query(common, msg),
}
"""What makes the query of a service's request, or an action's goal, which all have ``request``."""


def common_from_msg(msg: Any, planner: Planner, scene: PlanningScene, *, with_start: bool) -> Common:
    """Check and convert a ``MotionRequest``.

    Args:
        msg: The message.
        planner: Planner of its robot.
        scene: Its scene.
        with_start: Whether it needs a start.
    """
    options, period = options_from_msg(msg), sample_period(msg)
    start = start_from_msg(msg.start_state, planner.robot, scene) if with_start else None
    return Common(
        planner=planner, scene=scene, start=start, options=options, period_s=period, tcp_poses=msg.with_tcp_poses
    )


def query_without_graph(service: str, msg: Any, library: ModelLibrary, robot: str = "panda") -> tuple[Query, Planner]:
    """Return the query of a service's request, and a planner for it, where there is no node.

    Args:
        service: One of `MAKERS`.
        msg: The request.
        library: Where robots and objects come from.
        robot: Robot of a request that names none.

    Raises:
        InvalidRequestError: When the request names a scene that only a running graph has, or is malformed.
    """
    asked = msg.request
    if asked.scene.episode_id:
        raise InvalidRequestError("a scene named by episode_id is in a running graph; give the objects in the request")
    planner = Planner(library.robot(asked.robot or robot))
    scene = scene_from_msg(asked.scene, None, library)
    common = common_from_msg(asked, planner, scene, with_start=service != "retime_path")
    return MAKERS[service](common, msg), planner


def motion_query(common: Common, msg: Any) -> Query:
    """Return the query of a ``PlanMotion`` goal.

    Raises:
        InvalidRequestError: On an unknown kind, or goals in several frames.
    """
    if msg.kind == msg.JOINTS:
        return joints_query(common, msg.joint_target, msg.named_state)
    if msg.kind == msg.CARTESIAN:
        return line_query(common, msg)
    if msg.kind != msg.POSE:
        raise InvalidRequestError(f"kind must be POSE (0), JOINTS (1) or CARTESIAN (2), got {msg.kind}")
    frames = {pose.header.frame_id for pose in msg.waypoints}
    if len(frames) != 1:
        raise InvalidRequestError(f"POSE needs at least one waypoint, all in one frame; got {sorted(frames)}")
    return pose_query(common, [pose.pose for pose in msg.waypoints], frames.pop())


def sequence_query(common: Common, stages: Sequence[Any]) -> Query:
    """Return the query of a sequence of ``MotionStage``."""
    made = tuple(_stage(common, msg, msg.name or str(k)) for k, msg in enumerate(stages, start=1))
    return SequenceQuery(**common.fields(), stages=made)


def _stage(common: Common, msg: Any, name: str) -> Stage:
    kinds = {msg.POSE: "pose", msg.JOINTS: "joints", msg.CARTESIAN: "cartesian"}
    if msg.kind not in kinds:
        raise InvalidRequestError(f"stage '{name}': kind must be POSE (0), JOINTS (1) or CARTESIAN (2), got {msg.kind}")
    kind = kinds[msg.kind]
    joints = _joint_goal(common.planner, msg.joint_target, msg.named_state) if kind == "joints" else ()
    return Stage(
        kind=kind,
        name=name,
        goals=tuple(_stage_goal(common, stamped, bool(msg.relative)) for stamped in msg.goals),
        joints=joints,
        min_fraction=float(msg.min_fraction) or 1.0,
        ignore_collisions=bool(msg.ignore_collisions),
        attach=tuple(msg.attach),
        detach=tuple(msg.detach),
        gripper_opening=_opening(msg),
        allowed=_allowed(msg),
        options=_limited(common.options, msg),
    )


def _stage_goal(common: Common, stamped: Any, relative: bool) -> StageGoal:
    frame = stamped.header.frame_id
    if frame == TCP:
        return StageGoal(pose=optional_pose(stamped.pose), frame=TCP)
    if not relative:
        return StageGoal(pose=common.target(stamped.pose, frame))
    axes = replace(common.target(PoseMsg(), frame), position=(0.0, 0.0, 0.0))  # of the frame, in the world
    q = stamped.pose.orientation
    if not any((q.x, q.y, q.z, q.w)):
        stamped.pose.orientation.w = 1.0
    return StageGoal(pose=axes @ pose_from_msg(stamped.pose) @ axes.inverse(), relative=True)


def retime_query(common: Common, msg: Any) -> Query:
    """Return the query of a ``RetimePath`` request."""
    path = trajectory_from_msg(msg.path, common.planner.robot.description)["positions"]
    return RetimeQuery(
        **common.fields(),
        path=tuple(tuple(row) for row in path.tolist()),
        tolerance_rad=float(msg.path_tolerance) or DEFAULT_TOLERANCE_RAD,
        stop_at_points=bool(msg.stop_at_points),
        check_collisions=bool(msg.check_collisions),
    )


def ik_query(planner: Planner, scene: PlanningScene, msg: Any) -> Query:
    """Return the query of a ``ComputeIK`` request.

    Raises:
        InvalidRequestError: On an unknown mode or a seed state that does not fit the robot.
        PlannerError: ``UNKNOWN_FRAME``.
    """
    modes = {msg.NEAREST: "nearest", msg.ANY: "any", msg.ALL: "all"}
    if msg.mode not in modes:
        raise InvalidRequestError(f"mode must be NEAREST (0), ANY (1) or ALL (2), got {msg.mode}")
    robot = planner.robot
    reference = planner.named_state("home")
    if len(msg.seed_state.position):
        given = joints_from_msg(msg.seed_state, robot.description, what="seed_state")
        reference = robot.check_joints(given, what="seed_state")
    return IkQuery(
        robot=robot.description.id,
        scene=scene,
        start=tuple(reference.tolist()),
        options=MotionOptions(seed=int(msg.seed)),
        target=pose_in_world(msg.target.pose, msg.target.header.frame_id, robot, scene.robot_pose),
        mode=modes[msg.mode],
        count=int(msg.max_solutions) or (0 if msg.mode == msg.ALL else 1),
        avoid_collisions=bool(msg.avoid_collisions),
    )


def fill_answer(response: Any, answer: Answer, common: Common, begun: float) -> None:
    """Put plans into a response that has ``plan`` (and perhaps ``goal_index``), or ``plans`` and ``goal_indices``.

    Args:
        response: Service response or action result.
        answer: What was found.
        common: What was asked.
        begun: When the work began, of ``time.monotonic`` [s].
    """
    robot = common.planner.robot
    plans = [plan_to_msg(plan, robot, common.scene, common.period_s, common.tcp_poses) for plan in answer.plans]
    for plan in plans:
        plan.planning_time = time.monotonic() - begun
    if hasattr(response, "plans"):
        response.plans, response.goal_indices = plans, list(answer.goal_indices)
        return
    response.plan = plans[0]
    if hasattr(response, "goal_index"):
        response.goal_index = answer.goal_indices[0]


def plan_to_msg(plan: Plan, robot: PlannerRobot, scene: PlanningScene, period_s: float, tcp_poses: bool) -> Any:
    """Return a ``MotionPlan`` message."""
    samples = plan.sample(period_s)
    msg = MotionPlanMsg(fraction=plan.fraction, route=plan.route)
    trajectory: JointTrajectory = msg.trajectory
    trajectory.header.frame_id = f"{robot.description.id}_base"
    trajectory.joint_names = list(robot.description.joint_names)
    trajectory.points = [
        JointTrajectoryPoint(
            positions=_numbers(q), velocities=_numbers(v), accelerations=_numbers(a), time_from_start=_duration(t)
        )
        for t, q, v, a in zip(
            samples.times.tolist(), samples.positions, samples.velocities, samples.accelerations, strict=True
        )
    ]
    if tcp_poses:
        poses = robot.tcp_poses(samples.positions)
        msg.tcp_poses = [fill_pose(PoseMsg(), scene.robot_pose @ pose) for pose in poses]
    return msg


def _numbers(row: Array) -> array[float]:
    """Return what a message takes without looking at every number."""
    return array("d", row.tobytes())


def _duration(seconds: float) -> Duration:
    nanoseconds = round(seconds * 1e9)
    return Duration(sec=nanoseconds // 1_000_000_000, nanosec=nanoseconds % 1_000_000_000)


def trajectory_from_msg(msg: JointTrajectory, robot: RobotModel) -> dict[str, Array | None]:
    """Return positions, times, velocities, accelerations of a trajectory; none where it has no such numbers.

    Raises:
        InvalidRequestError: When points differ in what they give, or the joints do not fit the robot.
    """
    if not msg.points:
        raise InvalidRequestError("the trajectory has no point")
    names = list(msg.joint_names) or list(robot.joint_names)
    if sorted(names) != sorted(robot.joint_names):
        raise InvalidRequestError(
            f"the trajectory must name the joints of robot '{robot.id}', {', '.join(robot.joint_names)}; "
            f"got {', '.join(names)}"
        )
    order = [names.index(name) for name in robot.joint_names]
    times = np.array([p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in msg.points])
    return {
        "positions": _matrix([p.positions for p in msg.points], order, "positions", required=True),
        "times": times if times.any() else None,
        "velocities": _matrix([p.velocities for p in msg.points], order, "velocities"),
        "accelerations": _matrix([p.accelerations for p in msg.points], order, "accelerations"),
    }


def _matrix(rows: Sequence[Any], order: list[int], what: str, *, required: bool = False) -> Array | None:
    if not required and not any(len(row) for row in rows):
        return None
    for i, row in enumerate(rows):
        if len(row) != len(order):
            raise InvalidRequestError(f"point {i} of the trajectory has {len(row)} {what}, expected {len(order)}")
    return np.array(rows, dtype=float)[:, order]


def contact_to_msg(contact: ContactPair) -> ContactPairMsg:
    """Return a ``ContactPair`` message."""
    msg = ContactPairMsg(body_a=contact.body_a, body_b=contact.body_b, depth=contact.depth)
    msg.position.x, msg.position.y, msg.position.z = contact.position
    return msg
