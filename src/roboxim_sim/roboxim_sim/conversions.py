"""The world's values as ROS messages, and as serialised ones (``..._cdr``)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any
from urllib.parse import parse_qsl, urlsplit

import numpy.typing as npt
from sensor_msgs.msg import CameraInfo, Image
from simulation_interfaces.msg import EntityState as StandardEntityState

from roboxim_core import limits
from roboxim_core.errors import InvalidRequestError
from roboxim_core.models.description import RobotModel
from roboxim_core.poses import Pose
from roboxim_core.rendering import CameraImages
from roboxim_core.specs import CameraSpec, Scalar
from roboxim_core.state import EntityState, StateRecord
from roboxim_ros.cdr_writer import CdrWriter
from roboxim_ros.conversions import fill_image, fill_pose, fill_stamp

ENCODINGS = {"image": "rgb8", "depth": "32FC1", "segmentation": "16UC1"}
"""Message encoding by image kind."""


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
    for kind, array in arrays_of(images).items():
        msg = fill_image(Image(), array, ENCODINGS[kind])
        fill_stamp(msg.header.stamp, stamp_ns)
        msg.header.frame_id = optical_frame(camera.name)
        messages[kind] = msg
    return {**messages, "camera_info": camera_info_msg(stamp_ns, camera)}


def arrays_of(images: CameraImages) -> dict[str, npt.NDArray[Any]]:
    """Return the images that there are, by kind."""
    found = {"image": images.rgb, "depth": images.depth, "segmentation": images.segmentation}
    return {kind: array for kind, array in found.items() if array is not None}


def clock_cdr(stamp_ns: int) -> bytearray:
    """Return a serialised ``rosgraph_msgs/Clock``."""
    writer = CdrWriter()
    writer.time(stamp_ns)
    return writer.data


def text_cdr(text: str) -> bytearray:
    """Return a serialised ``std_msgs/String``."""
    writer = CdrWriter()
    writer.text(text)
    return writer.data


def joint_state_cdr(record: StateRecord, model: RobotModel) -> bytearray:
    """Return the serialised joint states of the arm and the fingers."""
    robot, writer = record.robot, CdrWriter()
    writer.header(record.stamp_ns, f"{model.id}_base")
    writer.texts((*robot.joint_names, *model.gripper.joint_names))
    writer.doubles((*robot.joint_positions, *robot.finger_positions))
    writer.doubles((*robot.joint_velocities, *robot.finger_velocities))
    writer.doubles((*robot.joint_efforts, *robot.finger_efforts))
    return writer.data


def tf_cdr(stamp_ns: int, poses_in_world: Mapping[str, Pose]) -> bytearray:
    """Return the serialised transforms from ``world`` to frames, by frame."""
    writer = CdrWriter()
    writer.uint32(len(poses_in_world))
    for frame, pose in poses_in_world.items():
        writer.header(stamp_ns, "world")
        writer.text(frame)
        writer.pose(pose)
    return writer.data


def camera_cdrs(stamp_ns: int, camera: CameraSpec, images: CameraImages) -> dict[str, bytearray]:
    """Return a camera's serialised messages of a tick by the last part of the topic, as `camera_msgs` does."""
    messages = {kind: image_cdr(stamp_ns, camera, array, ENCODINGS[kind]) for kind, array in arrays_of(images).items()}
    return {**messages, "camera_info": camera_info_cdr(stamp_ns, camera)}


def image_cdr(stamp_ns: int, camera: CameraSpec, image: npt.NDArray[Any], encoding: str) -> bytearray:
    """Return a camera's serialised image; the array is C-contiguous and of the encoding's type."""
    writer = CdrWriter()
    writer.header(stamp_ns, optical_frame(camera.name))
    writer.uint32(image.shape[0])
    writer.uint32(image.shape[1])
    writer.text(encoding)
    writer.data.append(0)  # is_bigendian
    writer.uint32(image.strides[0])
    writer.elements(image, 1, image.nbytes)
    return writer.data


def camera_info_cdr(stamp_ns: int, camera: CameraSpec) -> bytearray:
    """Return a camera's serialised intrinsics."""
    data = bytearray(_camera_info_at_start(camera))
    data[4:12] = clock_cdr(stamp_ns)[4:]  # a message that begins with a header begins with its stamp
    return data


@lru_cache(maxsize=64)
def _camera_info_at_start(camera: CameraSpec) -> bytes:
    msg, writer = camera_info_msg(0, camera), CdrWriter()
    writer.header(0, msg.header.frame_id)
    writer.uint32(msg.height)
    writer.uint32(msg.width)
    writer.text(msg.distortion_model)
    writer.doubles(msg.d.tolist())
    for matrix in (msg.k, msg.r, msg.p):
        writer.double_array(matrix.tolist())
    binning_and_region_of_interest = (0,) * 6
    for number in binning_and_region_of_interest:
        writer.uint32(number)
    writer.data.append(0)  # do_rectify
    return bytes(writer.data)


def camera_kind(topic: str) -> Any:
    """Return the message type of a camera's topic, by `camera_msgs`' last part of the topic's name."""
    return CameraInfo if topic.endswith("/camera_info") else Image


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
