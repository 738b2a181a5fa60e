"""The messages of a tick: published by the sim node, recorded by the cores' graph, recreated by re-rendering."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from roboxim_interfaces.msg import StateRecord as StateRecordMsg
from roboxim_interfaces.msg import TickNotice
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from roboxim_core.models.description import RobotModel
from roboxim_core.models.visuals import ScenePoses
from roboxim_core.poses import Pose
from roboxim_core.specs import SceneSpec, optical_frame
from roboxim_core.state import StateRecord
from roboxim_core.vision.renderer import CameraImages
from roboxim_ros.messages.serialising import to_cdr
from roboxim_sim.conversions import (
    arrays_of,
    camera_cdrs,
    clock_cdr,
    joint_state_cdr,
    text_cdr,
    tf_cdr,
)
from roboxim_sim.robot_description import robot_description
from roboxim_sim.scene_markers import scene_markers_cdr

NOTICE = "sim/ticks"
"""Topic of the notice, which lists the tick's other topics; published last."""
MARKERS = "sim/markers"
"""Topic of the scene's shapes."""
OF_SCENE = ("tf_static", "robot_description", MARKERS)
"""Topics with a message only in tick 0."""
KINDS: Mapping[str, Any] = {
    "clock": Clock,
    "joint_states": JointState,
    "tf": TFMessage,
    "tf_static": TFMessage,
    "robot_description": String,
    MARKERS: MarkerArray,
    "sim/state": StateRecordMsg,
    NOTICE: TickNotice,
}
"""Message types by topic, for the topics that every scene has; cameras add their own."""
OF_STATE = ("clock", "joint_states", "sim/state")
"""Topics of a tick that do not depend on the scene's cameras."""


class TickMessages:
    """Creates the serialised messages of a scene's ticks, by topic. Create another instance when the scene changes.

    Frames that never move (the robot's base, cameras whose parent is ``world``) are in ``tf_static``. The messages of
    `OF_SCENE` come with the first tick that is prepared and with every tick 0.
    """

    def __init__(self, scene: SceneSpec, robot: RobotModel, poses: ScenePoses) -> None:
        """Prepare the parts that all ticks share.

        Args:
            scene: The scene.
            robot: The scene's robot.
            poses: Computes the poses of the scene's bodies and cameras from a state.
        """
        self._scene, self._robot, self._poses = scene, robot, poses
        base = scene.robot.pose
        self._fixed = {f"{robot.id}_base": base, robot.base_link: base}
        self._fixed |= {optical_frame(camera.name): camera.pose for camera in scene.cameras if camera.parent == "world"}
        self._fresh = True

    def prepare(self, record: StateRecord, images: Mapping[str, CameraImages]) -> PreparedTick:
        """Return a tick whose messages can be made later, by any thread.

        Args:
            record: The tick's state.
            images: Images by camera name.
        """
        first, self._fresh = self._fresh or record.seq == 0, False
        return PreparedTick(self, record, images, TickFrames.of(record, self._poses), first=first)

    def make(self, record: StateRecord, images: Mapping[str, CameraImages]) -> Mapping[str, memoryview]:
        """Return all messages of a tick by topic, the notice last; see `prepare`."""
        return self.prepare(record, images).messages()

    def make_seen(self, record: StateRecord, images: Mapping[str, CameraImages]) -> dict[str, memoryview]:
        """Return the messages that depend on the scene's cameras, by topic: frames, images and the notice."""
        tick = self.prepare(record, images)
        messages = self.seen_by(tick)
        messages[NOTICE] = notice_cdr(record, [*OF_STATE, *messages], images)
        return messages

    def all_of(self, tick: PreparedTick) -> dict[str, memoryview]:
        """Return all messages of a tick by topic, the notice last."""
        record = tick.record
        messages = {
            "clock": clock_cdr(record.stamp_ns),
            "joint_states": joint_state_cdr(record, self._robot),
            "sim/state": to_cdr(record, "roboxim_interfaces/msg/StateRecord"),
            **self.seen_by(tick),
        }
        messages[NOTICE] = notice_cdr(record, list(messages), tick.images)
        return messages

    def seen_by(self, tick: PreparedTick) -> dict[str, memoryview]:
        """Return the messages of a tick that depend on the scene's cameras, without the notice."""
        stamp_ns = tick.record.stamp_ns
        messages = {"tf": tf_cdr(stamp_ns, self._moving(tick))}
        if tick.first:
            messages["tf_static"] = tf_cdr(stamp_ns, self._fixed)
            messages["robot_description"] = text_cdr(robot_description(self._robot.urdf))
            messages[MARKERS] = scene_markers_cdr(self._scene, self._poses.library, stamp_ns)
        for camera in self._scene.cameras:
            for kind, message in camera_cdrs(stamp_ns, camera, tick.images[camera.name]).items():
                messages[f"camera/{camera.name}/{kind}"] = message
        return messages

    def _moving(self, tick: PreparedTick) -> dict[str, Pose]:
        """Return the world poses of all moving frames: links, tcp, objects and their links, cameras."""
        frames = dict(tick.frames.links)
        frames["tcp"] = tick.record.robot.pose_tcp_measured
        frames |= {entity.name: entity.pose for entity in tick.record.entities}
        frames |= tick.frames.objects
        frames |= {optical_frame(name): pose for name, pose in tick.frames.cameras.items()}
        return {name: pose for name, pose in frames.items() if name not in self._fixed}


@dataclass(frozen=True, kw_only=True)
class TickFrames:
    """World poses of a tick that are not in its state."""

    links: Mapping[str, Pose]
    """Of the robot's links, by name."""
    objects: Mapping[str, Pose]
    """Of the links of the objects, by `body_key`."""
    cameras: Mapping[str, Pose]
    """Of the cameras' optical frames, by camera name."""

    @staticmethod
    def of(record: StateRecord, poses: ScenePoses) -> TickFrames:
        """Return the poses of a state; call it in the thread of ``poses``."""
        robot = record.robot
        return TickFrames(
            links=poses.link_poses(robot), objects=poses.object_poses(record), cameras=poses.camera_poses(robot)
        )


class PreparedTick:
    """Source of a tick's messages. Made by `TickMessages.prepare`."""

    def __init__(
        self,
        maker: TickMessages,
        record: StateRecord,
        images: Mapping[str, CameraImages],
        frames: TickFrames,
        *,
        first: bool,
    ) -> None:
        """Store the values, which must not change afterwards.

        Args:
            maker: Makes the messages.
            record: The tick's state.
            images: Images by camera name.
            frames: World poses that are not in the state.
            first: Whether the messages of `OF_SCENE` belong to the tick.
        """
        self._maker = maker
        self.record, self.images, self.frames, self.first = record, images, frames, first
        self._messages: dict[str, memoryview] = {}

    def messages(self) -> Mapping[str, memoryview]:
        """Return the serialised messages by topic, the notice last; they are kept. Any thread may call it."""
        if not self._messages:
            self._messages = self._maker.all_of(self)
        return self._messages


def notice_cdr(record: StateRecord, topics: Sequence[str], images: Mapping[str, CameraImages]) -> memoryview:
    """Return the serialised notice of a tick.

    Args:
        record: The tick's state.
        topics: Topics of the tick's other messages; the notice lists images with their checksums.
        images: Images by camera name.
    """
    checksums = {
        f"camera/{name}/{kind}": zlib.crc32(array.data)
        for name, one in images.items()
        for kind, array in arrays_of(one).items()
    }
    notice = _Notice(
        episode_id=record.episode_id,
        seq=record.seq,
        stamp_ns=record.stamp_ns,
        topics=tuple(topics),
        image_crc32=tuple([checksums.get(topic, 0) for topic in topics]),
        reset=record.seq == 0,
    )
    return to_cdr(notice, "roboxim_interfaces/msg/TickNotice")


@dataclass(frozen=True, slots=True)
class _Notice:
    """A ``roboxim_interfaces/TickNotice``."""

    episode_id: str
    seq: int
    stamp_ns: int
    topics: tuple[str, ...]
    image_crc32: tuple[int, ...]
    reset: bool
