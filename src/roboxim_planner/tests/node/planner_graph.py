"""A planner node with clients and a stand-in for the sim, and requests to it."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import pytest
from geometry_msgs.msg import Point, PoseStamped
from rclpy.action import ActionClient
from roboxim_interfaces.action import PlanMotion
from roboxim_interfaces.msg import AllowedContact, CollisionObject, MotionStage
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
from shape_msgs.msg import Mesh, SolidPrimitive
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from roboxim_core.config import digest
from roboxim_core.errors import RoboximError
from roboxim_core.poses import IDENTITY, Pose
from roboxim_core.specs import EntitySpec, SceneSpec
from roboxim_core.state import EntityState, RobotState, StateRecord
from roboxim_planner.node import PlannerNode
from roboxim_ros import qos
from roboxim_ros.clients import Clients
from roboxim_ros.host import NodeHost
from roboxim_ros.messages.conversions import fill_pose
from roboxim_ros.testing import PATIENCE_S

HOME = [0.0, -0.2, 0.0, -2.2, 0.0, 2.0, 0.785]
NAMES = [f"panda_joint{i}" for i in range(1, 8)]
SPEC = SceneSpec(entities=(EntitySpec(name="target", model="cube"),))
FOLDED = [0.9, 0.0, -2.2, 0.0, 2.6, 0.8]


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


def trajectory(*rows: list[float]) -> JointTrajectory:
    return JointTrajectory(points=[JointTrajectoryPoint(positions=row) for row in rows])


def result_of(
    clients: Clients, client: ActionClient, goal: PlanMotion.Goal, *, cancel: bool = False
) -> PlanMotion.Result:
    running = threading.Event()
    handle = wait_for(
        clients.in_thread(lambda: client.send_goal_async(goal, feedback_callback=lambda _: running.set()))
    )
    assert handle.accepted
    if cancel:
        assert running.wait(PATIENCE_S)
        clients.in_thread(handle.cancel_goal_async)
    return wait_for(clients.in_thread(handle.get_result_async)).result


def wait_for(future: Any) -> Any:
    done = threading.Event()
    future.add_done_callback(lambda _: done.set())
    assert done.wait(PATIENCE_S)
    return future.result()


def good_requests() -> dict[str, tuple[Any, Any]]:
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
