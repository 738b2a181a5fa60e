"""The messages of a tick: published by the sim node, recorded by the cores' graph, recreated by re-rendering."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from typing import Any

from roboxim_interfaces.msg import StateRecord as StateRecordMsg
from roboxim_interfaces.msg import TickNotice
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from roboxim_core.models.description import RobotModel
from roboxim_core.models.visuals import ScenePoses
from roboxim_core.poses import Pose
from roboxim_core.rendering import CameraImages
from roboxim_core.specs import SceneSpec
from roboxim_core.state import StateRecord
from roboxim_ros.conversions import fill_stamp, to_msg
from roboxim_sim.conversions import TfMessage, camera_msgs, joint_state_msg, optical_frame
from roboxim_sim.robot_description import robot_description
from roboxim_sim.scene_markers import scene_markers

NOTICE = "sim/ticks"
"""Topic of the notice, which lists the tick's other topics; published last."""
MARKERS = "sim/markers"
"""Topic of the scene's shapes."""
OF_SCENE = ("tf_static", "robot_description", MARKERS)
"""Topics with a message in tick 0 alone."""
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
    """Creates the messages of a scene's ticks, by topic. Create another instance when the scene changes.

    Non-obvious: the message of ``tf`` is the same object in every tick, because it consists of a hundred others.
    Serialise it before making the next tick.

    Frames that never move (the robot's base, cameras whose parent is ``world``) are in ``tf_static``. The messages of
    `OF_SCENE` come with the first tick that is made and with every tick 0.
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
        self._tf = TfMessage()

    def make(self, record: StateRecord, images: Mapping[str, CameraImages]) -> dict[str, Any]:
        """Return all messages of a tick by topic, the notice last.

        Args:
            record: The tick's state.
            images: Images by camera name.
        """
        messages: dict[str, Any] = {
            "clock": Clock(clock=fill_stamp(Clock().clock, record.stamp_ns)),
            "joint_states": joint_state_msg(record, self._robot),
            "sim/state": to_msg(record, StateRecordMsg),
            **self.make_seen(record, images),
        }
        messages[NOTICE] = tick_notice(record, messages)
        return messages

    def make_seen(self, record: StateRecord, images: Mapping[str, CameraImages]) -> dict[str, Any]:
        """Return the messages that depend on the scene's cameras: frames and images, by topic."""
        moving, stamp_ns = self._moving_frames(record), record.stamp_ns
        messages: dict[str, Any] = {"tf": self._tf.filled(stamp_ns, moving)}
        if self._fresh or record.seq == 0:
            self._fresh = False
            messages["tf_static"] = TfMessage().filled(stamp_ns, self._fixed)
            messages["robot_description"] = String(data=robot_description(self._robot.urdf))
            messages[MARKERS] = scene_markers(self._scene, self._poses.library, stamp_ns)
        for camera in self._scene.cameras:
            for kind, message in camera_msgs(stamp_ns, camera, images[camera.name]).items():
                messages[f"camera/{camera.name}/{kind}"] = message
        return messages

    def _moving_frames(self, record: StateRecord) -> dict[str, Pose]:
        """Return the world poses of all moving frames: links, tcp, objects and their links, cameras."""
        frames = dict(self._poses.link_poses(record.robot))
        frames["tcp"] = record.robot.pose_tcp_measured
        frames |= {entity.name: entity.pose for entity in record.entities}
        frames |= self._poses.object_poses(record)
        for name, pose in self._poses.camera_poses(record.robot).items():
            frames[optical_frame(name)] = pose
        return {name: pose for name, pose in frames.items() if name not in self._fixed}


def tick_notice(record: StateRecord, messages: Mapping[str, Any]) -> TickNotice:
    """Return the notice of a tick.

    Args:
        record: The tick's state.
        messages: The tick's messages by topic; the notice lists images with their checksums.
    """
    notice = TickNotice(
        episode_id=record.episode_id,
        seq=record.seq,
        topics=list(messages),
        image_crc32=[zlib.crc32(msg.data) if isinstance(msg, Image) else 0 for msg in messages.values()],
        reset=record.seq == 0,
    )
    fill_stamp(notice.stamp, record.stamp_ns)
    return notice
