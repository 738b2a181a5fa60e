"""The arm's and the gripper's actions: the standard's error codes, tolerances and stamps."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from control_msgs.action import FollowJointTrajectory, GripperCommand
from control_msgs.msg import JointTolerance
from roboxim_interfaces.msg import SceneSpec as SceneSpecMsg
from roboxim_interfaces.srv import GetState, LoadScene
from trajectory_msgs.msg import JointTrajectoryPoint

from roboxim_core.errors import InvalidRequestError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_core.specs import EntitySpec, SceneSpec
from roboxim_ros.actions import ActionCall
from roboxim_ros.clients import Clients
from roboxim_ros.host import NodeHost
from roboxim_ros.messages.conversions import to_msg
from roboxim_ros.runs import free_domain
from roboxim_sim.node import SimNode
from roboxim_sim.tolerances import NO_LIMIT, JointStates, Tolerance, tolerance, violation

Result = FollowJointTrajectory.Result
HOME = np.array(ModelLibrary().robot("panda").home)
NAMES = [f"panda_joint{i}" for i in range(1, 8)]


class Robot:
    """A sim and the two actions."""

    def __init__(self, clients: Clients) -> None:
        self.clients = clients
        self.arm = ActionCall(clients, FollowJointTrajectory, "arm_controller/follow_joint_trajectory")
        self.gripper = ActionCall(clients, GripperCommand, "gripper_controller/gripper_cmd")
        self.feedback: list[Any] = []

    def load(self, *entities: EntitySpec) -> None:
        scene = to_msg(SceneSpec(entities=entities), SceneSpecMsg)
        self.clients.call(LoadScene, "sim/load_scene", LoadScene.Request(scene=scene))

    def follow(self, goal: Any) -> Any:
        self.feedback.clear()
        return self.arm.run(goal, feedback=lambda msg: self.feedback.append(msg.feedback)).result

    def now_s(self) -> float:
        return 1e-9 * self.clients.call(GetState, "sim/get_state", GetState.Request()).state.stamp_ns


@pytest.fixture(scope="module")
def robot() -> Iterator[Robot]:
    with free_domain() as domain, NodeHost(domain_id=domain) as host:
        host.add(lambda context: SimNode(context=context, parameters={"scene": ""}))
        with Clients("test", context=host.context) as clients:
            made = Robot(clients)
            yield made
            made.arm.close()
            made.gripper.close()


def goal(*targets: Any, seconds: float = 1.0, **fields: Any) -> Any:
    """Return a goal through joint positions with equal time steps [s]."""
    msg = FollowJointTrajectory.Goal(**fields)
    msg.trajectory.joint_names = list(NAMES)
    for number, target in enumerate(targets, start=1):
        point = JointTrajectoryPoint(positions=[float(q) for q in target], velocities=[0.0] * 7)
        whole, part = divmod(round(1e9 * number * seconds), 10**9)
        point.time_from_start.sec, point.time_from_start.nanosec = whole, part
        msg.trajectory.points.append(point)
    return msg


def broken(**changes: Any) -> Any:
    msg = goal(HOME)
    for name, value in changes.items():
        setattr(msg.trajectory, name, value)
    return msg


TURNED = HOME + [0.6, 0, 0, 0, 0, 0, 0]


@pytest.mark.ros
def test_each_fault_has_the_standard_error_code(robot: Robot) -> None:
    robot.load()
    unknown = [JointTolerance(name="elbow", position=0.1)]
    for code, said, msg in (
        (Result.INVALID_JOINTS, "must move exactly", broken(joint_names=NAMES[:6])),
        (Result.INVALID_JOINTS, "must move exactly", broken(joint_names=[*NAMES[:6], "elbow"])),
        (Result.INVALID_JOINTS, "names joint 'elbow'", goal(HOME, path_tolerance=unknown)),
        (Result.INVALID_GOAL, "at least one point", broken(points=[])),
        (Result.INVALID_GOAL, "point 0.*2 positions", broken(points=[JointTrajectoryPoint(positions=[0.0, 0.0])])),
        (Result.INVALID_GOAL, "not finite", goal(HOME * np.nan)),
        (Result.INVALID_GOAL, "joint limits", goal(HOME + 9.0)),
        (
            Result.INVALID_GOAL,
            "tolerance of",
            goal(HOME, goal_tolerance=[JointTolerance(name=NAMES[0], position=-2.0)]),
        ),
    ):
        result = robot.follow(msg)
        assert result.error_code == code, (said, result.error_string)
        assert re.search(said, result.error_string), result.error_string
    assert robot.follow(goal(TURNED)).error_code == Result.SUCCESSFUL
    late = goal(HOME)
    late.trajectory.header.stamp.nanosec = 1
    result = robot.follow(late)
    assert result.error_code == Result.OLD_HEADER_TIMESTAMP
    assert "leave the stamp 0" in result.error_string


@pytest.mark.ros
def test_a_stamp_in_the_future_delays_the_start(robot: Robot) -> None:
    robot.load()
    msg = goal(HOME, TURNED)
    begin = robot.now_s() + 0.5
    msg.trajectory.header.stamp.nanosec = round(1e9 * begin)
    assert robot.follow(msg).error_code == Result.SUCCESSFUL
    assert robot.now_s() == pytest.approx(begin + 2.0, abs=0.11)


@pytest.mark.ros
def test_path_and_goal_tolerances_are_enforced(robot: Robot) -> None:
    robot.load()
    tight = [JointTolerance(name=NAMES[0], position=1e-6)]
    result = robot.follow(goal(TURNED, seconds=0.5, path_tolerance=tight))
    assert result.error_code == Result.PATH_TOLERANCE_VIOLATED
    assert NAMES[0] in result.error_string
    stopped = robot.feedback[-1]
    assert abs(stopped.actual.positions[0] - TURNED[0]) > 0.1, "the arm stops where it strayed"
    assert len(stopped.error.velocities) == len(stopped.desired.velocities) == 7
    robot.load()
    result = robot.follow(goal(TURNED, goal_tolerance=tight))
    assert result.error_code == Result.GOAL_TOLERANCE_VIOLATED
    assert robot.now_s() == pytest.approx(1.5, abs=0.11), "half a second is the default time to reach the goal"
    robot.load()
    msg = goal(TURNED, goal_tolerance=tight)
    msg.goal_time_tolerance.sec = 2
    assert robot.follow(msg).error_code == Result.GOAL_TOLERANCE_VIOLATED
    assert robot.now_s() == pytest.approx(3.0, abs=0.11)
    robot.load()
    wide = [JointTolerance(name=name, position=-1.0) for name in NAMES]
    assert robot.follow(goal(TURNED, goal_tolerance=wide)).error_code == Result.SUCCESSFUL
    assert robot.now_s() == pytest.approx(1.0, abs=0.11)


@pytest.mark.ros
def test_an_obstacle_violates_the_goals_tolerance(robot: Robot) -> None:
    robot.load(EntitySpec(name="barrier", model="cabinet", fixed=True, pose=Pose(position=(0.45, 0.35, 0.3))))
    result = robot.follow(goal(HOME + [1.2, 0, 0, 0, 0, 0, 0], seconds=1.5))
    assert result.error_code == Result.GOAL_TOLERANCE_VIOLATED
    assert "something is in the way" in result.error_string


@pytest.mark.ros
def test_the_gripper_reports_a_stall(robot: Robot) -> None:
    robot.load()
    request = GripperCommand.Goal()
    request.command.position = 0.03
    free = robot.gripper.run(request)
    assert free.status == "succeeded"
    assert (free.result.reached_goal, free.result.stalled, free.result.effort) == (True, False, 0.0)
    hand = robot.clients.call(GetState, "sim/get_state", GetState.Request()).state.robot.pose_tcp_measured.position
    cube = EntitySpec(name="cube", model="cube", fixed=True, pose=Pose(position=(hand.x, hand.y, hand.z)))
    robot.load(cube)
    request.command.position = 0.0
    gripped = robot.gripper.run(request)
    assert gripped.status == "succeeded"
    assert (gripped.result.reached_goal, gripped.result.stalled) == (False, True)
    assert gripped.result.effort > 1.0
    assert gripped.result.position == pytest.approx(0.045, abs=0.003)
    request.command.position = float("nan")
    assert robot.gripper.run(request).status == "aborted"


def test_tolerances_are_interpreted_as_in_the_standard() -> None:
    default = Tolerance(position=0.01)
    assert tolerance("j", 0.0, 0.0, 0.0, default) == default
    assert tolerance("j", -1.0, 0.2, -1.0, default) == Tolerance(position=NO_LIMIT, velocity=0.2)
    for values in ((-0.5, 0.0, 0.0), (0.0, float("nan"), 0.0), (0.0, 0.0, 1.0)):
        with pytest.raises(InvalidRequestError):
            tolerance("j", *values, default)
    at, near = JointStates(positions=[0.0], velocities=[0.0]), JointStates(positions=[0.005], velocities=[0.3])
    assert violation({"j": default}, at, near) == ""
    assert "velocity of 'j'" in violation({"j": Tolerance(velocity=0.2)}, at, near)
