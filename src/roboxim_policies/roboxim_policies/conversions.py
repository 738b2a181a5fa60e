"""Messages of the policy boundary to values and back."""

from __future__ import annotations

from typing import Any

import numpy as np

from roboxim_core.policies import ActionChunk, EpisodeStart, Observation, ObservationWindow
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_core.state import StateRecord
from roboxim_ros.conversions import from_msg, image_from_msg


def start_from_msg(request: Any, *, privileged: bool) -> EpisodeStart:
    """Convert a ``ResetPolicy`` request.

    Args:
        request: The request.
        privileged: Whether the task and the scene are read; else they are not even converted.
    """
    return EpisodeStart(
        episode_id=request.episode_id,
        instruction=request.instruction,
        seed=int(request.seed),
        task=from_msg(request.task[0], TaskSpec) if privileged and request.task else None,
        scene=from_msg(request.scene[0], SceneSpec) if privileged and request.scene else None,
    )


def window_from_msg(request: Any, *, privileged: bool) -> ObservationWindow:
    """Convert an ``Act`` request. Images share the request's memory and are read-only.

    Args:
        request: The request.
        privileged: Whether the state records are read; else they are not even converted.

    Raises:
        InvalidRequestError: On an image whose data does not fit its size or encoding.
    """
    return ObservationWindow(
        instruction=request.instruction,
        observations=[_observation(item, privileged) for item in request.observations],
        pad_mask=tuple(bool(real) for real in request.pad_mask),
        episode_id=request.episode_id,
        seq=int(request.seq),
    )


def _observation(item: Any, privileged: bool) -> Observation:
    proprio = np.array(item.proprio, np.float32)
    proprio.flags.writeable = False
    return Observation(
        seq=int(item.seq),
        stamp_ns=int(item.stamp_ns),
        images={image.camera: image_from_msg(image.image) for image in item.images},
        proprio=proprio,
        state=from_msg(item.state[0], StateRecord) if privileged and item.state else None,
    )


def fill_chunk(response: Any, chunk: ActionChunk) -> None:
    """Fill an ``Act`` response."""
    response.horizon = len(chunk.actions)
    response.actions = chunk.actions.ravel().tolist()
    response.done = bool(chunk.done)
    response.phases = list(chunk.phases)
