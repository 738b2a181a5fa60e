"""The world's values as ROS messages."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from geometry_msgs.msg import TransformStamped
from sensor_msgs.msg import CameraInfo, Image, JointState
from simulation_interfaces.msg import EntityState as StandardEntityState
from tf2_msgs.msg import TFMessage

from roboxim_core import limits
from roboxim_core.errors import InvalidRequestError
from roboxim_core.models.description import RobotModel
from roboxim_core.poses import Pose
from roboxim_core.rendering import CameraImages
from roboxim_core.specs import CameraSpec, Scalar
from roboxim_core.state import EntityState, StateRecord
from roboxim_ros.conversions import fill_image, fill_pose, fill_stamp

ENCODINGS = {"image": "rgb8", "depth": "32FC1", "segmentation": "16UC1"}
"""Message encoding by image kind."""


def joint_state_msg(record: StateRecord, model: RobotModel) -> JointState:
    """Return the joint states of the arm and the fingers."""
    robot = record.robot
    msg = JointState()
    fill_stamp(msg.header.stamp, record.stamp_ns)
    msg.header.frame_id = f"{model.id}_base"
    msg.name = [*robot.joint_names, *model.gripper.joint_names]
    msg.position = [*robot.joint_positions, *robot.finger_positions]
    msg.velocity = [*robot.joint_velocities, *robot.finger_velocities]
    msg.effort = [*robot.joint_efforts, *robot.finger_efforts]
    return msg


class TfMessage:
    """Transforms from ``world`` to frames; the message is reused as long as the frames' names stay the same."""

    def __init__(self) -> None:
        """Make it empty."""
        self._msg = TFMessage()
        self._by_frame: dict[str, TransformStamped] = {}

    def filled(self, stamp_ns: int, poses_in_world: Mapping[str, Pose]) -> TFMessage:
        """Return the message filled with a stamp [ns] and the frames' poses; every call returns the same object."""
        if self._by_frame.keys() != poses_in_world.keys():
            self._by_frame = {frame: TransformStamped(child_frame_id=frame) for frame in poses_in_world}
            for transform in self._by_frame.values():
                transform.header.frame_id = "world"
            self._msg.transforms = list(self._by_frame.values())
        for frame, pose in poses_in_world.items():
            transform = self._by_frame[frame]
            fill_stamp(transform.header.stamp, stamp_ns)
            t, q = transform.transform.translation, transform.transform.rotation
            t.x, t.y, t.z = map(float, pose.position)
            q.x, q.y, q.z, q.w = map(float, pose.quat_xyzw)
        return self._msg


def camera_info_msg(stamp_ns: int, camera: CameraSpec) -> CameraInfo:
    """Return a camera's intrinsics; pixel centres have integer coordinates."""
    fx, fy, cx, cy = camera.matrix
    distortion = list(camera.distortion) or [0.0] * 5
    msg = CameraInfo(height=camera.height, width=camera.width, distortion_model="plumb_bob", d=distortion)
    fill_stamp(msg.header.stamp, stamp_ns)
    msg.header.frame_id = optical_frame(camera.name)
    msg.k = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    msg.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    msg.p = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    return msg


def camera_msgs(stamp_ns: int, camera: CameraSpec, images: CameraImages) -> dict[str, Any]:
    """Return a camera's messages of a tick by the last part of the topic: image, depth, ..., camera_info."""
    messages: dict[str, Any] = {}
    for kind, array in (("image", images.rgb), ("depth", images.depth), ("segmentation", images.segmentation)):
        if array is not None:
            msg = fill_image(Image(), array, ENCODINGS[kind])
            fill_stamp(msg.header.stamp, stamp_ns)
            msg.header.frame_id = optical_frame(camera.name)
            messages[kind] = msg
    return {**messages, "camera_info": camera_info_msg(stamp_ns, camera)}


def optical_frame(camera: str) -> str:
    """Return the name of a camera's optical frame, the frame of its images."""
    return f"{camera}_optical"


def entity_state_msg(stamp_ns: int, entity: EntityState) -> StandardEntityState:
    """Return an entity's state as a `simulation_interfaces` message."""
    msg = StandardEntityState()
    fill_stamp(msg.header.stamp, stamp_ns)
    msg.header.frame_id = "world"
    fill_pose(msg.pose, entity.pose)
    twist = msg.twist
    twist.linear.x, twist.linear.y, twist.linear.z = entity.linear_velocity
    twist.angular.x, twist.angular.y, twist.angular.z = entity.angular_velocity
    return msg


def model_of_uri(uri: str) -> tuple[str, dict[str, Scalar]]:
    """Return the model and the modifiers of a resource: ``cube`` or ``roboxim://cube?color=red&scale=1.2``.

    Raises:
        InvalidRequestError: When the URI has another scheme or names no model.
    """
    try:
        parts = urlsplit(uri if "://" in uri else f"roboxim://{uri}")
    except ValueError as error:
        raise InvalidRequestError(f"resource {limits.echo(uri)} is no URI: {error}") from None
    model = parts.netloc + parts.path
    if parts.scheme != "roboxim" or not model:
        raise InvalidRequestError(f"resource '{uri}' names no model; expected e.g. cube or roboxim://cube?color=red")
    return model, {key: _scalar(value) for key, value in parse_qsl(parts.query)}


def vector(msg: Any) -> tuple[float, float, float]:
    """Return x, y and z of a message."""
    return msg.x, msg.y, msg.z


def _scalar(text: str) -> Scalar:
    try:
        return float(text)
    except ValueError:
        return text
