from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import KeyValue
from geometry_msgs.msg import Point, PoseStamped
from rclpy.action import ActionClient
from roboxim_interfaces.action import PlanMotion
from roboxim_interfaces.action import PlanSequence as PlanSequenceAction
from roboxim_interfaces.msg import AllowedContact, AttachedObject, CollisionObject, MotionStage, NamedValue
from roboxim_interfaces.msg import PlanningScene as SceneMsg
from roboxim_interfaces.msg import SceneSpec as SceneSpecMsg
from roboxim_interfaces.msg import StateRecord as StateRecordMsg
from roboxim_interfaces.srv import (
    CheckState,
    CheckTrajectory,
    ComputeFK,
    ComputeIK,
    PlanCartesian,
    PlanSequence,
    PlanToJoints,
    PlanToPose,
    RetimePath,
)
from sensor_msgs.msg import JointState
from shape_msgs.msg import Mesh, MeshTriangle, SolidPrimitive
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from roboxim_core.config import digest
from roboxim_core.errors import ErrorCode, InvalidRequestError, PlannerError, RequestTimeoutError, RoboximError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import IDENTITY, Pose
from roboxim_core.specs import EntitySpec, SceneSpec
from roboxim_core.state import EntityState, RobotState, StateRecord
from roboxim_planner.dumps import list_dumps, read_dump
from roboxim_planner.node import PlannerNode
from roboxim_ros import qos
from roboxim_ros.clients import Clients
from roboxim_ros.conversions import fill_pose, to_msg
from roboxim_ros.host import NodeHost
from roboxim_ros.runs import free_domain
from roboxim_ros.testing import PATIENCE_S

pytestmark = pytest.mark.ros

HOME = [0.0, -0.2, 0.0, -2.2, 0.0, 2.0, 0.785]
NAMES = [f"panda_joint{i}" for i in range(1, 8)]
SPEC = SceneSpec(entities=(EntitySpec(name="target", model="cube"),))


def state(episode: str, seq: int) -> StateRecord:
    robot = RobotState(
        joint_names=tuple(NAMES),
        joint_positions=tuple(HOME),
        joint_velocities=(0.0,) * 7,
        joint_commands=tuple(HOME),
        pose_tcp_measured=Pose(position=(0.5, 0.0, 0.36), quat_xyzw=(1.0, 0.0, 0.0, 0.0)),
        pose_tcp_commanded=IDENTITY,
        gripper_opening=1.0,
        gripper_command=1.0,
    )
    cube = EntityState(name="target", pose=Pose(position=(0.5, 0.2, 0.0225)))
    return StateRecord(episode_id=episode, seq=seq, stamp_ns=0, robot=robot, entities=(cube,), scene_hash=digest(SPEC))


class Graph:
    """A planner node, clients, and a stand-in for the sim's topics."""

    def __init__(self, host: NodeHost, dumps: Path) -> None:
        self.dumps = dumps
        parameters = {"scene_wait_s": 0.3, "dump_dir": str(dumps), "dumps_kept": 5}
        self.node = host.add(lambda context: PlannerNode(context=context, parameters=parameters))
        self.clients = Clients("test_clients", context=host.context)
        self.scenes = self.clients.node.create_publisher(SceneSpecMsg, "sim/scene", qos.LATCHED)
        self.states = self.clients.node.create_publisher(StateRecordMsg, "sim/state", qos.STATE)

    def call(self, kind: Any, name: str, request: Any) -> Any:
        return self.clients.call(kind, f"planner/{name}", request, timeout_s=PATIENCE_S)

    def refused(self, kind: Any, name: str, request: Any) -> RoboximError:
        with pytest.raises(RoboximError) as caught:
            self.call(kind, name, request)
        return caught.value


@pytest.fixture(scope="module")
def graph(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Graph]:
    with free_domain() as domain, NodeHost(domain_id=domain) as host:
        graph = Graph(host, tmp_path_factory.mktemp("dumps"))
        yield graph
        graph.clients.close()


def target(x: float = 0.5, y: float = 0.2, z: float = 0.25, frame: str = "world") -> PoseStamped:
    msg = PoseStamped()
    msg.header.frame_id = frame
    fill_pose(msg.pose, Pose(position=(x, y, z), quat_xyzw=(1.0, 0.0, 0.0, 0.0)))
    return msg


def to_pose(**at: Any) -> PlanToPose.Request:
    request = PlanToPose.Request(target=target(**at))
    request.request.start_state = JointState(position=HOME)
    return request


def obstacle(name: str = "block") -> CollisionObject:
    box = SolidPrimitive(type=SolidPrimitive.BOX, dimensions=[0.1, 0.1, 0.2])
    cylinder = SolidPrimitive(type=SolidPrimitive.CYLINDER, dimensions=[0.3, 0.02])
    hull = Mesh(vertices=[Point(x=x, y=y, z=z) for x in (0.0, 0.05) for y in (0.0, 0.05) for z in (0.0, 0.05)])
    msg = CollisionObject(name=name, primitives=[box, cylinder], hulls=[hull])
    fill_pose(msg.pose, Pose(position=(0.5, 0.0, 0.1)))
    return msg


def test_plan_to_pose_answers_with_a_trajectory(graph: Graph) -> None:
    request = to_pose(y=-0.3)
    request.request.scene.objects = [obstacle()]
    request.request.with_tcp_poses = True
    response = graph.call(PlanToPose, "plan_to_pose", request)
    trajectory = response.plan.trajectory
    assert (list(trajectory.joint_names), trajectory.header.frame_id) == (NAMES, "panda_base")
    assert list(trajectory.points[0].positions) == HOME
    assert (response.goal_index, response.plan.fraction) == (0, 1.0)
    last = response.plan.tcp_poses[-1].position
    assert (last.x, last.y, last.z) == pytest.approx((0.5, -0.3, 0.25), abs=1e-4)
    assert len(response.plan.tcp_poses) == len(trajectory.points)
    times = [p.time_from_start.sec * 1_000_000_000 + p.time_from_start.nanosec for p in trajectory.points]
    assert 10_000_000 in times
    assert max(np.diff(times)) == 10_000_000


def test_frames_base_and_tcp(graph: Graph) -> None:
    base = to_pose(frame="panda_base")
    fill_pose(base.request.scene.robot_pose_in_world, Pose(position=(1.0, 0.0, 0.0)))
    base.request.with_tcp_poses = True
    assert graph.call(PlanToPose, "plan_to_pose", base).plan.tcp_poses[-1].position.x == pytest.approx(1.5, abs=1e-4)
    up = PlanCartesian.Request(waypoints=[target(frame="tcp")])
    fill_pose(up.waypoints[0].pose, Pose(position=(0.0, 0.0, -0.05)))
    up.request.start_state = JointState(position=HOME)
    up.request.with_tcp_poses = True
    poses = graph.call(PlanCartesian, "plan_cartesian", up).plan.tcp_poses
    assert poses[-1].position.z - poses[0].position.z == pytest.approx(0.05, abs=1e-4)
    wrong = graph.refused(PlanToPose, "plan_to_pose", to_pose(frame="wrold"))
    assert wrong.code == ErrorCode.UNKNOWN_FRAME
    assert "did you mean 'world'" in str(wrong)


def test_joints_by_name_in_any_order(graph: Graph) -> None:
    request = PlanToJoints.Request(target=JointState(name=NAMES[::-1], position=[q + 0.1 for q in HOME][::-1]))
    request.request.start_state = JointState(name=[*NAMES, "panda_finger_joint1"], position=[*HOME, 0.04])
    response = graph.call(PlanToJoints, "plan_to_joints", request)
    assert list(response.plan.trajectory.points[-1].positions) == pytest.approx([q + 0.1 for q in HOME])
    request.target, request.named_state = JointState(), "ready"
    assert graph.call(PlanToJoints, "plan_to_joints", request).plan.route == "direct"
    request.named_state = "redy"
    assert "did you mean 'ready'" in str(graph.refused(PlanToJoints, "plan_to_joints", request))


def test_bad_requests_get_their_code_and_words(graph: Graph) -> None:
    cases: list[tuple[PlanToPose.Request, type[RoboximError], ErrorCode, str]] = []

    def case(request: PlanToPose.Request, kind: type[RoboximError], code: ErrorCode, words: str) -> None:
        cases.append((request, kind, code, words))

    nan = to_pose()
    nan.target.pose.position.x = float("nan")
    case(nan, InvalidRequestError, ErrorCode.INVALID_REQUEST, "finite")
    case(to_pose(x=1.6), PlannerError, ErrorCode.GOAL_UNREACHABLE, "mm")
    short, unnamed, none, robot, shape = (to_pose() for _ in range(5))
    short.request.start_state = JointState(position=HOME[:6])
    case(short, InvalidRequestError, ErrorCode.INVALID_REQUEST, "has 7 arm joints, got 6")
    unnamed.request.start_state = JointState(name=["elbow"], position=[0.0])
    case(unnamed, InvalidRequestError, ErrorCode.INVALID_REQUEST, "no joint 'elbow'")
    none.request.start_state = JointState()
    case(none, InvalidRequestError, ErrorCode.INVALID_REQUEST, "empty")
    robot.request.robot = "pandda"
    case(robot, RoboximError, ErrorCode.UNKNOWN_MODEL, "panda")
    bad = obstacle()
    bad.primitives[0].type = SolidPrimitive.PRISM
    shape.request.scene.objects = [bad]
    case(shape, InvalidRequestError, ErrorCode.INVALID_REQUEST, "BOX")
    for field, value, words in (
        ("timeout", -1.0, "timeout"),
        ("sample_period", 5.0, "sample_period"),
        ("max_velocity_scaling_factor", float("nan"), "velocity_scaling"),
    ):
        request = to_pose()
        setattr(request.request, field, value)
        case(request, InvalidRequestError, ErrorCode.INVALID_REQUEST, words)
    hurried = to_pose(y=-0.3)
    hurried.request.timeout = 1e-5
    case(hurried, RequestTimeoutError, ErrorCode.TIMEOUT, "time out after")
    for request, kind, code, words in cases:
        error = graph.refused(PlanToPose, "plan_to_pose", request)
        assert isinstance(error, kind)
        assert error.code == code, error
        assert words in str(error)


def test_scene_by_revision(graph: Graph) -> None:
    request = CheckState.Request(scene=SceneMsg(episode_id="e7", seq=0))
    assert graph.refused(CheckState, "check_state", request).code == ErrorCode.STALE_SCENE
    graph.scenes.publish(to_msg(SPEC, SceneSpecMsg))
    graph.states.publish(to_msg(state("e7", 0), StateRecordMsg))
    assert graph.call(CheckState, "check_state", request).valid
    grasp = graph.call(ComputeIK, "compute_ik", ComputeIK.Request(target=target(0.5, 0.2, 0.0225))).solutions[0]
    request.state = grasp
    request.scene.gripper_opening = [0.2]
    contacts = graph.call(CheckState, "check_state", request).contacts
    assert {"target", "panda_leftfinger"} <= {name for c in contacts for name in (c.body_a, c.body_b)}
    assert contacts[0].depth > 0.01
    request.scene.allowed_contacts = [AllowedContact(body_a="target", body_b="gripper")]
    request.scene.ignored_objects = ["table"]
    assert graph.call(CheckState, "check_state", request).valid
    graph.states.publish(to_msg(state("e7", 1), StateRecordMsg))
    request.scene.seq = 1
    assert graph.call(CheckState, "check_state", request).valid
    request.scene.seq = 0
    assert "has episode 'e7', tick 1" in str(graph.refused(CheckState, "check_state", request))
    request.scene.episode_id = "latest"
    error = graph.refused(CheckState, "check_state", request)
    assert error.code == ErrorCode.STALE_SCENE
    assert "sim/get_state" in str(error), "only the sim knows the newest state, and there is none here"


def test_attached_entity_lifts_with_the_arm(graph: Graph) -> None:
    held = replace(state("e8", 0), entities=(EntityState(name="target", pose=Pose(position=(0.5, 0.0, 0.35))),))
    graph.scenes.publish(to_msg(SPEC, SceneSpecMsg))
    graph.states.publish(to_msg(held, StateRecordMsg))
    request = PlanCartesian.Request(waypoints=[target(0.5, 0.0, 0.02)])
    request.request.scene = SceneMsg(
        episode_id="e8", attached=[AttachedObject(entity="target")], gripper_opening=[0.5625]
    )
    error = graph.refused(PlanCartesian, "plan_cartesian", request)
    assert error.code == ErrorCode.PATH_INCOMPLETE
    assert "target" in str(error)
    client = graph.clients.client(PlanCartesian, "planner/plan_cartesian")
    partial = client.call(request)
    assert partial.error_code == ErrorCode.PATH_INCOMPLETE
    assert 0.5 < partial.plan.fraction < 1.0
    assert len(partial.plan.trajectory.points) > 10


def test_ik_fk_round_trip(graph: Graph) -> None:
    found = graph.call(ComputeIK, "compute_ik", ComputeIK.Request(target=target(), max_solutions=5))
    assert 2 <= len(found.solutions) <= 5
    for solution in found.solutions:
        pose = graph.call(ComputeFK, "compute_fk", ComputeFK.Request(state=solution)).poses[0].pose
        assert (pose.position.x, pose.position.y, pose.position.z) == pytest.approx((0.5, 0.2, 0.25), abs=1e-5)
    links = graph.call(ComputeFK, "compute_fk", ComputeFK.Request(state=found.solutions[0], links=["panda_link1"]))
    assert links.poses[0].pose.position.z == pytest.approx(0.333)
    assert "no link 'hnd'" in str(
        graph.refused(ComputeFK, "compute_fk", ComputeFK.Request(state=found.solutions[0], links=["hnd"]))
    )


def test_check_trajectory_takes_what_was_planned_and_finds_what_is_wrong(graph: Graph) -> None:
    plan = graph.call(PlanToPose, "plan_to_pose", to_pose(y=-0.3)).plan
    request = CheckTrajectory.Request(trajectory=plan.trajectory)
    assert graph.call(CheckTrajectory, "check_trajectory", request).valid
    wall = obstacle()
    fill_pose(wall.pose, Pose(position=(0.5, -0.3, 0.2)))
    request.request.scene.objects = [wall]
    answer = graph.call(CheckTrajectory, "check_trajectory", request)
    assert not answer.valid
    assert 0 < answer.first_invalid_index < len(plan.trajectory.points)
    assert answer.contacts[0].depth > 0.0
    request.trajectory.points[3].positions = [0.0]
    assert "point 3" in str(graph.refused(CheckTrajectory, "check_trajectory", request))


def test_action_plans_and_can_be_cancelled(graph: Graph) -> None:
    client = ActionClient(graph.clients.node, PlanMotion, "planner/plan_motion")
    try:
        assert client.wait_for_server(PATIENCE_S)
        goal = PlanMotion.Goal(kind=PlanMotion.Goal.POSE, waypoints=[target()])
        goal.request.start_state = JointState(position=HOME)
        assert _result(graph.clients, client, goal).plan.route == "direct"
        goal.kind = 9
        assert _result(graph.clients, client, goal).error_code == ErrorCode.INVALID_REQUEST
        endless = PlanMotion.Goal(kind=PlanMotion.Goal.JOINTS, joint_target=JointState(position=[-1.2, *FOLDED]))
        endless.request.start_state = JointState(position=[1.2, *FOLDED])
        endless.request.scene.objects = divided()
        endless.request.timeout = PATIENCE_S
        assert _result(graph.clients, client, endless, cancel=True).error_code == ErrorCode.CANCELLED
    finally:
        client.destroy()


FOLDED = [0.9, 0.0, -2.2, 0.0, 2.6, 0.8]


def divided() -> list[CollisionObject]:
    """Return a wall between left and right that leaves the arm's foot alone."""
    walls = []
    for name, x, z, size in (
        ("front", 1.2, 1.0, [2.0, 0.02, 3.0]),
        ("back", -1.2, 1.0, [2.0, 0.02, 3.0]),
        ("above", 0.0, 1.55, [0.5, 0.02, 2.0]),
    ):
        wall = CollisionObject(name=name, primitives=[SolidPrimitive(type=SolidPrimitive.BOX, dimensions=size)])
        fill_pose(wall.pose, Pose(position=(x, 0.0, z)))
        walls.append(wall)
    return walls


def _result(
    clients: Clients, client: ActionClient, goal: PlanMotion.Goal, *, cancel: bool = False
) -> PlanMotion.Result:
    running = threading.Event()
    handle = _wait(clients.in_thread(lambda: client.send_goal_async(goal, feedback_callback=lambda _: running.set())))
    assert handle.accepted
    if cancel:
        assert running.wait(PATIENCE_S)
        clients.in_thread(handle.cancel_goal_async)
    return _wait(clients.in_thread(handle.get_result_async)).result


def _wait(future: Any) -> Any:
    done = threading.Event()
    future.add_done_callback(lambda _: done.set())
    assert done.wait(PATIENCE_S)
    return future.result()


def stages() -> list[MotionStage]:
    """Approach the cube from above, grasp it, retreat."""
    approach = MotionStage(name="approach", kind=MotionStage.POSE, goals=[target(0.5, 0.2, 0.12)])
    grasp = MotionStage(name="grasp", kind=MotionStage.CARTESIAN, goals=[target(0.0, 0.0, 0.1, frame="tcp")])
    fill_pose(grasp.goals[0].pose, Pose(position=(0.0, 0.0, 0.1)))
    grasp.allowed_contacts = [AllowedContact(body_a="cube", body_b="gripper")]
    up = MotionStage(name="retreat", kind=MotionStage.CARTESIAN, relative=True, attach=["cube"], gripper_opening=[0.5])
    up.goals = [PoseStamped()]
    up.goals[0].header.frame_id = "world"
    up.goals[0].pose.position.z = 0.12
    return [approach, grasp, up]


def cube() -> CollisionObject:
    """Return a cube of the model library a little above the ground."""
    msg = CollisionObject(name="cube", model="cube")
    fill_pose(msg.pose, Pose(position=(0.5, 0.2, 0.03)))
    return msg


def sequence() -> PlanSequence.Request:
    request = PlanSequence.Request(stages=stages())
    request.request.start_state = JointState(position=HOME)
    request.request.scene.objects = [cube()]
    request.request.with_tcp_poses = True
    request.request.timeout = PATIENCE_S
    return request


def test_sequence_grasps_and_lifts(graph: Graph) -> None:
    answer = graph.call(PlanSequence, "plan_sequence", sequence())
    assert list(answer.goal_indices) == [0, -1, -1]
    heights = [plan.tcp_poses[-1].position.z for plan in answer.plans]
    assert heights == pytest.approx([0.12, 0.02, 0.14], abs=1e-4)
    for before, after in zip(answer.plans, answer.plans[1:], strict=False):
        end = np.array(before.trajectory.points[-1].positions)
        assert np.abs(end - np.array(after.trajectory.points[0].positions)).max() < 1e-6
    far = sequence()
    far.stages[0].goals[0].pose.position.x = 1.6
    error = graph.refused(PlanSequence, "plan_sequence", far)
    assert error.code == ErrorCode.GOAL_UNREACHABLE
    assert "stage 'approach' (1 of 3)" in str(error)


def test_sequence_as_an_action_can_be_cancelled(graph: Graph) -> None:
    client = ActionClient(graph.clients.node, PlanSequenceAction, "planner/plan_sequence")
    try:
        assert client.wait_for_server(PATIENCE_S)
        asked = sequence()
        goal = PlanSequenceAction.Goal(request=asked.request, stages=asked.stages)
        assert len(_result(graph.clients, client, goal).plans) == 3
        divide = PlanSequenceAction.Goal()
        divide.request.start_state = JointState(position=[1.2, *FOLDED])
        divide.request.scene.objects = divided()
        divide.request.timeout = PATIENCE_S
        divide.stages = [MotionStage(kind=MotionStage.JOINTS, joint_target=JointState(position=[-1.2, *FOLDED]))]
        assert _result(graph.clients, client, divide, cancel=True).error_code == ErrorCode.CANCELLED
    finally:
        client.destroy()


def trajectory(*rows: list[float]) -> JointTrajectory:
    return JointTrajectory(points=[JointTrajectoryPoint(positions=row) for row in rows])


def test_retime_keeps_the_limits_and_the_path(graph: Graph) -> None:
    rows = [HOME, [q + 0.4 for q in HOME], [HOME[0] + 0.8, *HOME[1:]]]
    request = RetimePath.Request(path=trajectory(*rows), stop_at_points=True)
    request.request.max_velocity_scaling_factor = 0.5
    plan = graph.call(RetimePath, "retime_path", request).plan
    assert plan.route == "retimed"
    points = np.array([p.positions for p in plan.trajectory.points])
    assert [np.abs(points - row).max(axis=1).min() < 1e-2 for row in rows] == [True] * 3
    model = ModelLibrary().robot("panda")
    speeds = np.abs([p.velocities for p in plan.trajectory.points]).max(axis=0)
    assert (speeds <= 0.5 * np.array(model.limits.velocity) * 1.001).all()
    request.stop_at_points = False
    assert graph.call(RetimePath, "retime_path", request).plan.trajectory.points[-1].time_from_start.nanosec
    request.check_collisions = True
    request.request.scene.objects = [obstacle()]
    fill_pose(request.request.scene.objects[0].pose, Pose(position=(0.45, 0.3, 0.3)))
    assert "overlap" in str(graph.refused(RetimePath, "retime_path", request))


def test_ik_any_nearest_all(graph: Graph) -> None:
    def solve(mode: int, most: int = 0) -> list[np.ndarray]:
        request = ComputeIK.Request(target=target(), mode=mode, max_solutions=most)
        return [np.array(s.position) for s in graph.call(ComputeIK, "compute_ik", request).solutions]

    every = solve(ComputeIK.Request.ALL)
    assert len(every) > 5
    away = [float(np.abs(q - HOME).max()) for q in every]
    assert away == sorted(away)
    nearest = solve(ComputeIK.Request.NEAREST)
    assert len(nearest) == 1
    assert np.abs(nearest[0] - HOME).max() == pytest.approx(away[0])
    assert len(solve(ComputeIK.Request.ALL, 3)) == 3
    assert len(solve(ComputeIK.Request.ANY)) == 1
    error = graph.refused(ComputeIK, "compute_ik", ComputeIK.Request(target=target(), mode=7))
    assert "mode must be" in str(error)


def test_objects_by_model_cone_and_mesh(graph: Graph) -> None:
    request = CheckState.Request(state=JointState(position=HOME))
    request.scene.gripper_opening = [0.2]
    at = graph.call(ComputeFK, "compute_fk", ComputeFK.Request(state=request.state)).poses[0].pose
    model, cone, mesh = (CollisionObject(name=name, pose=at) for name in ("by_model", "cone", "mesh"))
    model.model = "cube"
    model.modifiers = [KeyValue(key="color", value='"red"')]
    cone.primitives = [SolidPrimitive(type=SolidPrimitive.CONE, dimensions=[0.1, 0.05])]
    corners = [(-0.1, -0.1, 0.0), (0.1, -0.1, 0.0), (0.1, 0.1, 0.0), (-0.1, 0.1, 0.0)]
    sheet = Mesh(vertices=[Point(x=x, y=y, z=z) for x, y, z in corners])
    sheet.triangles = [MeshTriangle(vertex_indices=[0, 1, 2]), MeshTriangle(vertex_indices=[0, 2, 3])]
    mesh.meshes = [sheet]
    for item in (model, cone, mesh):
        request.scene.objects = [item]
        contacts = graph.call(CheckState, "check_state", request).contacts
        assert {c.body_b for c in contacts} | {c.body_a for c in contacts} >= {item.name, "panda_leftfinger"}, item.name
    model.model = "cbe"
    request.scene.objects = [model]
    assert "did you mean 'cube'" in str(graph.refused(CheckState, "check_state", request))
    model.model, model.modifiers[0].value = "cube", "red"
    assert "must be JSON" in str(graph.refused(CheckState, "check_state", request))


def test_an_open_drawer_is_in_the_way(graph: Graph) -> None:
    request = CheckState.Request(state=JointState(position=HOME))
    cabinet = CollisionObject(name="cabinet", model="cabinet")
    fill_pose(cabinet.pose, Pose(position=(0.27, 0.0, 0.29)))
    request.scene.objects = [cabinet]
    assert graph.call(CheckState, "check_state", request).valid
    cabinet.joint_positions = [NamedValue(name="top", value=0.15)]
    contacts = graph.call(CheckState, "check_state", request).contacts
    assert {"cabinet", "panda_hand"} in [{c.body_a, c.body_b} for c in contacts]
    cabinet.joint_positions[0].name = "tpo"
    assert "did you mean 'top'" in str(graph.refused(CheckState, "check_state", request))


def _requests() -> dict[str, tuple[Any, Any]]:
    """Return a good request to each service that has a start or state and a goal."""
    start = JointState(position=HOME)
    joints, line = PlanToJoints.Request(named_state="ready"), PlanCartesian.Request(waypoints=[target(0.5, 0.0, 0.3)])
    joints.request.start_state = line.request.start_state = start
    return {
        "plan_to_pose": (PlanToPose, to_pose()),
        "plan_to_joints": (PlanToJoints, joints),
        "plan_cartesian": (PlanCartesian, line),
        "plan_sequence": (PlanSequence, sequence()),
        "retime_path": (RetimePath, RetimePath.Request(path=trajectory(HOME, [q + 0.1 for q in HOME]))),
        "compute_ik": (ComputeIK, ComputeIK.Request(target=target(), seed_state=start)),
        "compute_fk": (ComputeFK, ComputeFK.Request(state=start)),
        "check_state": (CheckState, CheckState.Request(state=start)),
        "check_trajectory": (CheckTrajectory, CheckTrajectory.Request(trajectory=trajectory(HOME, HOME))),
    }


def _positions(name: str, request: Any) -> Any:
    """Return the message of a request that holds its joint positions."""
    if name in ("retime_path", "check_trajectory"):
        return (request.path if name == "retime_path" else request.trajectory).points[0]
    if name == "compute_ik":
        return request.seed_state
    return request.state if name in ("compute_fk", "check_state") else request.request.start_state


@pytest.mark.parametrize("name", sorted(_requests()))
def test_every_service_answers_and_refuses_nan_and_a_wrong_joint_count(graph: Graph, name: str) -> None:
    kind, request = _requests()[name]
    graph.call(kind, name, request)
    field = "positions" if hasattr(_positions(name, request), "positions") else "position"
    for values, words in (([float("nan"), *HOME[1:]], "finite"), (HOME[:6], "6")):
        _, request = _requests()[name]
        setattr(_positions(name, request), field, values)
        error = graph.refused(kind, name, request)
        assert error.code == ErrorCode.INVALID_REQUEST
        assert words in str(error)


@pytest.mark.parametrize("name", ["plan_to_pose", "plan_to_joints", "plan_cartesian", "plan_sequence", "retime_path"])
def test_every_planning_service_ends_at_its_deadline(graph: Graph, name: str) -> None:
    kind, request = _requests()[name]
    request.request.timeout = 1e-5
    error = graph.refused(kind, name, request)
    assert error.code == ErrorCode.TIMEOUT
    assert "time out after 1e-05 s in stage" in str(error)


def _impossible() -> dict[str, tuple[Any, Any, ErrorCode, str]]:
    """Return a request to each service that can ask for what cannot be done."""
    asked = _requests()
    beyond = [*HOME[:5], 9.0, HOME[6]]
    asked["plan_to_pose"][1].target.pose.position.x = 2.5
    asked["plan_to_joints"][1].target = JointState(position=beyond)
    asked["plan_cartesian"][1].waypoints[0].pose.position.x = 2.5
    asked["plan_sequence"][1].stages[0].goals[0].pose.position.x = 2.5
    asked["retime_path"][1].path = trajectory(beyond, HOME)
    asked["compute_ik"][1].target.pose.position.x = 2.5
    expected = {
        "plan_to_pose": (ErrorCode.GOAL_UNREACHABLE, "mm and"),
        "plan_to_joints": (ErrorCode.GOAL_UNREACHABLE, "panda_joint6 at 9.0000 rad"),
        "plan_cartesian": (ErrorCode.PATH_INCOMPLETE, "out of reach"),
        "plan_sequence": (ErrorCode.GOAL_UNREACHABLE, "stage 'approach' (1 of 3)"),
        "retime_path": (ErrorCode.TRAJECTORY_INVALID, "point 0 of the path: panda_joint6 at 9.0000 rad"),
        "compute_ik": (ErrorCode.GOAL_UNREACHABLE, "mm and"),
    }
    return {name: (*asked[name], *said) for name, said in expected.items()}


@pytest.mark.parametrize("name", sorted(_impossible()))
def test_what_cannot_be_done_is_refused_with_the_reason(graph: Graph, name: str) -> None:
    kind, request, code, words = _impossible()[name]
    error = graph.refused(kind, name, request)
    assert error.code == code
    assert words in str(error)


def test_an_anytime_planner_takes_the_iterations_it_is_given(graph: Graph) -> None:
    request = PlanToJoints.Request(target=JointState(position=[-1.2, *FOLDED]))
    request.request.start_state = JointState(position=[1.2, *FOLDED])
    request.request.scene.objects = divided()[:1]
    request.request.planner_id, request.request.improve_iterations = "BITstar", 20
    assert graph.call(PlanToJoints, "plan_to_joints", request).plan.trajectory.points
    request.request.improve_iterations, request.request.timeout = 2**31, 0.3
    assert graph.refused(PlanToJoints, "plan_to_joints", request).code == ErrorCode.TIMEOUT


def test_the_wrong_part_of_a_request_is_named(graph: Graph) -> None:
    asked = _requests()
    nan = float("nan")
    pose, line, staged = (asked[name][1] for name in ("plan_to_pose", "plan_cartesian", "plan_sequence"))
    pose.alternatives = [target().pose, target().pose]
    pose.alternatives[1].position.x = nan
    line.waypoints.append(target())
    line.waypoints[1].pose.orientation.x = 2.0
    staged.stages[1].goals[0].pose.position.x = nan
    scene = asked["check_state"][1]
    scene.scene.objects = [cube()]
    scene.scene.objects[0].pose.position.x = nan
    path = asked["retime_path"][1]
    path.path.points[1].positions = [nan, *HOME[1:]]
    for name, request, words in (
        ("plan_to_pose", pose, "target 3 of 3: a pose must be finite"),
        ("plan_cartesian", line, "waypoint 2 of 2: a pose's quaternion must have norm 1"),
        ("plan_sequence", staged, "stage 'grasp': goal: a pose must be finite"),
        ("check_state", scene, "pose of object 'cube': a pose must be finite"),
        ("retime_path", path, "point 1 of the trajectory: positions must be finite"),
    ):
        assert words in str(graph.refused(asked[name][0], name, request))


def test_unknown_frames_are_named(graph: Graph) -> None:
    line = _requests()["plan_cartesian"][1]
    line.waypoints[0].header.frame_id = "tpc"
    ik = ComputeIK.Request(target=target(frame="pana_base"))
    staged = sequence()
    staged.stages[0].goals[0].header.frame_id = "pana_base"
    for kind, name, request, hint in (
        (PlanCartesian, "plan_cartesian", line, "tcp"),
        (ComputeIK, "compute_ik", ik, "panda_base"),
        (PlanSequence, "plan_sequence", staged, "panda_base"),
    ):
        error = graph.refused(kind, name, request)
        assert error.code == ErrorCode.UNKNOWN_FRAME
        assert f"did you mean '{hint}'" in str(error)


def test_tool_stays_upright_and_a_tilted_goal_is_refused(graph: Graph) -> None:
    request = to_pose(x=0.5, y=-0.35, z=0.4)
    request.request.path_constraints.tilt_tolerance = 0.1
    request.request.with_tcp_poses = True
    request.request.scene.objects = [obstacle()]
    start = graph.call(ComputeIK, "compute_ik", ComputeIK.Request(target=target(0.5, 0.35, 0.4))).solutions[0]
    request.request.start_state = start
    for pose in graph.call(PlanToPose, "plan_to_pose", request).plan.tcp_poses:
        q = pose.orientation
        down = 1.0 - 2.0 * (q.x**2 + q.y**2)  # z of the TCP along z of the world
        assert down < -np.cos(0.101)
    fill_pose(request.target.pose, Pose(position=(0.5, -0.3, 0.4), quat_xyzw=(0.7071068, 0.0, 0.7071068, 0.0)))
    error = graph.refused(PlanToPose, "plan_to_pose", request)
    assert error.code == ErrorCode.CONSTRAINT_VIOLATED
    assert "tilted" in str(error)
    request.request.planner_id = "RRTConect"
    assert "did you mean 'RRTConnect'" in str(graph.refused(PlanToPose, "plan_to_pose", request))


def test_a_deadline_of_a_millisecond_ends_in_timeout_and_its_dump_says_the_same(graph: Graph) -> None:
    request = PlanToJoints.Request(target=JointState(position=[-1.2, *FOLDED]))
    request.request.start_state = JointState(position=[1.2, *FOLDED])
    request.request.scene.objects = divided()
    request.request.timeout = 1e-3
    error = graph.refused(PlanToJoints, "plan_to_joints", request)
    assert error.code == ErrorCode.TIMEOUT
    assert "time out after 0.001 s in stage" in str(error)
    dump = read_dump(Path(str(error).partition("; dump: ")[2]))
    again, _ = dump.run_again(ModelLibrary())
    assert (again.error_code, again.error_msg) == (ErrorCode.TIMEOUT, str(error).partition("; dump: ")[0])


def test_failures_leave_dumps_that_run_again_and_their_folder_stays_bounded(graph: Graph) -> None:
    request = to_pose(y=0.22, z=0.03)
    request.request.scene.objects = [cube()]
    for x in (1.5, 1.6, 1.7, 0.5):
        request.target.pose.position.x = x
        for _ in range(2):
            error = graph.refused(PlanToPose, "plan_to_pose", request)
    assert error.code == ErrorCode.GOAL_IN_COLLISION
    dumps = list_dumps(graph.dumps)
    assert len(dumps) == 5
    path = Path(str(error).partition("; dump: ")[2])
    assert path == dumps[0]
    dump = read_dump(path)
    again, _ = dump.run_again(ModelLibrary())
    assert f"{again.error_msg}; dump: {path}" == str(error)
    assert again.error_code == error.code


def test_arrays_keep_their_bits(graph: Graph) -> None:
    """Same request, same bytes, through the node."""
    request = to_pose(y=-0.3)
    request.request.scene.objects = [obstacle()]
    rows = [
        np.array([p.positions for p in graph.call(PlanToPose, "plan_to_pose", request).plan.trajectory.points])
        for _ in range(2)
    ]
    assert rows[0].tobytes() == rows[1].tobytes()
