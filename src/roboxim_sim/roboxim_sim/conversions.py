"""The world's values as ROS messages, and as serialised ones (``..._cdr``)."""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any
from urllib.parse import parse_qsl, urlsplit

import numpy as np
import numpy.typing as npt
from sensor_msgs.msg import CameraInfo, Image
from simulation_interfaces.msg import EntityState as StandardEntityState

from roboxim_core import limits
from roboxim_core.errors import InvalidRequestError
from roboxim_core.models.description import RobotModel
from roboxim_core.poses import Pose
from roboxim_core.specs import CameraSpec, Scalar, optical_frame
from roboxim_core.state import EntityState, StateRecord
from roboxim_core.vision.renderer import CameraImages
from roboxim_ros.messages.conversions import fill_image, fill_pose, fill_stamp
from roboxim_ros.messages.packing import ENCAPSULATION
from roboxim_ros.messages.serialising import (
    doubles,
    header_message,
    message,
    quaternion_message,
    serialise,
    to_cdr,
    vector_message,
)

ENCODINGS = {"image": "rgb8", "depth": "32FC1", "segmentation": "16UC1"}
"""Message encoding by image kind."""
STAMP, POSE = struct.Struct("<iI"), struct.Struct("<7d")
"""``builtin_interfaces/Time`` and ``geometry_msgs/Transform`` in serialised messages."""
MARK_NS, MARKS = 1_234_567_891_987_654_321, (1e201, 2e202, 3e203, 4e204, 5e205, 6e206, 7e207)
"""A stamp and a pose that occur in no real message, to find the bytes of both in a serialised one."""


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
    """Return the images that exist, by kind."""
    found = {"image": images.rgb, "depth": images.depth, "segmentation": images.segmentation}
    return {kind: array for kind, array in found.items() if array is not None}


def clock_cdr(stamp_ns: int) -> memoryview:
    """Return a serialised ``rosgraph_msgs/Clock``."""
    return memoryview(ENCAPSULATION + STAMP.pack(*divmod(stamp_ns, 1_000_000_000)))


def text_cdr(text: str) -> memoryview:
    """Return a serialised ``std_msgs/String``."""
    return serialise("std_msgs/msg/String", data=text)


@dataclass(frozen=True, slots=True)
class _JointState:
    """A ``sensor_msgs/JointState``."""

    stamp_ns: int
    frame_id: str
    name: tuple[str, ...]
    position: tuple[float, ...]
    velocity: tuple[float, ...]
    effort: tuple[float, ...]


def joint_state_cdr(record: StateRecord, model: RobotModel) -> memoryview:
    """Return the serialised joint states of the arm and the fingers."""
    robot = record.robot
    return to_cdr(
        _JointState(
            stamp_ns=record.stamp_ns,
            frame_id=f"{model.id}_base",
            name=(*robot.joint_names, *model.gripper.joint_names),
            position=(*robot.joint_positions, *robot.finger_positions),
            velocity=(*robot.joint_velocities, *robot.finger_velocities),
            effort=(*robot.joint_efforts, *robot.finger_efforts),
        ),
        "sensor_msgs/msg/JointState",
    )


def tf_cdr(stamp_ns: int, poses_in_world: Mapping[str, Pose]) -> memoryview:
    """Return the serialised transforms from ``world`` to frames, by frame."""
    content, places = _transforms(tuple(poses_in_world))
    found, stamp = bytearray(content), divmod(stamp_ns, 1_000_000_000)
    for (stamp_at, pose_at), pose in zip(places, poses_in_world.values(), strict=True):
        STAMP.pack_into(found, stamp_at, *stamp)
        POSE.pack_into(found, pose_at, *pose.position, *pose.quat_xyzw)
    return memoryview(found)


@lru_cache(maxsize=64)
def _transforms(frames: tuple[str, ...]) -> tuple[bytes, tuple[tuple[int, int], ...]]:
    """Return serialised transforms, and by frame the positions of its stamp and pose, which change at every tick."""
    header = header_message(MARK_NS, "world")
    transform = message(
        "geometry_msgs/msg/Transform", translation=vector_message(MARKS[:3]), rotation=quaternion_message(MARKS[3:])
    )
    transforms = [
        message("geometry_msgs/msg/TransformStamped", header=header, child_frame_id=frame, transform=transform)
        for frame in frames
    ]
    content = bytes(serialise("tf2_msgs/msg/TFMessage", transforms=transforms))
    stamps, poses = _places(content, STAMP.pack(*divmod(MARK_NS, 1_000_000_000))), _places(content, POSE.pack(*MARKS))
    return content, tuple(zip(stamps, poses, strict=True))


def _places(content: bytes, mark: bytes) -> list[int]:
    """Return the position of some bytes in a serialised message."""
    return [found.start() for found in re.finditer(re.escape(mark), content)]


def camera_cdrs(stamp_ns: int, camera: CameraSpec, images: CameraImages) -> dict[str, memoryview]:
    """Return a camera's serialised messages of a tick by the last part of the topic, as `camera_msgs` does."""
    messages = {kind: image_cdr(stamp_ns, camera, array, ENCODINGS[kind]) for kind, array in arrays_of(images).items()}
    return {**messages, "camera_info": camera_info_cdr(stamp_ns, camera)}


def camera_topics(camera: CameraSpec) -> list[str]:
    """Return the topics of a camera's messages, see `camera_msgs`, relative to the graph's namespace."""
    kinds = {"image": True, "depth": camera.depth, "segmentation": camera.segmentation, "camera_info": True}
    return [f"camera/{camera.name}/{kind}" for kind, there in kinds.items() if there]


def image_cdr(stamp_ns: int, camera: CameraSpec, image: npt.NDArray[Any], encoding: str) -> memoryview:
    """Return a camera's serialised image; the array is C-contiguous and of the encoding's type."""
    content, stamp_at = _image_start(camera.name, image.shape[0], image.shape[1], image.strides[0], encoding)
    found = bytearray(content)
    STAMP.pack_into(found, stamp_at, *divmod(stamp_ns, 1_000_000_000))
    found += image.data.cast("B")
    return memoryview(found)


@lru_cache(maxsize=64)
def _image_start(camera: str, height: int, width: int, step: int, encoding: str) -> tuple[bytes, int]:
    """Return a serialised image up to its pixels, and the byte position of its stamp."""
    size = height * step
    whole = serialise(
        "sensor_msgs/msg/Image",
        header=header_message(MARK_NS, optical_frame(camera)),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=step,
        data=np.zeros(size, np.uint8),
    )
    content = bytes(whole[:-size])
    (stamp_at,) = _places(content, STAMP.pack(*divmod(MARK_NS, 1_000_000_000)))
    return content, stamp_at


def camera_info_cdr(stamp_ns: int, camera: CameraSpec) -> memoryview:
    """Return a camera's serialised intrinsics."""
    content, stamp_at = _intrinsics(camera)
    found = bytearray(content)
    STAMP.pack_into(found, stamp_at, *divmod(stamp_ns, 1_000_000_000))
    return memoryview(found)


@lru_cache(maxsize=64)
def _intrinsics(camera: CameraSpec) -> tuple[bytes, int]:
    """Return `camera_info_msg`, serialised, and the position of its stamp, which alone changes at every tick."""
    msg = camera_info_msg(0, camera)
    fields = {name: getattr(msg, name) for name in msg.get_fields_and_field_types() if name != "header"}
    header = header_message(MARK_NS, optical_frame(camera.name))
    content = bytes(serialise("sensor_msgs/msg/CameraInfo", header=header, **{**fields, "d": doubles(msg.d)}))
    (stamp_at,) = _places(content, STAMP.pack(*divmod(MARK_NS, 1_000_000_000)))
    return content, stamp_at


def camera_kind(topic: str) -> Any:
    """Return the message type of a camera's topic, by `camera_msgs`' last part of the topic's name."""
    return CameraInfo if topic.endswith("/camera_info") else Image


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
