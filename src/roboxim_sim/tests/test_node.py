"""The sim node, from the view of a client in the graph."""

from __future__ import annotations

import functools
import json
import threading
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from control_msgs.action import FollowJointTrajectory, GripperCommand
from rclpy.action import ActionClient
from roboxim_interfaces.msg import SceneSpec as SceneSpecMsg
from roboxim_interfaces.msg import StateRecord as StateRecordMsg
from roboxim_interfaces.msg import TickNotice
from roboxim_interfaces.srv import LoadScene, ReleaseEpisode, RenderState, RestoreSnapshot, TakeSnapshot, Tick
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, JointState
from simulation_interfaces.action import SimulateSteps
from simulation_interfaces.msg import EntityState, Resource, Result, SimulationState
from simulation_interfaces.srv import (
    DeleteEntity,
    GetEntities,
    GetEntityState,
    GetSimulationState,
    GetSimulatorFeatures,
    ResetSimulation,
    SetEntityState,
    SetSimulationState,
    SpawnEntity,
    StepSimulation,
)
from tf2_msgs.msg import TFMessage
from trajectory_msgs.msg import JointTrajectoryPoint

from roboxim_core import limits
from roboxim_core.config import load_config, named_config
from roboxim_core.errors import ErrorCode, RoboximError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.specs import SceneSpec
from roboxim_core.state import StateRecord
from roboxim_ros import qos
from roboxim_ros.clients import Clients
from roboxim_ros.host import NodeHost
from roboxim_ros.messages.conversions import from_msg, image_from_msg, stamp_to_ns, to_msg
from roboxim_ros.runs import free_domain
from roboxim_ros.testing import PATIENCE_S
from roboxim_sim.node import SimNode
from roboxim_sim.world import World

pytestmark = pytest.mark.ros
SCENE = load_config(named_config("scenes", "three_cubes"), SceneSpec)
SMALL = replace(SCENE, cameras=tuple(replace(camera, width=64, height=48, depth=True) for camera in SCENE.cameras))
HOME = ModelLibrary().robot("panda").home
DOWN = np.array([0.01, 0.0, -0.01, 0.0, 0.0, 0.02, 1.0], np.float32)


class Listener:
    """Collects messages and waits for them."""

    def __init__(self, clients: Clients) -> None:
        self._clients, self._arrived = clients, threading.Condition()
        self.messages: dict[str, list[Any]] = {}

    def listen(self, kind: Any, topic: str) -> None:
        self.messages[topic] = []
        self._clients.node.create_subscription(kind, topic, lambda m: self._take(topic, m), qos.EVENTS)

    def _take(self, topic: str, msg: Any) -> None:
        with self._arrived:
            self.messages[topic].append(msg)
            self._arrived.notify_all()

    def wait(self, topic: str, fits: Callable[[Any], bool]) -> Any:
        with self._arrived:
            found = self._arrived.wait_for(lambda: [m for m in self.messages[topic] if fits(m)], timeout=PATIENCE_S)
        assert found, f"nothing that fits on {topic}"
        return found[-1]


UNDRAWABLE = """name: it
links:
- {mass: 0.1, collision: [{kind: box, size: [0.05, 0.05, 0.05]}],
   visual: [{kind: box, size: [0.05, 0.05, 0.05], material: {texture: none_of_that_name}}]}
"""


@pytest.fixture(scope="module")
def clients(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Clients]:
    folder = tmp_path_factory.mktemp("config")
    (folder / "objects").mkdir()
    (folder / "objects" / "undrawable.yaml").write_text(UNDRAWABLE)
    with free_domain() as domain, NodeHost(domain_id=domain) as host, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROBOXIM_CONFIG_PATH", str(folder))
        host.add(lambda context: SimNode(context=context, parameters={"renderer": "tiny", "scene": ""}))
        with Clients("test", context=host.context) as made:
            yield made


def load(clients: Clients, scene: SceneSpec, episode_id: str = "") -> Any:
    clients.call(ReleaseEpisode, "sim/release_episode", ReleaseEpisode.Request())
    request = LoadScene.Request(episode_id=episode_id, scene=to_msg(scene, SceneSpecMsg))
    return clients.call(LoadScene, "sim/load_scene", request)


def tick(clients: Clients, seq: int, episode_id: str = "e") -> StateRecord:
    answer = clients.call(Tick, "sim/tick", Tick.Request(episode_id=episode_id, seq=seq, action=DOWN))
    return from_msg(answer.state, StateRecord)


@functools.cache
def action_client(clients: Clients, kind: Any, name: str) -> ActionClient:
    """Kept until the node is destroyed: destroying a client while another thread spins its node breaks that thread."""
    return ActionClient(clients.node, kind, name)


def send_goal(clients: Clients, kind: Any, name: str, goal: Any) -> Any:
    """Send a goal and return its result, without cancelling."""
    client = action_client(clients, kind, name)
    done, box = threading.Event(), []

    def accepted(future: Any) -> None:
        future.result().get_result_async().add_done_callback(lambda f: (box.append(f.result()), done.set()))

    assert client.wait_for_server(PATIENCE_S)
    clients.in_thread(lambda: client.send_goal_async(goal)).add_done_callback(accepted)
    assert done.wait(PATIENCE_S)
    return box[0]


def without_cameras() -> SceneSpec:
    return replace(SCENE, cameras=())


def test_ticks_through_the_node_equal_those_of_the_world(clients: Clients) -> None:
    with World() as world:
        expected = world.load(without_cameras(), "e")
        assert from_msg(load(clients, without_cameras(), "e").state, StateRecord) == expected
        for seq in (1, 2, 3):
            assert tick(clients, seq) == world.tick(seq, DOWN)


def test_every_topic_of_a_tick_is_published_and_listed_in_the_notice(clients: Clients) -> None:
    listener = Listener(clients)
    listener.listen(TickNotice, "sim/ticks")
    for kind, topic in ((Clock, "clock"), (JointState, "joint_states"), (TFMessage, "tf")):
        listener.listen(kind, topic)
    for camera in ("workspace", "wrist"):
        listener.listen(Image, f"camera/{camera}/image")
        listener.listen(Image, f"camera/{camera}/depth")
        listener.listen(CameraInfo, f"camera/{camera}/camera_info")
    load(clients, SMALL, "topics")
    record = tick(clients, 1, "topics")
    notice = listener.wait("sim/ticks", lambda m: m.episode_id == "topics" and m.seq == 1)
    assert set(notice.topics) == {"sim/state", *listener.messages} - {"sim/ticks"}
    first = listener.wait("sim/ticks", lambda m: m.episode_id == "topics" and m.seq == 0)
    assert set(first.topics) == {*notice.topics, "tf_static", "robot_description", "sim/markers"}
    crc = dict(zip(notice.topics, notice.image_crc32, strict=True))
    for camera in ("workspace", "wrist"):
        topic = f"camera/{camera}/image"
        image = listener.wait(topic, lambda m, t=topic: zlib.crc32(m.data) == crc[t])
        assert stamp_to_ns(image.header.stamp) == record.stamp_ns
        assert image_from_msg(image).shape == (48, 64, 3)
        assert image_from_msg(image).std() > 5
    joints = listener.wait("joint_states", lambda m: stamp_to_ns(m.header.stamp) == record.stamp_ns)
    assert tuple(joints.position[:7]) == record.robot.joint_positions
    assert tuple(joints.velocity) == (*record.robot.joint_velocities, *record.robot.finger_velocities)
    assert tuple(joints.effort) == (*record.robot.joint_efforts, *record.robot.finger_efforts)
    assert len(joints.velocity) == len(joints.effort) == len(joints.name) == 9
    assert np.isfinite([*joints.position, *joints.velocity, *joints.effort]).all()
    tf = listener.wait("tf", lambda m: stamp_to_ns(m.transforms[0].header.stamp) == record.stamp_ns)
    frames = {t.child_frame_id for t in tf.transforms}
    assert frames >= {"tcp", "panda_hand", "red_cube", "wrist_optical"}
    assert not frames & {"panda_base", "panda_link0", "workspace_optical"}, "what does not move is in tf_static"
    info = listener.wait("camera/wrist/camera_info", lambda m: True)
    assert info.k[0] == pytest.approx(24 / np.tan(1.3090 / 2))


def test_rerendering_a_record_gives_the_same_pixels(clients: Clients) -> None:
    listener = Listener(clients)
    listener.listen(Image, "camera/wrist/image")
    load(clients, SMALL, "again")
    record = tick(clients, 1, "again")
    live = listener.wait("camera/wrist/image", lambda m: stamp_to_ns(m.header.stamp) == record.stamp_ns)
    load(clients, without_cameras(), "else")  # what is simulated now does not matter
    request = RenderState.Request(scene=to_msg(SMALL, SceneSpecMsg), state=to_msg(record, StateRecordMsg))
    answer = clients.call(RenderState, "sim/render_state", request)
    images = {i.camera: i.image for i in answer.images}
    assert np.array_equal(image_from_msg(images["wrist"]), image_from_msg(live))
    assert {i.camera for i in answer.depth} == {camera.name for camera in SMALL.cameras}
    assert all(i.image.encoding == "32FC1" for i in answer.depth)
    assert not answer.segmentation


def test_a_snapshot_can_be_serialised_and_restored(clients: Clients) -> None:
    load(clients, without_cameras(), "e")
    records = [tick(clients, seq) for seq in (1, 2, 3)]
    snapshot = clients.call(TakeSnapshot, "sim/take_snapshot", TakeSnapshot.Request()).snapshot_json
    load(clients, SceneSpec())
    request = RestoreSnapshot.Request(episode_id="e", snapshot_json=snapshot)
    state = clients.call(RestoreSnapshot, "sim/restore_snapshot", request).state
    assert state.state_hash == records[-1].state_hash
    assert tick(clients, 4).seq == 4


def test_a_load_or_restore_that_fails_leaves_the_sim_free(clients: Clients) -> None:
    load(clients, without_cameras(), "e")
    tick(clients, 1)
    snapshot = clients.call(TakeSnapshot, "sim/take_snapshot", TakeSnapshot.Request()).snapshot_json
    unknown = replace(SCENE, cameras=(), entities=(replace(SCENE.entities[0], model="no_such"),))
    request = LoadScene.Request(episode_id="e", scene=to_msg(unknown, SceneSpecMsg))
    with pytest.raises(RoboximError, match="no_such"):
        clients.call(LoadScene, "sim/load_scene", request)
    step = StepSimulation.Request(steps=1)
    answer = clients.call(StepSimulation, "sim/step_simulation", step).result
    assert answer.result == Result.RESULT_OK, "a refused scene leaves the old one, but no lease"

    last = json.loads(snapshot)["record"]["state_hash"]
    request = RestoreSnapshot.Request(episode_id="e", snapshot_json=snapshot.replace(last, last[::-1]))
    with pytest.raises(RoboximError, match="diverged at tick 1"):
        clients.call(RestoreSnapshot, "sim/restore_snapshot", request)
    answer = clients.call(StepSimulation, "sim/step_simulation", step).result
    assert "NO_SCENE" in answer.error_message, "its state has not been published"
    other = LoadScene.Request(episode_id="other", scene=to_msg(without_cameras(), SceneSpecMsg))
    assert clients.call(LoadScene, "sim/load_scene", other).state.episode_id == "other"


def test_a_restarted_holder_takes_over_its_lease(clients: Clients) -> None:
    scene = to_msg(without_cameras(), SceneSpecMsg)
    clients.call(ReleaseEpisode, "sim/release_episode", ReleaseEpisode.Request())  # whatever another test left
    clients.call(LoadScene, "sim/load_scene", LoadScene.Request(episode_id="first", scene=scene, holder="me"))
    for holder in ("", "you"):
        request = LoadScene.Request(episode_id="second", scene=scene, holder=holder)
        with pytest.raises(RoboximError, match="'first' holds the sim"):
            clients.call(LoadScene, "sim/load_scene", request)
    clients.call(LoadScene, "sim/load_scene", LoadScene.Request(episode_id="second", scene=scene, holder="me"))
    assert tick(clients, 1, "second").seq == 1
    load(clients, without_cameras(), "second")
    request = LoadScene.Request(episode_id="third", scene=scene, holder="me")
    with pytest.raises(RoboximError, match="'second' holds the sim"):
        clients.call(LoadScene, "sim/load_scene", request)
    clients.call(ReleaseEpisode, "sim/release_episode", ReleaseEpisode.Request())


def test_the_lease_excludes_other_episodes(clients: Clients) -> None:
    load(clients, without_cameras(), "mine")

    def code(call: Callable[[], Any]) -> ErrorCode:
        with pytest.raises(RoboximError) as caught:
            call()
        return caught.value.code

    assert code(lambda: tick(clients, 1, "yours")) == ErrorCode.LEASE_HELD
    other = LoadScene.Request(episode_id="yours", scene=to_msg(without_cameras(), SceneSpecMsg))
    assert code(lambda: clients.call(LoadScene, "sim/load_scene", other)) == ErrorCode.LEASE_HELD
    other.holder = "evaluator"
    assert code(lambda: clients.call(LoadScene, "sim/load_scene", other)) == ErrorCode.LEASE_HELD
    assert code(lambda: tick(clients, 7, "mine")) == ErrorCode.WRONG_SEQ
    step = clients.call(StepSimulation, "sim/step_simulation", StepSimulation.Request(steps=5)).result
    assert step.result == Result.RESULT_INCORRECT_STATE
    assert "LEASE_HELD" in step.error_message
    goal = FollowJointTrajectory.Goal()
    goal.trajectory.joint_names = [f"panda_joint{i}" for i in range(1, 8)]
    goal.trajectory.points = [_point(HOME, 1)]
    refused = send_goal(clients, FollowJointTrajectory, "arm_controller/follow_joint_trajectory", goal)
    assert "LEASE_HELD" in refused.result.error_string
    assert send_goal(clients, GripperCommand, "gripper_controller/gripper_cmd", GripperCommand.Goal()).status == 6
    assert tick(clients, 1, "mine").seq == 1


def _point(positions: Any, seconds: int) -> JointTrajectoryPoint:
    point = JointTrajectoryPoint(positions=[float(p) for p in positions])
    point.time_from_start.sec = seconds
    return point


def test_trajectory_and_gripper_actions_move_the_robot(clients: Clients) -> None:
    load(clients, without_cameras())
    order = [3, 1, 2, 7, 6, 5, 4]
    target = np.array(HOME) + [0.2, 0.1, -0.1, 0.1, 0.1, -0.1, 0.3]
    goal = FollowJointTrajectory.Goal()
    goal.trajectory.joint_names = [f"panda_joint{i}" for i in order]
    goal.trajectory.points = [_point(target[np.array(order) - 1], 1)]
    answer = send_goal(clients, FollowJointTrajectory, "arm_controller/follow_joint_trajectory", goal)
    assert (answer.status, answer.result.error_code) == (4, 0), answer.result.error_string
    request = GripperCommand.Goal()
    request.command.position = 0.04
    grip = send_goal(clients, GripperCommand, "gripper_controller/gripper_cmd", request).result
    assert grip.reached_goal
    assert grip.position == pytest.approx(0.04, abs=0.003)
    steps = send_goal(clients, SimulateSteps, "sim/simulate_steps", SimulateSteps.Goal(steps=50)).result
    assert steps.result.result == Result.RESULT_OK
    snapshot = clients.call(TakeSnapshot, "sim/take_snapshot", TakeSnapshot.Request()).snapshot_json
    assert f'"joint_commands":[{target[0]:.1f}' in snapshot


def test_a_cancelled_trajectory_stops_where_it_is(clients: Clients) -> None:
    load(clients, without_cameras())
    goal = FollowJointTrajectory.Goal()
    goal.trajectory.joint_names = [f"panda_joint{i}" for i in range(1, 8)]
    goal.trajectory.points = [_point(np.array(HOME) + [1.0, 0, 0, 0, 0, 0, 0], 200)]
    client = action_client(clients, FollowJointTrajectory, "arm_controller/follow_joint_trajectory")
    assert client.wait_for_server(PATIENCE_S)
    done, moving, box = threading.Event(), threading.Event(), []

    def accepted(future: Any) -> None:
        handle = future.result()
        handle.get_result_async().add_done_callback(lambda f: (box.append(f.result()), done.set()))
        threading.Thread(target=lambda: (moving.wait(PATIENCE_S), handle.cancel_goal_async()), daemon=True).start()

    client.send_goal_async(goal, feedback_callback=lambda _: moving.set()).add_done_callback(accepted)
    assert done.wait(PATIENCE_S)
    assert box[0].status == 5
    assert load(clients, without_cameras(), "after").state.seq == 0


def test_long_steps_can_be_stopped_and_too_long_ones_are_refused(clients: Clients) -> None:
    load(clients, without_cameras())
    for steps in (0, 2**64 - 1, limits.STEPS + 1):
        answer = clients.call(StepSimulation, "sim/step_simulation", StepSimulation.Request(steps=steps)).result
        assert (answer.result, "INVALID_REQUEST" in answer.error_message) == (Result.RESULT_OPERATION_FAILED, True)
        if steps:
            goal = send_goal(clients, SimulateSteps, "sim/simulate_steps", SimulateSteps.Goal(steps=steps))
            assert goal.result.result.result == Result.RESULT_OPERATION_FAILED
    before = clients.call(GetEntityState, "sim/get_entity_state", GetEntityState.Request(entity="red_cube")).state
    state = GetSimulationState.Request()
    name = "sim/get_simulation_state"
    assert clients.call(GetSimulationState, name, state).state.state == SimulationState.STATE_PAUSED
    box: list[Any] = []
    request = StepSimulation.Request(steps=limits.STEPS)
    thread = threading.Thread(target=lambda: box.append(clients.call(StepSimulation, "sim/step_simulation", request)))
    thread.start()
    while clients.call(GetSimulationState, name, state).state.state != SimulationState.STATE_PLAYING:
        assert thread.is_alive()
    refused = clients.call(StepSimulation, "sim/step_simulation", StepSimulation.Request(steps=1)).result
    assert "LEASE_HELD" in refused.error_message
    pause = SetSimulationState.Request(state=SimulationState(state=SimulationState.STATE_PAUSED))
    assert clients.call(SetSimulationState, "sim/set_simulation_state", pause).result.result == Result.RESULT_OK
    thread.join(20.0)
    assert "CANCELLED" in box[0].result.error_message
    assert clients.call(GetSimulationState, name, state).state.state == SimulationState.STATE_PAUSED
    after = clients.call(GetEntityState, "sim/get_entity_state", GetEntityState.Request(entity="red_cube")).state
    assert (after.header.stamp.sec, after.header.stamp.nanosec) > (before.header.stamp.sec, before.header.stamp.nanosec)
    request = StepSimulation.Request(steps=1)
    assert clients.call(StepSimulation, "sim/step_simulation", request).result.result == Result.RESULT_OK


def test_simulated_steps_exclude_other_motions_and_can_be_paused(clients: Clients) -> None:
    load(clients, without_cameras())
    box: list[Any] = []
    goal = SimulateSteps.Goal(steps=limits.STEPS)
    thread = threading.Thread(target=lambda: box.append(send_goal(clients, SimulateSteps, "sim/simulate_steps", goal)))
    thread.start()
    playing = GetSimulationState.Request()
    name = "sim/get_simulation_state"
    while clients.call(GetSimulationState, name, playing).state.state != SimulationState.STATE_PLAYING:
        assert thread.is_alive()
    refused = clients.call(StepSimulation, "sim/step_simulation", StepSimulation.Request(steps=1)).result
    assert "LEASE_HELD" in refused.error_message
    pause = SetSimulationState.Request(state=SimulationState(state=SimulationState.STATE_PAUSED))
    assert clients.call(SetSimulationState, "sim/set_simulation_state", pause).result.result == Result.RESULT_OK
    thread.join(PATIENCE_S)
    assert "CANCELLED" in box[0].result.result.error_message


def test_standard_services(clients: Clients) -> None:
    load(clients, without_cameras())
    features = clients.call(GetSimulatorFeatures, "sim/get_simulator_features", GetSimulatorFeatures.Request()).features
    assert '"renderer": "tiny"' in features.custom_info
    assert '"episode_id": ""' in features.custom_info
    other = LoadScene.Request(scene=to_msg(without_cameras(), SceneSpecMsg), renderer="raster")
    assert clients.call(LoadScene, "sim/load_scene", other).renderer.startswith("raster (")
    features = clients.call(GetSimulatorFeatures, "sim/get_simulator_features", GetSimulatorFeatures.Request()).features
    assert '"renderer": "tiny"' in features.custom_info, "the next scene is drawn by the sim's own renderer again"
    spawn = SpawnEntity.Request(name="red_cube", allow_renaming=True)
    spawn.entity_resource = Resource(uri="roboxim://cube?color=orange&scale=1.1")
    position = spawn.initial_pose.pose.position
    position.x, position.y, position.z = 0.4, 0.3, 0.03
    answer = clients.call(SpawnEntity, "sim/spawn_entity", spawn)
    assert (answer.result.result, answer.entity_name) == (Result.RESULT_OK, "red_cube_1")
    spawn.allow_renaming = False
    assert clients.call(SpawnEntity, "sim/spawn_entity", spawn).result.result == SpawnEntity.Response.NAME_NOT_UNIQUE
    spawn.name, spawn.entity_resource.uri = "x", "aple"
    refused = clients.call(SpawnEntity, "sim/spawn_entity", spawn).result
    assert refused.result == SpawnEntity.Response.NO_RESOURCE
    assert "did you mean 'apple'" in refused.error_message
    spawn.entity_namespace = "mine"
    assert clients.call(SpawnEntity, "sim/spawn_entity", spawn).result.result == SpawnEntity.Response.NAMESPACE_INVALID
    spawn.entity_namespace, spawn.entity_resource = "", Resource(resource_string="<robot/>")
    assert clients.call(SpawnEntity, "sim/spawn_entity", spawn).result.result == SpawnEntity.Response.UNSUPPORTED_FORMAT
    spawn.entity_resource.uri = "cube"
    for frame, x, name, code in (
        ("panda_base", 0.4, "x", SpawnEntity.Response.INVALID_POSE),
        ("world", float("nan"), "x", SpawnEntity.Response.INVALID_POSE),
        ("world", 0.4, "table", SpawnEntity.Response.NAME_INVALID),
        ("world", 0.4, "panda_hand", SpawnEntity.Response.NAME_INVALID),
    ):
        spawn.initial_pose.header.frame_id, spawn.name, position.x = frame, name, x
        assert clients.call(SpawnEntity, "sim/spawn_entity", spawn).result.result == code

    names = GetEntities.Request()
    names.filters.filter = "^red"
    assert list(clients.call(GetEntities, "sim/get_entities", names).entities) == ["red_cube", "red_cube_1"]
    state = EntityState()
    state.pose.position.x, state.pose.position.z = 0.55, 0.2
    clients.call(SetEntityState, "sim/set_entity_state", SetEntityState.Request(entity="red_cube", state=state))
    clients.call(StepSimulation, "sim/step_simulation", StepSimulation.Request(steps=240))
    ask = GetEntityState.Request(entity="red_cube")
    pose = clients.call(GetEntityState, "sim/get_entity_state", ask).state.pose
    assert (pose.position.x, pose.position.z) == pytest.approx((0.55, 0.0225), abs=0.02)
    clients.call(DeleteEntity, "sim/delete_entity", DeleteEntity.Request(entity="red_cube"))
    missing = clients.call(GetEntityState, "sim/get_entity_state", ask).result
    assert missing.result == Result.RESULT_NOT_FOUND
    clients.call(ResetSimulation, "sim/reset_simulation", ResetSimulation.Request())
    entities = clients.call(GetEntities, "sim/get_entities", GetEntities.Request()).entities
    assert list(entities) == ["red_cube", "green_cube", "blue_cube"]


def test_an_object_that_cannot_be_drawn_is_not_spawned(clients: Clients) -> None:
    load(clients, SMALL)
    spawn = SpawnEntity.Request(name="new", entity_resource=Resource(uri="undrawable"))
    spawn.initial_pose.pose.position.z = 0.5
    answer = clients.call(SpawnEntity, "sim/spawn_entity", spawn)
    assert "unknown texture 'none_of_that_name'" in answer.result.error_message
    entities = clients.call(GetEntities, "sim/get_entities", GetEntities.Request()).entities
    assert list(entities) == [entity.name for entity in SMALL.entities]
    request = StepSimulation.Request(steps=24)
    assert clients.call(StepSimulation, "sim/step_simulation", request).result.result == Result.RESULT_OK


def test_an_unknown_renderer_leaves_the_sim_free(clients: Clients) -> None:
    request = LoadScene.Request(episode_id="e", scene=to_msg(SMALL, SceneSpecMsg), renderer="rastr")
    clients.call(ReleaseEpisode, "sim/release_episode", ReleaseEpisode.Request())
    with pytest.raises(RoboximError, match="did you mean 'raster'"):
        clients.call(LoadScene, "sim/load_scene", request)
    assert load(clients, without_cameras(), "f").state.episode_id == "f"
