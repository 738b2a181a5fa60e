"""Values to messages and back."""

from types import SimpleNamespace

import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from roboxim_interfaces.msg import EpisodeResult as EpisodeResultMsg
from roboxim_interfaces.msg import RobotState as RobotStateMsg
from roboxim_interfaces.msg import SceneSpec as SceneSpecMsg
from sensor_msgs.msg import Image

from roboxim_core.actions.semantics import ActionSemantics
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import InvalidRequestError
from roboxim_core.poses import IDENTITY, Pose
from roboxim_core.specs import EntitySpec, SceneSpec
from roboxim_core.state import RobotState
from roboxim_ros.messages.conversions import from_msg, image_from_msg, to_msg

ROBOT = RobotState(
    joint_names=("a", "b"), joint_positions=(0.1, 0.2), joint_velocities=(0.0, -1.0), joint_commands=(0.1, 0.3),
    pose_tcp_measured=IDENTITY, pose_tcp_commanded=Pose(position=(1.0, 2.0, 3.0)), gripper_opening=0.5,
    gripper_command=1.0, finger_positions=(0.01, 0.01), joint_efforts=(5.0, -6.0),
)  # fmt: skip


def sent(message):
    """What the receiver of a message gets."""
    return deserialize_message(serialize_message(message), type(message))


def test_whole_numbers_arrive_where_floats_are_meant():
    """rclpy takes the bytes of an int for those of a float, so 1 would arrive as 5e-324."""
    pose = Pose(position=(1, 2, 3), quat_xyzw=(1, 0, 0, 0))
    scene = SceneSpec(entities=(EntitySpec(name="cube", model="cube", pose=pose),), control_rate_hz=10)
    arrived = from_msg(sent(to_msg(scene, SceneSpecMsg)), SceneSpec)
    assert arrived == scene
    assert arrived.control_rate_hz == 10.0


def test_numbers_of_arrays_are_pythons_own():
    arrived = from_msg(sent(to_msg(ROBOT, RobotStateMsg)), RobotState)
    assert arrived == ROBOT
    assert {type(value) for value in arrived.joint_positions} == {float}


def test_arrays_as_rosbags_gives_them_are_read():
    message = to_msg(ROBOT, RobotStateMsg)
    decoded = SimpleNamespace(**{name: getattr(message, name) for name in message.get_fields_and_field_types()})
    decoded.joint_positions = np.array([0.1, 0.2])
    assert from_msg(decoded, RobotState) == ROBOT


@pytest.mark.parametrize(("encoding", "order"), [("16UC1", "<u2"), ("16UC1", ">u2"), ("32FC1", ">f4"), ("rgb8", "u1")])
def test_images_of_both_byte_orders_are_read(encoding, order):
    image = np.arange(1, 19).reshape((2, 3, 3) if encoding == "rgb8" else (3, 6))
    message = Image(height=image.shape[0], width=image.shape[1], encoding=encoding, is_bigendian=order[0] == ">")
    message.data = image.astype(order).tobytes()
    read = image_from_msg(message)
    assert read.dtype == np.dtype(order).newbyteorder("=")
    assert np.array_equal(read, image)
    assert not read.flags.writeable


@pytest.mark.parametrize(("height", "data"), [(2, bytes(7)), (2, bytes(10)), (2, b""), (0, b""), (2**32 - 1, bytes(8))])
def test_an_image_whose_size_does_not_fit_its_data_is_refused(height, data):
    with pytest.raises(InvalidRequestError, match=f"has {len(data)} bytes" if height else "no pixels"):
        image_from_msg(Image(height=height, width=2, encoding="16UC1", data=data))


def test_a_message_of_an_older_version_takes_the_defaults_of_new_fields():
    result = EpisodeResult(episode_id="e", index=1, attempt=0, outcome="success", timing="real_time", held=3)
    message = to_msg(result, EpisodeResultMsg)
    fields = {name: getattr(message, name) for name in message.get_fields_and_field_types()}
    assert from_msg(SimpleNamespace(**fields), EpisodeResult) == result
    for name in ("timing", "held", "delay_ticks"):
        del fields[name]
    older = from_msg(SimpleNamespace(**fields), EpisodeResult)
    assert (older.timing, older.held, older.outcome) == ("lockstep", 0, "success")
    del fields["episode_id"]
    with pytest.raises(AttributeError, match="episode_id"):
        from_msg(SimpleNamespace(**fields), EpisodeResult)


def test_a_message_with_incomplete_action_semantics_is_refused():
    fields = vars(ActionSemantics()).copy()
    assert from_msg(SimpleNamespace(**fields), ActionSemantics) == ActionSemantics()
    del fields["gripper"]
    with pytest.raises(AttributeError, match="gripper"):
        from_msg(SimpleNamespace(**fields), ActionSemantics)
