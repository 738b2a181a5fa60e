"""The RLDS format of TensorFlow Datasets: the features of a dataset, and one episode as one Example.

Step k holds observation k and the action that leads from it to observation k + 1; T actions make T steps.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ErrorCode, InvalidRequestError, RecorderError, one_of
from roboxim_core.vision.images import ENCODINGS
from roboxim_datasets.episode import ImageSize, MetaValue
from roboxim_datasets.pictures import MAX_COMPONENTS, MAX_PIXELS, colour_picture
from roboxim_datasets.rlds.tfrecord import Feature, decode_example, encode_example

Array = npt.NDArray[np.float32]
INFO_FILE = "dataset_info.json"
FEATURES_FILE = "features.json"
SUBTASK = "steps/language_subtask"
"""Path of the text of a step's subtask in a longer task."""
META_TYPES = {"text": str, "int64": int, "bool": bool, "float32": float}
META_NAMES: dict[type, str] = {kind: name for name, kind in META_TYPES.items()}
_CLASS = "tensorflow_datasets.core.features."


@dataclass(frozen=True, kw_only=True)
class RldsFeatures:
    """Features of a dataset's episodes. The defaults of the paths are those that RoboXim writes."""

    images: dict[str, tuple[int, int]]
    """Image key, e.g. ``image`` or ``wrist_image``, to (height, width) [px]; 0: of any size."""
    encoding: str = "jpeg"
    """``jpeg`` or ``png``."""
    metadata: dict[str, str] = field(default_factory=dict)
    """Key of the episode's metadata to ``text``, ``int64``, ``bool`` or ``float32``."""
    vectors: dict[str, int] = field(default_factory=dict)
    """Observed vector, e.g. ``state``, to its size; the feature is ``observation/<name>``."""
    signals: dict[str, int] = field(default_factory=dict)
    """Vector beside the trained ones to its size; the feature is ``sim/<name>``, which loaders ignore."""
    action: dict[str, int] = field(default_factory=lambda: {"steps/action": 7})
    """Path of the action to its size; several paths are concatenated."""
    instruction: str = "steps/language_instruction"
    """Path of the instruction; empty: there is none."""
    subtask: str = ""
    """Path of the words of the step at hand; empty: the steps state none."""
    reward: str = "steps/reward"
    """Path of the reward; empty: there is none."""

    def __post_init__(self) -> None:
        """Check the names.

        Raises:
            InvalidRequestError: On an unknown encoding or metadata type, or a name that is given twice.
        """
        if self.encoding not in ENCODINGS:
            raise InvalidRequestError(f"unknown image encoding '{self.encoding}'; {one_of(ENCODINGS, self.encoding)}")
        for key, kind in self.metadata.items():
            if kind not in META_TYPES:
                raise InvalidRequestError(f"metadata '{key}': unknown type '{kind}'; {one_of(META_TYPES, kind)}")
        if twice := sorted(self.images.keys() & self.vectors.keys()):
            raise InvalidRequestError(
                f"image keys that are names of vectors too: {', '.join(twice)}; rename the cameras"
            )

    @property
    def action_size(self) -> int:
        """Number of components of the action."""
        return sum(self.action.values())


@dataclass(frozen=True, kw_only=True, eq=False)
class RldsEpisode:
    """One episode of T steps, images encoded."""

    images: Mapping[str, list[bytes]]
    """Image key to T encoded images; `frame` and `frames` decode."""
    vectors: Mapping[str, Array]
    """Observed vector to float32, shape (T, size)."""
    action: Array
    """float32, shape (T, D); its meaning is in the metadata's ``action_semantics``."""
    instruction: str
    """Natural language instruction; the first step's, if the steps have several."""
    instructions: tuple[str, ...] = ()
    """Instruction of each of the T steps, if they have several."""
    subtasks: tuple[str, ...] = ()
    """Subtask of each of the T steps; empty: they state none."""
    reward: Array
    """float32, shape (T,)."""
    signals: Mapping[str, Array] = field(default_factory=dict)
    """Vector beside the trained ones to float32, shape (T, size)."""
    metadata: Mapping[str, MetaValue] = field(default_factory=dict)
    """The episode's metadata."""

    def __len__(self) -> int:
        """Count the steps."""
        return len(self.action)

    @property
    def state(self) -> Array:
        """The vector ``state``: float32, shape (T, size)."""
        return self.vectors["state"]

    def frame(self, key: str, step: int, expected: ImageSize | None = None) -> npt.NDArray[np.uint8]:
        """Decode one image, uint8, shape (height, width, 3).

        Args:
            key: Image key.
            step: Number of the step.
            expected: Its size, which is checked before memory is taken; None: any.

        Raises:
            RecorderError: With code ``BAG_DAMAGED`` if the bytes are not an image, or one of another size.
        """
        try:
            return colour_picture(self.images[key][step], expected)
        except RecorderError as error:
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
    _require_vectors("action", {"action": episode.action}, {"action": features.action_size}, count)
    _require_vectors("reward", {"reward": episode.reward[:, None]}, {"reward": 1}, count)
    _require_vectors("observation", episode.vectors, features.vectors, count)
    _require_vectors("signal", episode.signals, features.signals, count)
    if set(episode.images) != set(features.images) or any(len(v) != count for v in episode.images.values()):
        raise InvalidRequestError(
            f"an episode needs {count} images each of {sorted(features.images)}, "
            f"got { {key: len(value) for key, value in episode.images.items()} }"
        )
    flags = np.zeros((2, count), np.int64)
    flags[0, 0] = flags[1, -1] = 1
    example: dict[str, Feature] = {
        "steps/action": episode.action,
        "steps/reward": episode.reward,
        "steps/discount": np.ones(count, np.float32),
        "steps/is_first": flags[0],
        "steps/is_last": flags[1],
        "steps/is_terminal": flags[1],
        "steps/language_instruction": [text.encode() for text in episode.instructions or [episode.instruction] * count],
    }
    if features.subtask:
        example[features.subtask] = [text.encode() for text in episode.subtasks]
    for name, values in episode.vectors.items():
        example[f"steps/observation/{name}"] = values
    for name, values in episode.signals.items():
        example[f"steps/sim/{name}"] = values
    for key, images in episode.images.items():
        example[f"steps/observation/{key}"] = images
    for key, kind in features.metadata.items():
        example[f"episode_metadata/{key}"] = _encode_meta(key, kind, episode.metadata.get(key))
    return encode_example(example)


def _require_vectors(kind: str, found: Mapping[str, Array], sizes: Mapping[str, int], count: int) -> None:
    """Refuse vectors that are not exactly those of the features, finite and one per step."""
    if found.keys() != sizes.keys():
        raise InvalidRequestError(f"an episode needs the {kind} vectors {sorted(sizes)}, got {sorted(found)}")
    for name, size in sizes.items():
        array = found[name]
        if count == 0 or array.shape != (count, size) or array.dtype != np.float32 or not np.isfinite(array).all():
            raise InvalidRequestError(
                f"an episode's {name} must be finite float32 of shape {(count, size)} with at least one step, "
                f"got {array.dtype} of shape {array.shape}"
            )


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


def features_to_json(features: RldsFeatures, names: Mapping[str, tuple[str, ...]] | None = None) -> dict[str, Any]:
    """Return the content of ``features.json``.

    Args:
        features: The features.
        names: Observed vector or signal to the names of its components, for the descriptions.
    """

    def vector(name: str, size: int) -> dict[str, Any]:
        return _tensor("float32", (size,), ", ".join((names or {}).get(name, ())))

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
    observation |= {name: vector(name, size) for name, size in features.vectors.items()}
    steps = {
        "observation": _group(observation),
        "action": _tensor("float32", (features.action_size,), "see episode_metadata/action_semantics"),
        "language_instruction": _text("natural language instruction"),
        "reward": _tensor("float32", (), "1 on the last step of a success, else 0"),
        "discount": _tensor("float32", (), "always 1"),
        "is_first": _tensor("bool", (), "first step"),
        "is_last": _tensor("bool", (), "last step"),
        "is_terminal": _tensor("bool", (), "last step"),
    }
    if features.subtask:
        steps[features.subtask.removeprefix("steps/")] = _text("what is to be done at this step of a longer task")
    if features.signals:
        steps["sim"] = _group({name: vector(name, size) for name, size in features.signals.items()})
    metadata = {
        key: _text("") if kind == "text" else _tensor(kind, (), "") for key, kind in sorted(features.metadata.items())
    }
    sequence = {
        "pythonClassName": _CLASS + "dataset_feature.Dataset",
        "sequence": {"feature": _group(steps), "length": "-1"},
    }
    return _group({"steps": sequence, "episode_metadata": _group(metadata)})


def features_from_json(data: dict[str, Any]) -> RldsFeatures:
    """Read the content of ``features.json``, RoboXim's or another's.

    Observations that are neither colour images nor vectors of numbers are left out; `reason_not_read` says why.

    Raises:
        InvalidRequestError: When the steps have no action.
    """
    leaves = leaves_of(data)
    images: dict[str, tuple[int, int]] = {}
    vectors: dict[str, int] = {}
    signals: dict[str, int] = {}
    encoding = ""
    for path, leaf in leaves.items():
        name = path.removeprefix("steps/observation/").removeprefix("steps/sim/")
        size = _vector_size(leaf)
        if path.startswith("steps/observation/") and _is_colour(leaf):
            height, width = _shape(leaf, "image")[:2]
            images[name] = (height, width) if height > 0 and width > 0 else (0, 0)
            encoding = encoding or leaf["image"].get("encodingFormat") or "png"
        elif path.startswith("steps/observation/") and size and "embedding" not in name:
            vectors[name] = size
        elif path.startswith("steps/sim/") and size:
            signals[name] = size
    action = {p: s for p, leaf in leaves.items() if (p + "/").startswith("steps/action/") and (s := _vector_size(leaf))}
    if not action:
        raise InvalidRequestError(f"the steps have no action of numbers; features: {', '.join(sorted(leaves))}")
    metadata = {
        p.removeprefix("episode_metadata/"): _meta_kind(leaf) for p, leaf in leaves.items() if "episode_metadata/" in p
    }
    return RldsFeatures(
        images=images,
        encoding=encoding or "jpeg",
        metadata={key: kind for key, kind in metadata.items() if kind},
        vectors=vectors,
        signals=signals,
        action=action,
        instruction=_instruction(leaves),
        subtask=SUBTASK if SUBTASK in leaves and _is_text(leaves[SUBTASK]) else "",
        reward="steps/reward" if _vector_size(leaves.get("steps/reward", {})) else "",
    )


def leaves_of(data: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return path to description of every feature that holds values, from the content of ``features.json``."""
    return dict(_leaves(data, ""))


def reason_not_read(path: str, leaf: dict[str, Any]) -> str:
    """Return why a feature is left out."""
    kind = next((kind for kind in ("tensor", "image", "text", "sequence") if kind in leaf), "feature of another kind")
    if kind not in ("tensor", "image"):
        return f"a {kind}, no image and no vector of numbers"
    shape = tuple(_shape(leaf, kind))
    dtype = leaf[kind].get("dtype", "uint8")
    if kind == "image":
        return f"images of {dtype} and shape {shape}; only colour images of uint8 are read"
    if "embedding" in path:
        return f"an embedding ({dtype}, shape {shape})"
    return f"{dtype} of shape {shape}" + ("" if path.startswith("steps/observation/") else ", not an observation")


def _leaves(feature: dict[str, Any], path: str) -> Iterable[tuple[str, dict[str, Any]]]:
    """Yield path and description of every feature that holds values."""
    if "featuresDict" in feature:
        for name, inner in feature["featuresDict"]["features"].items():
            yield from _leaves(inner, f"{path}/{name}" if path else name)
    elif "sequence" in feature and path == "steps":
        yield from _leaves(feature["sequence"]["feature"], path)
    else:
        yield path, feature


def _shape(leaf: dict[str, Any], kind: str) -> list[int]:
    return [int(size if size is not None else -1) for size in leaf[kind].get("shape", {}).get("dimensions", [])]


def _is_colour(leaf: dict[str, Any]) -> bool:
    if "image" not in leaf or leaf["image"].get("encodingFormat", "png") not in (*ENCODINGS, ""):
        return False
    shape = _shape(leaf, "image") or [-1, -1, 3]
    small = len(shape) == 3 and shape[0] * shape[1] <= MAX_PIXELS
    return leaf["image"].get("dtype", "uint8") == "uint8" and shape[2:] == [3] and small


def _vector_size(leaf: dict[str, Any]) -> int:
    """Return the number of components of a vector or scalar of numbers; 0: it is something else."""
    if "tensor" not in leaf or not leaf["tensor"]["dtype"].startswith(("float", "int", "uint", "bool")):
        return 0
    if leaf["tensor"].get("encoding", "none") not in ("none", "NONE"):
        return 0
    shape = _shape(leaf, "tensor")
    size = 1 if not shape else shape[0] if len(shape) == 1 else 0
    return size if 0 < size <= MAX_COMPONENTS else 0


def _is_text(leaf: dict[str, Any]) -> bool:
    return "text" in leaf or ("tensor" in leaf and leaf["tensor"]["dtype"] == "string" and not _shape(leaf, "tensor"))


def _meta_kind(leaf: dict[str, Any]) -> str:
    if _is_text(leaf):
        return "text"
    if "tensor" not in leaf or _shape(leaf, "tensor"):
        return ""
    dtype = str(leaf["tensor"]["dtype"])
    return "bool" if dtype == "bool" else "float32" if dtype.startswith("float") else "int64"


def _instruction(leaves: Mapping[str, dict[str, Any]]) -> str:
    texts = [path for path, leaf in leaves.items() if path.startswith("steps/") and _is_text(leaf)]
    usual = ("steps/language_instruction", "steps/observation/natural_language_instruction")
    named = [*(path for path in usual if path in texts), *(path for path in texts if "instruction" in path)]
    return named[0] if named else ""


def paths_of(features: RldsFeatures) -> list[str]:
    """Return the paths of all features that are read."""
    return [
        *features.action, *filter(None, (features.instruction, features.subtask, features.reward)),
        *(f"episode_metadata/{key}" for key in features.metadata),
        *(f"steps/observation/{name}" for name in (*features.images, *features.vectors)),
        *(f"steps/sim/{name}" for name in features.signals),
    ]  # fmt: skip


def decode_episode(payload: bytes, features: RldsFeatures) -> RldsEpisode:
    """Turn a record of a dataset into an episode, images still encoded.

    Raises:
        ValueError: When the record does not hold what the features say.
    """
    example: dict[str, Any] = decode_example(payload, paths_of(features))

    def numbers(path: str, size: int) -> Array:
        if path not in example:
            raise ValueError(f"a record lacks '{path}'")
        values = np.asarray(example[path])
        if values.dtype.kind not in "fi" or len(values) % size:
            raise ValueError(f"'{path}' holds {len(values)} values of {values.dtype}, expected {size} numbers a step")
        return np.asarray(values, np.float32).reshape(-1, size)

    metadata: dict[str, MetaValue] = {}
    for key, kind in features.metadata.items():
        value = example.get(f"episode_metadata/{key}", ())
        if len(value):
            if isinstance(value[0], bytes) != (kind == "text"):
                raise ValueError(f"'episode_metadata/{key}' is not of the kind {kind}")
            metadata[key] = value[0].decode() if isinstance(value[0], bytes) else META_TYPES[kind](value[0])
    action = np.concatenate([numbers(path, size) for path, size in features.action.items()], axis=1)
    texts = _texts(example.get(features.instruction, ()), len(action))
    reward = numbers(features.reward, 1)[:, 0] if features.reward else np.zeros(len(action), np.float32)
    episode = RldsEpisode(
        images={key: example.get(f"steps/observation/{key}", []) for key in features.images},
        vectors={name: numbers(f"steps/observation/{name}", size) for name, size in features.vectors.items()},
        signals={name: numbers(f"steps/sim/{name}", size) for name, size in features.signals.items()},
        action=action,
        instruction=texts[0] if texts else "",
        instructions=tuple(texts) if len(set(texts)) > 1 else (),
        subtasks=tuple(_texts(example.get(features.subtask, ()), len(action))),
        reward=reward,
        metadata=metadata,
    )
    parts: dict[str, Any] = {**episode.images, **episode.vectors, **episode.signals, "reward": reward}
    for name, values in parts.items():
        if len(values) != len(action) or (name in episode.images and not isinstance(values, list)):
            raise ValueError(f"'{name}' has {len(values)} steps, expected {len(action)} as the action")
    if not len(action):
        raise ValueError("it has no steps")
    return episode


def _texts(values: Any, count: int) -> list[str]:
    """Return the instruction of each step; none: the record has none."""
    if not len(values):
        return []
    if len(values) not in (1, count) or not all(isinstance(value, bytes) for value in values):
        raise ValueError(f"{len(values)} instructions, expected one for each of {count} steps")
    texts = [value.decode(errors="replace") for value in values]
    return texts * count if len(texts) == 1 else texts
