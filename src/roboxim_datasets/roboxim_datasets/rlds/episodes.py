"""RLDS episodes as `Episode` and back."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from typing import Any

import numpy as np

from roboxim_core.actions import ActionSemantics
from roboxim_core.config import from_json, to_json
from roboxim_core.documents import parse_json
from roboxim_core.errors import ConfigError
from roboxim_core.images import encode_image
from roboxim_core.proprioception import STATE_FIELDS, STATE_NAMES, ProprioField
from roboxim_datasets.episode import Episode, Floats, ImageSize, MetaValue, Step
from roboxim_datasets.rlds.format import RldsEpisode, RldsFeatures

METADATA = {
    "episode_id": "text",
    "file_path": "text",
    "run_seed": "int64",
    "index": "int64",
    "attempt": "int64",
    "skill": "text",
    "success": "bool",
    "actor": "text",
    "robot": "text",
    "action_semantics": "text",
    "cameras": "text",
    "state_layout": "text",
    "joint_names": "text",
    "task": "text",
}
"""Metadata that `to_rlds` writes, key to type."""
_OF_EPISODE = {"episode_id", "success", "robot", "action_semantics", "cameras", "state_layout", "joint_names"}
"""Metadata that an `Episode` has as separate fields."""
USUAL_KEYS = {"workspace": "image", "wrist": "wrist_image"}
"""Default camera to image key; other cameras keep their names."""


def to_rlds(
    episode: Episode, keys: Mapping[str, str], features: RldsFeatures, pool: Executor, *, resize: bool
) -> RldsEpisode:
    """Turn an episode into one of an RLDS dataset.

    Args:
        episode: The episode.
        keys: Camera to image key.
        features: Features of the dataset's episodes.
        pool: Threads that encode images.
        resize: Whether images are resized to the features' sizes.
    """
    images: dict[str, list[Future[bytes]]] = {key: [] for key in keys.values()}
    steps = []
    for step in episode.steps(list(keys)):
        steps.append(step)
        for camera, key in keys.items():
            size = features.images[key] if resize else None
            images[key].append(pool.submit(encode_image, step.images[camera], features.encoding, size))
    joints = [step.proprio[ProprioField.JOINT_POSITIONS] for step in steps]
    own: dict[str, MetaValue] = {
        "episode_id": episode.episode_id,
        "success": episode.success,
        "robot": episode.robot,
        "action_semantics": to_json(episode.semantics) if episode.semantics else "",
        "cameras": json.dumps({key: camera for camera, key in keys.items()}, sort_keys=True),
        "state_layout": json.dumps(STATE_NAMES),
        "joint_names": json.dumps(episode.joint_names),
    }
    return RldsEpisode(
        images={key: [future.result() for future in futures] for key, futures in images.items()},
        state=np.stack([np.concatenate([step.proprio[field] for field in STATE_FIELDS]) for step in steps]),
        joint_positions=np.stack(joints),
        action=np.stack([step.action for step in steps]),
        instruction=episode.instruction,
        reward=np.array([step.reward for step in steps], np.float32),
        metadata={**episode.metadata, **own},
    )


def from_rlds(episode: RldsEpisode, features: RldsFeatures) -> Episode:
    """Turn an episode of an RLDS dataset, written by RoboXim or not, into an `Episode`.

    Raises:
        ConfigError: When the metadata that describe it are not readable.
    """
    metadata = episode.metadata
    keys = camera_keys(episode)
    joint_names = tuple(_parsed(metadata, "joint_names", []))
    named = tuple(_parsed(metadata, "state_layout", [])) == STATE_NAMES

    def read(cameras: Sequence[str]) -> Iterator[Step]:
        for index in range(len(episode)):
            yield Step(
                index=index,
                images={camera: episode.frame(keys[camera], index) for camera in cameras},
                proprio=_proprio(episode, index, named=named),
                action=episode.action[index],
                reward=float(episode.reward[index]),
            )

    said = metadata.get("action_semantics")
    sizes = {camera: features.images[key] for camera, key in keys.items()}
    return Episode(
        episode_id=str(metadata.get("episode_id", "")),
        length=len(episode),
        instruction=episode.instruction,
        semantics=from_json(str(said), ActionSemantics, source="episode_metadata/action_semantics") if said else None,
        cameras={camera: ImageSize(height=height, width=width) for camera, (height, width) in sizes.items()},
        success=bool(metadata.get("success", episode.reward[-1] > 0)),
        robot=str(metadata.get("robot", "")),
        joint_names=joint_names,
        metadata={key: value for key, value in metadata.items() if key not in _OF_EPISODE},
        read=read,
    )


def camera_keys(episode: RldsEpisode) -> dict[str, str]:
    """Return camera to image key: as stored in the dataset, else by the default names.

    Raises:
        ConfigError: If the dataset's camera names are not readable.
    """
    said = _parsed(episode.metadata, "cameras", {})
    usual = {key: camera for camera, key in USUAL_KEYS.items()}
    return {str(said.get(key, usual.get(key, key))): key for key in episode.images}


def _parsed(metadata: Mapping[str, MetaValue], key: str, default: list[str] | dict[str, str]) -> Any:
    value = parse_json(str(metadata.get(key) or json.dumps(default)), source=f"episode_metadata/{key}")
    if type(value) is not type(default):
        raise ConfigError(f"episode_metadata/{key} is a {type(value).__name__}, expected a {type(default).__name__}")
    return value


_SIZES = {ProprioField.TCP_POSITION: 3, ProprioField.TCP_ROTATION_6D: 6, ProprioField.GRIPPER_OPENING: 1}


def _proprio(episode: RldsEpisode, index: int, *, named: bool) -> dict[str, Floats]:
    """Return a step's proprioception by field; without a state layout in the dataset the one field is ``state``."""
    state, found = episode.state[index], {}
    if named:
        at = 0
        for field in STATE_FIELDS:
            found[str(field)] = state[at : at + _SIZES[field]]
            at += _SIZES[field]
    else:
        found["state"] = state
    if episode.joint_positions.size:
        found[str(ProprioField.JOINT_POSITIONS)] = episode.joint_positions[index]
    return found
