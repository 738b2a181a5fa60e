"""Messages of the policy boundary."""

from __future__ import annotations

from roboxim_interfaces.msg import CameraImage
from roboxim_interfaces.msg import Observation as ObservationMsg
from roboxim_interfaces.msg import StateRecord as StateRecordMsg
from roboxim_interfaces.srv import Act
from sensor_msgs.msg import Image

from roboxim_core.policies import Observation, ObservationWindow
from roboxim_ros.conversions import fill_image, to_msg


def observation_to_msg(observation: Observation) -> ObservationMsg:
    """Convert an observation; its images are copied once."""
    return ObservationMsg(
        seq=observation.seq,
        stamp_ns=observation.stamp_ns,
        images=[
            CameraImage(camera=name, image=fill_image(Image(), image, "rgb8"))
            for name, image in observation.images.items()
        ],
        proprio=observation.proprio,
        state=[] if observation.state is None else [to_msg(observation.state, StateRecordMsg)],
    )


def act_request(window: ObservationWindow) -> Act.Request:
    """Convert an observation window to a request; a padded frame is converted once."""
    done: dict[int, ObservationMsg] = {}
    for observation in window.observations:
        if id(observation) not in done:
            done[id(observation)] = observation_to_msg(observation)
    return Act.Request(
        episode_id=window.episode_id,
        seq=window.seq,
        instruction=window.instruction,
        observations=[done[id(observation)] for observation in window.observations],
        pad_mask=list(window.pad_mask),
    )
