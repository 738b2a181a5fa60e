from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Point, PoseStamped
from rclpy.action import ActionClient
from roboxim_interfaces.action import PlanMotion
from roboxim_interfaces.msg import AllowedContact, AttachedObject, CollisionObject
from roboxim_interfaces.msg import PlanningScene as SceneMsg
from roboxim_interfaces.msg import SceneSpec as SceneSpecMsg
from roboxim_interfaces.msg import StateRecord as StateRecordMsg
from roboxim_interfaces.srv import (
    CheckState,
    CheckTrajectory,
    ComputeFK,
    ComputeIK,
    PlanCartesian,
    PlanToJoints,
    PlanToPose,
)
from sensor_msgs.msg import JointState
from shape_msgs.msg import Mesh, SolidPrimitive

from roboxim_core.errors import ErrorCode, InvalidRequestError, PlannerError, RequestTimeoutError, RoboximError
from roboxim_core.poses import IDENTITY, Pose
from roboxim_core.specs import EntitySpec, SceneSpec
from roboxim_core.state import EntityState, RobotState, StateRecord
from roboxim_planner.node import PlannerNode
from roboxim_ros import qos
from roboxim_ros.clients import Clients
from roboxim_ros.conversions import fill_pose, to_msg
from roboxim_ros.host import NodeHost
from roboxim_ros.runs import free_domain

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
    return StateRecord(episode_id=episode, seq=seq, stamp_ns=0, robot=robot, entities=(cube,))


class Graph:
    """A planner node, clients, and a stand-in for the sim's topics."""

    def __init__(self, host: NodeHost) -> None:
        self.node = host.add(lambda context: PlannerNode(context=context, parameters={"scene_wait_s": 0.3}))
        self.clients = Clients("test_clients", context=host.context)
        self.scenes = self.clients.node.create_publisher(SceneSpecMsg, "sim/scene", qos.LATCHED)
        self.states = self.clients.node.create_publisher(StateRecordMsg, "sim/state", qos.STATE)

    def call(self, kind: Any, name: str, request: Any) -> Any:
        return self.clients.call(kind, f"planner/{name}", request, timeout_s=20.0)

    def refused(self, kind: Any, name: str, request: Any) -> RoboximError:
        with pytest.raises(RoboximError) as caught:
            self.call(kind, name, request)
        return caught.value


@pytest.fixture(scope="module")
def graph() -> Iterator[Graph]:
    with free_domain() as domain, NodeHost(domain_id=domain) as host:
        graph = Graph(host)
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
    assert trajectory.points[1].time_from_start.nanosec == 10_000_000


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
    bad.primitives[0].type = SolidPrimitive.CONE
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
    assert graph.call(CheckState, "check_state", request).valid


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
        assert client.wait_for_server(10.0)
        goal = PlanMotion.Goal(kind=PlanMotion.Goal.POSE, waypoints=[target()])
        goal.request.start_state = JointState(position=HOME)
        assert _result(graph.clients, client, goal).plan.route == "direct"
        goal.kind = 9
        assert _result(graph.clients, client, goal).error_code == ErrorCode.INVALID_REQUEST
        endless = PlanMotion.Goal(kind=PlanMotion.Goal.JOINTS, joint_target=JointState(position=[-1.2, *FOLDED]))
        endless.request.start_state = JointState(position=[1.2, *FOLDED])
        endless.request.scene.objects = divided()
        endless.request.timeout = 30.0
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
        assert running.wait(10.0)
        clients.in_thread(handle.cancel_goal_async)
    return _wait(clients.in_thread(handle.get_result_async)).result


def _wait(future: Any) -> Any:
    done = threading.Event()
    future.add_done_callback(lambda _: done.set())
    assert done.wait(20.0)
    return future.result()


def test_arrays_keep_their_bits(graph: Graph) -> None:
    """Same request, same bytes, through the node."""
    request = to_pose(y=-0.3)
    request.request.scene.objects = [obstacle()]
    rows = [
        np.array([p.positions for p in graph.call(PlanToPose, "plan_to_pose", request).plan.trajectory.points])
        for _ in range(2)
    ]
    assert rows[0].tobytes() == rows[1].tobytes()
