"""The RLDS format of TensorFlow Datasets: the features of a dataset, and one episode as one Example.

Step k holds observation k and the action that leads from it to observation k + 1; T actions make T steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ErrorCode, InvalidRequestError, RecorderError, one_of
from roboxim_core.images import ENCODINGS, decode_image
from roboxim_core.proprioception import STATE_NAMES, STATE_SIZE
from roboxim_datasets.rlds.tfrecord import Feature, decode_example, encode_example

Array = npt.NDArray[np.float32]
MetaValue = str | int | float | bool
ACTION_SIZE = 7
META_TYPES = {"text": str, "int64": int, "bool": bool, "float32": float}
_CLASS = "tensorflow_datasets.core.features."


@dataclass(frozen=True, kw_only=True)
class RldsFeatures:
    """Features of a dataset's episodes."""

    images: dict[str, tuple[int, int]]
    """Image key, e.g. ``image`` or ``wrist_image``, to (height, width) [px]."""
    encoding: str = "jpeg"
    """``jpeg`` or ``png``."""
    metadata: dict[str, str] = field(default_factory=dict)
    """Key of the episode's metadata to ``text``, ``int64``, ``bool`` or ``float32``."""
    joints: int = 0
    """Arm joints, whose positions are in ``observation/joint_positions``; 0: there is no such feature."""

    def __post_init__(self) -> None:
        """Check the names.

        Raises:
            InvalidRequestError: On an unknown encoding or metadata type.
        """
        if self.encoding not in ENCODINGS:
            raise InvalidRequestError(f"unknown image encoding '{self.encoding}'; {one_of(ENCODINGS, self.encoding)}")
        for key, kind in self.metadata.items():
            if kind not in META_TYPES:
                raise InvalidRequestError(f"metadata '{key}': unknown type '{kind}'; {one_of(META_TYPES, kind)}")


@dataclass(frozen=True, kw_only=True, eq=False)
class RldsEpisode:
    """One episode of T steps."""

    images: Mapping[str, list[bytes]]
    """Image key to T encoded images; `frame` and `frames` decode."""
    state: Array
    """float32, shape (T, 10): measured TCP in the base frame, position [m] (3) and rotation as the first two columns
    of its matrix (6), gripper opening (1); `roboxim_core.proprioception.STATE_NAMES` names the numbers."""
    action: Array
    """float32, shape (T, 7); its meaning is in the metadata's ``action_semantics``."""
    instruction: str
    """Natural language instruction."""
    reward: Array
    """float32, shape (T,)."""
    metadata: Mapping[str, MetaValue] = field(default_factory=dict)
    """The episode's metadata."""
    joint_positions: Array = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    """float32, shape (T, joints): measured arm joint positions [rad]; empty: not recorded."""

    def __len__(self) -> int:
        """Count the steps."""
        return len(self.action)

    def frame(self, key: str, step: int) -> npt.NDArray[np.uint8]:
        """Decode one image, uint8, shape (height, width, 3).

        Raises:
            RecorderError: With code ``BAG_DAMAGED`` if the bytes are not an image.
        """
        try:
            return decode_image(self.images[key][step])
        except InvalidRequestError as error:
            raise RecorderError(f"step {step}, image '{key}': {error}", ErrorCode.BAG_DAMAGED) from None

    def frames(self, key: str) -> npt.NDArray[np.uint8]:
        """Decode all images of a key, uint8, shape (T, height, width, 3)."""
        return np.stack([self.frame(key, step) for step in range(len(self))])


def encode_episode(episode: RldsEpisode, features: RldsFeatures) -> bytes:
    """Serialise an episode as the payload of a record.

    Raises:
        InvalidRequestError: If the episode does not match the features or holds a number that is not finite.
    """
    count = len(episode)
    shapes: dict[str, tuple[int, ...]] = {
        "state": (count, STATE_SIZE),
        "action": (count, ACTION_SIZE),
        "reward": (count,),
    }
    if features.joints:
        shapes["joint_positions"] = (count, features.joints)
    for name, shape in shapes.items():
        array = getattr(episode, name)
        if count == 0 or array.shape != shape or array.dtype != np.float32 or not np.isfinite(array).all():
            raise InvalidRequestError(
                f"an episode's {name} must be finite float32 of shape {shape} with at least one step, "
                f"got {array.dtype} of shape {array.shape}"
            )
    if set(episode.images) != set(features.images) or any(len(v) != count for v in episode.images.values()):
        raise InvalidRequestError(
            f"an episode needs {count} images each of {sorted(features.images)}, "
            f"got { {key: len(value) for key, value in episode.images.items()} }"
        )
    flags = np.zeros((2, count), np.int64)
    flags[0, 0] = flags[1, -1] = 1
    example: dict[str, Feature] = {
        "steps/observation/state": episode.state,
        "steps/action": episode.action,
        "steps/reward": episode.reward,
        "steps/discount": np.ones(count, np.float32),
        "steps/is_first": flags[0],
        "steps/is_last": flags[1],
        "steps/is_terminal": flags[1],
        "steps/language_instruction": [episode.instruction.encode()] * count,
    }
    if features.joints:
        example["steps/observation/joint_positions"] = episode.joint_positions
    for key, images in episode.images.items():
        example[f"steps/observation/{key}"] = images
    for key, kind in features.metadata.items():
        example[f"episode_metadata/{key}"] = _encode_meta(key, kind, episode.metadata.get(key))
    return encode_example(example)


def _encode_meta(key: str, kind: str, value: MetaValue | None) -> Feature:
    if type(value) is not META_TYPES[kind]:
        raise InvalidRequestError(f"metadata '{key}' must be {kind}, got {value!r}")
    if isinstance(value, str):
        return [value.encode()]
    return np.array([value], np.float32) if kind == "float32" else np.array([value], np.int64)


def _tensor(dtype: str, shape: tuple[int, ...], text: str) -> dict[str, Any]:
    kind = "tensor_feature.Tensor" if shape else "scalar.Scalar"
    dimensions = {"dimensions": [str(size) for size in shape]} if shape else {}
    tensor = {"shape": dimensions, "dtype": dtype, "encoding": "none"}
    return {"pythonClassName": _CLASS + kind, "tensor": tensor, "description": text}


def _group(features: dict[str, Any]) -> dict[str, Any]:
    return {"pythonClassName": _CLASS + "features_dict.FeaturesDict", "featuresDict": {"features": features}}


def _text(description: str) -> dict[str, Any]:
    return {"pythonClassName": _CLASS + "text_feature.Text", "text": {}, "description": description}


def features_to_json(features: RldsFeatures) -> dict[str, Any]:
    """Return the content of ``features.json``."""
    observation: dict[str, Any] = {
        key: {
            "pythonClassName": _CLASS + "image_feature.Image",
            "image": {
                "shape": {"dimensions": [str(height), str(width), "3"]},
                "dtype": "uint8",
                "encodingFormat": features.encoding,
            },
        }
        for key, (height, width) in features.images.items()
    }
    observation["state"] = _tensor(
        "float32",
        (STATE_SIZE,),
        f"measured proprioception: {', '.join(STATE_NAMES)}",
    )
    if features.joints:
        observation["joint_positions"] = _tensor("float32", (features.joints,), "measured arm joint positions [rad]")
    steps = {
        "observation": _group(observation),
        "action": _tensor("float32", (ACTION_SIZE,), "see episode_metadata/action_semantics"),
        "language_instruction": _text("natural language instruction"),
        "reward": _tensor("float32", (), "1 on the last step of a success, else 0"),
        "discount": _tensor("float32", (), "always 1"),
        "is_first": _tensor("bool", (), "first step"),
        "is_last": _tensor("bool", (), "last step"),
        "is_terminal": _tensor("bool", (), "last step"),
    }
    metadata = {
        key: _text("") if kind == "text" else _tensor(kind, (), "") for key, kind in sorted(features.metadata.items())
    }
    sequence = {
        "pythonClassName": _CLASS + "dataset_feature.Dataset",
        "sequence": {"feature": _group(steps), "length": "-1"},
    }
    return _group({"steps": sequence, "episode_metadata": _group(metadata)})


def features_from_json(data: dict[str, Any]) -> RldsFeatures:
    """Read the content of ``features.json``."""
    top = data["featuresDict"]["features"]
    observation = top["steps"]["sequence"]["feature"]["featuresDict"]["features"]["observation"]
    images, encoding = {}, "jpeg"
    for key, value in observation["featuresDict"]["features"].items():
        if "image" in value:
            height, width, _ = (int(size) for size in value["image"]["shape"]["dimensions"])
            images[key], encoding = (height, width), value["image"]["encodingFormat"]
    _require_state(observation["featuresDict"]["features"]["state"])
    joints = observation["featuresDict"]["features"].get("joint_positions")
    metadata = top["episode_metadata"]["featuresDict"]["features"]
    kinds = {key: "text" if "text" in value else value["tensor"]["dtype"] for key, value in metadata.items()}
    count = int(joints["tensor"]["shape"]["dimensions"][0]) if joints else 0
    return RldsFeatures(images=images, encoding=encoding, metadata=kinds, joints=count)


def _require_state(feature: dict[str, Any]) -> None:
    """Reject a state of another layout; earlier versions of RoboXim exported 8 numbers with a quaternion."""
    shape = [int(size) for size in feature["tensor"]["shape"]["dimensions"]]
    if shape != [STATE_SIZE]:
        raise RecorderError(
            f"its observation/state has shape {shape} ('{feature.get('description', '')}'), expected [{STATE_SIZE}] "
            f"({', '.join(STATE_NAMES)}); it is of another version of RoboXim: export the bags again",
            ErrorCode.BAG_DAMAGED,
        )


def decode_episode(payload: bytes, features: RldsFeatures) -> RldsEpisode:
    """Turn a record of a dataset into an episode, images still encoded."""
    example: dict[str, Any] = decode_example(payload)
    metadata = {
        key: example[f"episode_metadata/{key}"][0].decode() if kind == "text" else META_TYPES[kind](value[0])
        for key, kind in features.metadata.items()
        if len(value := example[f"episode_metadata/{key}"])
    }
    return RldsEpisode(
        images={key: example[f"steps/observation/{key}"] for key in features.images},
        state=example["steps/observation/state"].reshape(-1, STATE_SIZE),
        action=example["steps/action"].reshape(-1, ACTION_SIZE),
        instruction=example["steps/language_instruction"][0].decode(),
        reward=example["steps/reward"],
        joint_positions=(
            example["steps/observation/joint_positions"].reshape(-1, features.joints)
            if features.joints
            else np.zeros((0, 0), np.float32)
        ),
        metadata=metadata,
    )
