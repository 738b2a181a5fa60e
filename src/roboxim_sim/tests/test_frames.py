"""Frames and the robot's description, which RViz and Foxglove need besides the tick's messages."""

from __future__ import annotations

import sys
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from queue import Queue
from typing import Any

import pytest
from ament_index_python.packages import get_package_share_directory
from geometry_msgs.msg import Quaternion, TransformStamped, Vector3
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message
from roboxim_interfaces.msg import SceneSpec as SceneSpecMsg
from roboxim_interfaces.srv import LoadScene
from roboxim_interfaces.srv import Tick as TickSrv
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from roboxim_core.actions import hold_action
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_core.specs import CameraSpec, EntitySpec, SceneSpec
from roboxim_ros.clients import Clients
from roboxim_ros.messages.conversions import fill_stamp, stamp_to_ns, to_msg
from roboxim_ros.testing import PATIENCE_S, graph_host  # noqa: F401
from roboxim_sim.conversions import camera_info_cdr, camera_info_msg, tf_cdr
from roboxim_sim.node import SimNode
from roboxim_sim.robot_description import robot_description
from roboxim_sim.tick_messages import TickMessages
from roboxim_sim.world import World

CABINET = EntitySpec(
    name="cabinet", model="cabinet", fixed=True, pose=Pose(position=(0.7, 0.3, 0.2)), joint_positions={"top": 0.1}
)
SCENE = SceneSpec(entities=(CABINET,))


def frames(cdr: memoryview) -> dict[str, tuple[float, float, float]]:
    found = {}
    for transform in deserialize_message(bytes(cdr), TFMessage).transforms:
        position = transform.transform.translation
        found[transform.child_frame_id] = (position.x, position.y, position.z)
    return found


@pytest.mark.parametrize("names", [("tcp",), ("panda_link0", "b", "a long name/with parts"), ()])
def test_transforms_are_serialised_as_rclpy_does(names: tuple[str, ...]) -> None:
    for stamp_ns in (0, 1_234_567_890, 99_999_999_999):
        poses = {
            name: Pose(position=(0.1 * k, -2.0, stamp_ns * 1e-9), quat_xyzw=(0.0, 0.6, 0.0, 0.8))
            for k, name in enumerate(names)
        }
        msg = TFMessage()
        for name, pose in poses.items():
            one = TransformStamped(child_frame_id=name)
            one.header.frame_id = "world"
            fill_stamp(one.header.stamp, stamp_ns)
            x, y, z = pose.position
            one.transform.translation = Vector3(x=x, y=y, z=z)
            x, y, z, w = pose.quat_xyzw
            one.transform.rotation = Quaternion(x=x, y=y, z=z, w=w)
            msg.transforms.append(one)
        assert deserialize_message(bytes(tf_cdr(stamp_ns, poses)), TFMessage) == msg
        camera = CameraSpec(name="wrist" * (1 + len(names)), width=64, height=48)
        found = deserialize_message(bytes(camera_info_cdr(stamp_ns, camera)), CameraInfo)
        assert found == camera_info_msg(stamp_ns, camera)


def test_a_drawers_frame_moves_with_it() -> None:
    with World() as world:
        record = world.load(SCENE)
        messages = TickMessages(world.scene, world.robot, world.scene_poses)
        opened = frames(messages.make(record, {})["tf"])
        assert opened["cabinet"] == opened["cabinet/body"] == record.entity("cabinet").pose.position
        drawers = [f"cabinet/{name}_drawer" for name in record.entity("cabinet").joint_names]
        closed = frames(messages.make(world.set_entity_state("cabinet", joint_positions={"top": 0.0}), {})["tf"])
        moved = {name: abs(opened[name][0] - closed[name][0]) for name in drawers}
        assert sorted(round(distance, 2) for distance in moved.values()) == [0.0] * (len(drawers) - 1) + [0.1]


def test_static_messages_come_with_the_first_tick() -> None:
    with World() as world:
        record = world.load(SCENE)
        messages = TickMessages(world.scene, world.robot, world.scene_poses)
        static = frames(messages.make(record, {})["tf_static"])
        assert static.keys() == {"panda_base", "panda_link0"}
        following = messages.make(world.step(1), {})
        assert not {"tf_static", "robot_description", "sim/markers"} & following.keys()
        assert not static.keys() & frames(following["tf"]).keys()


@pytest.mark.parametrize("robot", ["panda", "ur5"])
def test_viewers_can_resolve_every_mesh_of_the_description(robot: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AMENT_PREFIX_PATH", sys.prefix)
    model = ModelLibrary().robot(robot)
    root = ElementTree.fromstring(robot_description(model.urdf))
    names = [mesh.attrib["filename"] for mesh in root.iter("mesh")]
    assert len(names) > 8
    for name in names:
        package, _, path = name.removeprefix("package://").partition("/")
        assert (Path(get_package_share_directory(package)) / path).is_file(), name
    assert str(Path.home()) not in robot_description(model.urdf), "the text is the same on every machine"


def test_meshes_of_a_users_robot_have_full_paths(tmp_path: Path) -> None:
    urdf = tmp_path / "mine" / "mine.urdf"
    urdf.parent.mkdir()
    urdf.write_text('<robot><mesh filename="package://mine/link.stl"/><mesh scale="1" filename="near.stl"/></robot>')
    text = robot_description(urdf)
    assert f'"file://{tmp_path}/mine/link.stl"' in text
    assert f'"file://{tmp_path}/mine/near.stl"' in text
    urdf.write_text(urdf.read_text().replace("near.stl", "another.stl"))
    assert "another.stl" in robot_description(urdf), "a changed file is read again"


@pytest.mark.ros
@pytest.mark.parametrize("depth", [1, 10])
def test_a_late_subscriber_gets_only_the_newest_state(graph_host: Any, depth: int) -> None:  # noqa: F811
    camera = CameraSpec(
        name="eye", width=16, height=16, pose=Pose(position=(0.5, 0.0, 1.0), quat_xyzw=(1.0, 0.0, 0.0, 0.0))
    )
    graph_host.add(lambda context: SimNode(context=context, namespace=f"/late{depth}", parameters={"scene": ""}))
    with Clients("early", context=graph_host.context, namespace=f"/late{depth}") as clients:
        scene = SceneSpec(cameras=(camera,))
        clients.call(LoadScene, "sim/load_scene", LoadScene.Request(scene=to_msg(scene, SceneSpecMsg), episode_id="e"))
        for seq in range(1, 6):
            action = hold_action(1.0)
            clients.call(TickSrv, "sim/tick", TickSrv.Request(episode_id="e", seq=seq, action=action))
        newest = 5 * scene.tick_ns
        profile = QoSProfile(depth=depth, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        with Clients("late", context=graph_host.context, namespace=f"/late{depth}") as late:
            for topic, kind in (("joint_states", JointState), ("tf", TFMessage), ("camera/eye/image", Image)):
                heard: Queue[Any] = Queue()
                late.node.create_subscription(kind, topic, heard.put, profile)
                late.wake()
                first = heard.get(timeout=20.0)
                header = first.transforms[0].header if hasattr(first, "transforms") else first.header
                assert stamp_to_ns(header.stamp) == newest, topic
            for topic, kind in (("robot_description", String), ("tf_static", TFMessage), ("sim/markers", MarkerArray)):
                heard = Queue()
                late.node.create_subscription(kind, topic, heard.put, profile)
                late.wake()
                heard.get(timeout=20.0)


@pytest.mark.ros
def test_a_sim_that_publishes_what_is_heard_serves_late_subscribers(graph_host: Any) -> None:  # noqa: F811
    """It publishes nothing until somebody listens, then the scene and each tick."""
    parameters = {"scene": "", "publish_unheard": False}
    graph_host.add(lambda context: SimNode(context=context, namespace="/quiet", parameters=parameters))
    scene = SceneSpec()
    profile = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    with Clients("clients", context=graph_host.context, namespace="/quiet") as clients:

        def tick(seq: int) -> None:
            request = TickSrv.Request(episode_id="e", seq=seq, action=hold_action(1.0))
            clients.call(TickSrv, "sim/tick", request)

        clients.call(LoadScene, "sim/load_scene", LoadScene.Request(scene=to_msg(scene, SceneSpecMsg), episode_id="e"))
        tick(1)
        tick(2)
        heard: dict[str, Queue[Any]] = {}
        for topic, kind in (("joint_states", JointState), ("tf_static", TFMessage), ("sim/markers", MarkerArray)):
            heard[topic] = Queue()
            clients.node.create_subscription(kind, topic, heard[topic].put, profile)
        clients.wake()
        seq, deadline = 2, time.monotonic() + PATIENCE_S
        while heard["joint_states"].empty() and time.monotonic() < deadline:  # it looks for listeners now and then
            seq += 1
            tick(seq)
            time.sleep(0.02)
        first = stamp_to_ns(heard["joint_states"].get(timeout=PATIENCE_S).header.stamp) // scene.tick_ns
        assert first > 2
        for queue in (heard["tf_static"], heard["sim/markers"]):
            assert queue.get(timeout=PATIENCE_S)
        tick(seq + 1)
        stamp = first
        while stamp != seq + 1:  # the last one is not lost
            stamp = stamp_to_ns(heard["joint_states"].get(timeout=PATIENCE_S).header.stamp) // scene.tick_ns
        assert heard["tf_static"].empty()
