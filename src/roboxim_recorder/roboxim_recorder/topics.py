"""The topics of an episode's bag and their types. Names in a bag are absolute and carry no worker namespace."""

from __future__ import annotations

from roboxim_core.specs import SceneSpec

INFO = "/episode/info"
RESULT = "/episode/result"
STEP = "/evaluator/step"
NOTICE = "/sim/ticks"
STATE = "/sim/state"
TF_STATIC = "/tf_static"
DESCRIPTION = "/robot_description"
MARKERS = "/sim/markers"
ACTED_BY = "/episode/acted_by"

IMAGE = "sensor_msgs/msg/Image"
"""Type of every image."""
OWN = {INFO: "roboxim_interfaces/msg/EpisodeInfo", RESULT: "roboxim_interfaces/msg/EpisodeResult"}
"""Topics that the recorder itself writes: the first and the last message."""
ALWAYS = {
    NOTICE: "roboxim_interfaces/msg/TickNotice",
    "/clock": "rosgraph_msgs/msg/Clock",
    "/joint_states": "sensor_msgs/msg/JointState",
    "/tf": "tf2_msgs/msg/TFMessage",
    TF_STATIC: "tf2_msgs/msg/TFMessage",
    DESCRIPTION: "std_msgs/msg/String",
    MARKERS: "visualization_msgs/msg/MarkerArray",
    STATE: "roboxim_interfaces/msg/StateRecord",
    STEP: "roboxim_interfaces/msg/EpisodeStep",
}
"""Topics of every episode."""
OF_SCENE = (TF_STATIC, DESCRIPTION, MARKERS)
"""Topics with a message in tick 0 only, which is valid for the whole episode."""
ACTORS = {ACTED_BY: "std_msgs/msg/String"}
"""Topic of episodes in which several acted, with a message after each action's tick: who acted. Others lack it."""
ADDED = (MARKERS,)
"""Topics that bags of earlier versions lack."""

WALL_TIMES = {STEP: ("inference_s",), RESULT: ("wall_s", "inference_s")}
"""Fields that hold wall time [s]; they are 0 in bags, so that equal episodes give equal bytes."""


IMAGE_KINDS = ("image", "depth", "segmentation")
"""Kinds of images of a camera."""


def image_topic(camera: str, kind: str = "image") -> str:
    """Return a camera's topic; kinds: ``image``, ``camera_info``, ``depth``, ``segmentation``."""
    return f"/camera/{camera}/{kind}"


def scene_topics(scene: SceneSpec) -> dict[str, str]:
    """Return topic to type of everything that the graph publishes in an episode of a scene."""
    topics = dict(ALWAYS)
    for camera in scene.cameras:
        topics[image_topic(camera.name)] = IMAGE
        topics[image_topic(camera.name, "camera_info")] = "sensor_msgs/msg/CameraInfo"
        for kind, on in (("depth", camera.depth), ("segmentation", camera.segmentation)):
            if on:
                topics[image_topic(camera.name, kind)] = IMAGE
    return topics


def absolute(topic: str) -> str:
    """Return a topic's name in a bag."""
    return topic if topic.startswith("/") else f"/{topic}"
