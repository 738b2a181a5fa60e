"""The messages that are written without rclpy: byte for byte what rclpy writes, but for its undefined bytes."""

from __future__ import annotations

import zlib

import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from roboxim_interfaces.msg import EpisodeStep as EpisodeStepMsg
from roboxim_interfaces.msg import StateRecord as StateRecordMsg
from sensor_msgs.msg import CameraInfo

from roboxim_core.actions import hold_action
from roboxim_core.episode import EpisodeStep
from roboxim_core.errors import RoboximError
from roboxim_core.poses import Pose
from roboxim_core.specs import CameraSpec, EntitySpec, SceneSpec
from roboxim_core.verdicts import Verdict
from roboxim_core.vision.renderer import CameraImages
from roboxim_recorder.cdr import message_layout
from roboxim_ros.messages.conversions import image_from_msg, to_msg
from roboxim_ros.messages.schemas import message_schema
from roboxim_ros.messages.serialising import to_cdr
from roboxim_sim.conversions import camera_kind, camera_msgs
from roboxim_sim.tick_messages import KINDS, NOTICE, TickMessages
from roboxim_sim.world import World

CAMERAS = (
    CameraSpec(name="eye", width=24, height=16, depth=True, segmentation=True),
    CameraSpec(name="wrist", parent="gripper", width=19, height=17, distortion=(0.1, 0.0, 0.0, 0.0, 0.0)),
)
SCENE = SceneSpec(
    entities=(
        EntitySpec(name="cabinet", model="cabinet", fixed=True, pose=Pose(position=(0.7, 0.3, 0.2))),
        EntitySpec(name="target", model="cube", pose=Pose(position=(0.5, 0.0, 0.03))),
    ),
    cameras=CAMERAS,
)


def images(seed: int) -> dict[str, CameraImages]:
    rng = np.random.default_rng(seed)
    found = {}
    for camera in CAMERAS:
        size = (camera.height, camera.width)
        found[camera.name] = CameraImages(
            rgb=rng.integers(0, 255, (*size, 3), dtype=np.uint8),
            depth=rng.random(size, dtype=np.float32) if camera.depth else None,
            segmentation=rng.integers(0, 9, size, dtype=np.uint16) if camera.segmentation else None,
        )
    return found


def by_rclpy(message) -> bytes:
    """Return the bytes that rclpy writes, without undefined ones."""
    package, _, name = type(message).__module__.partition(".msg")[0], "", type(message).__name__
    layout = message_layout(message_schema(f"{package}/msg/{name}"))
    return bytes(layout.clean(serialize_message(message)).data)


@pytest.fixture(scope="module")
def ticks():
    """The first ticks of an episode: their states and messages."""
    found = []
    with World() as world:
        record = world.load(SCENE, "demo-0-00001-0")
        maker = TickMessages(world.scene, world.robot, world.scene_poses)
        for seq in range(4):
            record = world.tick(seq, hold_action(1.0), episode_id="demo-0-00001-0") if seq else record
            found.append((record, maker.make(record, images(seq))))
    return found


def test_every_message_of_a_tick_is_the_one_of_rclpy(ticks):
    topics = set()
    for _, messages in ticks:
        for topic, cdr in messages.items():
            message = deserialize_message(bytes(cdr), KINDS.get(topic) or camera_kind(topic))
            assert by_rclpy(message) == cdr, topic
            topics.add(topic)
    assert topics > set(KINDS)
    assert sum(topic.startswith("camera/") for topic in topics) == 6


def test_the_messages_hold_the_ticks_values(ticks):
    for record, messages in ticks:
        assert len(record.contacts) > 0
        assert bytes(messages["sim/state"]) == by_rclpy(to_msg(record, StateRecordMsg))
        pictures = images(record.seq)
        crc = {}
        for camera in CAMERAS:
            for kind, message in camera_msgs(record.stamp_ns, camera, pictures[camera.name]).items():
                topic = f"camera/{camera.name}/{kind}"
                assert bytes(messages[topic]) == by_rclpy(message), topic
                crc[topic] = 0 if isinstance(message, CameraInfo) else zlib.crc32(image_from_msg(message))
        notice = deserialize_message(bytes(messages[NOTICE]), KINDS[NOTICE])
        assert notice.topics == [topic for topic in messages if topic != NOTICE]
        assert dict(zip(notice.topics, notice.image_crc32, strict=True)).items() >= crc.items()
        assert all(
            crc32 == 0 for topic, crc32 in zip(notice.topics, notice.image_crc32, strict=True) if topic not in crc
        )
        assert notice.reset == (record.seq == 0)


@pytest.mark.parametrize(
    "step",
    [
        EpisodeStep(episode_id="e", seq=0, stamp_ns=0, phase="start"),
        EpisodeStep(
            episode_id="demo-0-1", seq=70_000, stamp_ns=3_999_999_999, action_label=(0.1, -0.0, 1e-300),
            action_executed=(1.0,), phase="settle", disturbance=True, inference_s=0.25,
            verdict=Verdict(success_ever=True, reason="nicht gehoben: größer", predicates={"lift_m": 0.1, "x": -1.0}),
        ),
    ],
)  # fmt: skip
def test_a_step_is_the_message_of_rclpy(step):
    assert bytes(to_cdr(step, "roboxim_interfaces/msg/EpisodeStep")) == by_rclpy(to_msg(step, EpisodeStepMsg))


def test_a_field_that_cannot_be_written_is_named():
    with pytest.raises(RoboximError, match="field 'modifiers' of roboxim_interfaces/msg/EntitySpec"):
        to_cdr(SCENE.entities[0], "roboxim_interfaces/msg/EntitySpec")
