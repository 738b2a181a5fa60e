"""Scenes of requests: by revision, attached objects, models, meshes, joints."""

from __future__ import annotations

from dataclasses import replace

import pytest
from diagnostic_msgs.msg import KeyValue
from geometry_msgs.msg import Point
from planner_graph import HOME, SPEC, Graph, state, target
from roboxim_interfaces.msg import AllowedContact, AttachedObject, CollisionObject, NamedValue
from roboxim_interfaces.msg import PlanningScene as SceneMsg
from roboxim_interfaces.msg import SceneSpec as SceneSpecMsg
from roboxim_interfaces.msg import StateRecord as StateRecordMsg
from roboxim_interfaces.srv import CheckState, ComputeFK, ComputeIK, PlanCartesian
from sensor_msgs.msg import JointState
from shape_msgs.msg import Mesh, MeshTriangle, SolidPrimitive

from roboxim_core.config import digest
from roboxim_core.errors import ErrorCode
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_core.specs import RobotSpec, SceneSpec
from roboxim_core.state import EntityState
from roboxim_ros.messages.conversions import fill_pose, to_msg

pytestmark = pytest.mark.ros


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
    request.scene.allowed_contacts[0].body_a = ""
    assert "only body_b may be empty" in str(graph.refused(CheckState, "check_state", request))
    request.scene.allowed_contacts[0].body_a = "target"
    request.robot = "ur5"
    error = graph.refused(CheckState, "check_state", request)
    assert error.code == ErrorCode.INVALID_REQUEST
    assert "the scene's robot is 'panda', the request's 'ur5'" in str(error)
    request.robot = "panda"
    graph.states.publish(to_msg(state("e7", 1), StateRecordMsg))
    request.scene.seq = 1
    assert graph.call(CheckState, "check_state", request).valid
    request.scene.seq = 0
    assert "has episode 'e7', tick 1" in str(graph.refused(CheckState, "check_state", request))
    request.scene.episode_id = "latest"
    error = graph.refused(CheckState, "check_state", request)
    assert error.code == ErrorCode.STALE_SCENE
    assert "sim/get_state" in str(error), "only the sim knows the newest state, and there is none here"


def test_robot_of_a_request_without_one_is_the_scenes(graph: Graph) -> None:
    """The node's default is the Panda; a motion of its joints would take another arm elsewhere."""
    spec = SceneSpec(robot=RobotSpec(model="ur5"))
    ur5 = ModelLibrary().robot("ur5")
    record = state("e9", 0)
    arm = replace(
        record.robot, joint_names=ur5.joint_names, joint_commands=ur5.home, joint_positions=ur5.home,
        joint_velocities=(0.0,) * 6,
    )  # fmt: skip
    record = replace(record, robot=arm, entities=(), scene_hash=digest(spec))
    graph.scenes.publish(to_msg(spec, SceneSpecMsg))
    graph.states.publish(to_msg(record, StateRecordMsg))
    assert graph.call(CheckState, "check_state", CheckState.Request(scene=SceneMsg(episode_id="e9"))).valid


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
