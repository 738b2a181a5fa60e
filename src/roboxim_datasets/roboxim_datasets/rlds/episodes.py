"""RLDS episodes as `Episode` and back."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor, Future
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from roboxim_core.actions import ActionSemantics
from roboxim_core.config import from_json, to_json
from roboxim_core.errors import ConfigError, InvalidRequestError
from roboxim_core.plain_data.documents import parse_json
from roboxim_core.proprioception import ProprioField, component_names
from roboxim_core.vision.images import encode_image
from roboxim_datasets.dataset import Features
from roboxim_datasets.episode import (
    EXECUTED,
    OWN_FIELDS,
    SIGNAL_PREFIX,
    Episode,
    ImageSize,
    MetaValue,
    Step,
    Wanted,
    solved,
)
from roboxim_datasets.rlds.format import RldsEpisode, RldsFeatures

USUAL_KEYS = {"workspace": "image", "wrist": "wrist_image"}
"""Default camera to image key; other cameras keep their names."""


@dataclass(frozen=True, kw_only=True, eq=False)
class EncodedSteps:
    """An episode that has been read, and whose images threads are encoding."""

    episode: Episode
    keys: Mapping[str, str]
    """Camera to image key."""
    images: Mapping[str, list[Future[bytes]]]
    """Image key to T images that are being encoded."""
    steps: list[Step]
    """The T steps, without images."""


def read_steps(episode: Episode, described: Features, features: RldsFeatures, pool: Executor) -> EncodedSteps:
    """Read an episode, and start to encode its images.

    Args:
        episode: The episode.
        described: What the dataset's steps consist of.
        features: The same, as RLDS stores it.
        pool: Threads that encode images.
    """
    keys = described.keys
    images: dict[str, list[Future[bytes]]] = {key: [] for key in keys.values()}
    steps = []
    for step in episode.steps(list(keys)):
        for camera, key in keys.items():
            images[key].append(pool.submit(_encoded, step, camera, features.encoding))
        steps.append(replace(step, images={}, encoded={}))  # an image is free again once it is encoded
    return EncodedSteps(episode=episode, keys=keys, images=images, steps=steps)


def to_rlds(read: EncodedSteps, described: Features, features: RldsFeatures) -> RldsEpisode:
    """Turn an episode into one of an RLDS dataset; wait for its images.

    Args:
        read: The episode.
        described: What the dataset's steps consist of.
        features: The same, as RLDS stores it.
    """
    episode, steps = read.episode, read.steps
    own: dict[str, MetaValue] = {
        "episode_id": episode.episode_id,
        "success": bool(episode.success),
        "outcome": OUTCOMES[episode.success],
        "fps": float(episode.fps),
        "robot": episode.robot,
        "action_semantics": to_json(episode.semantics) if episode.semantics else "",
        "cameras": json.dumps({key: camera for camera, key in read.keys.items()}, sort_keys=True),
        "state_layout": json.dumps(episode.vectors.get("state", ())),
        "joint_names": json.dumps(episode.joint_names),
        "vectors": json.dumps({**episode.vectors, **episode.signals, "action": described.action}),
    }
    return RldsEpisode(
        images={key: [future.result() for future in futures] for key, futures in read.images.items()},
        vectors={name: np.stack([step.proprio[name] for step in steps]) for name in features.vectors},
        signals={name: np.stack([step.signal(SIGNAL_PREFIX + name) for step in steps]) for name in features.signals},
        action=np.stack([step.action for step in steps]),
        instruction=episode.instruction,
        instructions=tuple(map(episode.words, steps)) if episode.instructions else (),
        subtasks=tuple(map(episode.subtask, steps)) if features.subtask else (),
        reward=np.array([step.reward for step in steps], np.float32),
        metadata={key: value for key, value in {**episode.metadata, **own}.items() if key in features.metadata},
    )


def _encoded(step: Step, camera: str, encoding: str) -> bytes:
    """Return an image in an encoding, as the dataset that it comes from stores it if it can."""
    kind, data = step.encoded.get(camera, ("", b""))
    return data if kind == encoding else encode_image(step.images[camera], encoding)


def from_rlds(episode: RldsEpisode, features: RldsFeatures) -> Episode:
    """Turn an episode of an RLDS dataset, written by RoboXim or not, into an `Episode`.

    Raises:
        ConfigError: When the metadata that describe it are not readable.
    """
    metadata = episode.metadata
    keys = camera_keys(episode)
    names = component_names_of(episode, features)
    executed = EXECUTED.removeprefix(SIGNAL_PREFIX)
    others = [name for name in episode.signals if name != executed]
    shapes = {camera: features.images[key] for camera, key in keys.items()}
    sizes = {camera: ImageSize(height=height, width=width) for camera, (height, width) in shapes.items()}

    def read(wanted: Wanted) -> Iterator[Step]:
        for index in range(len(episode)):
            yield Step(
                index=index,
                images={camera: episode.frame(keys[camera], index, sizes[camera]) for camera in wanted.cameras},
                encoded={camera: (features.encoding, episode.images[keys[camera]][index]) for camera in wanted.cameras},
                proprio={name: values[index] for name, values in episode.vectors.items()},
                action=episode.action[index],
                action_executed=episode.signals[executed][index] if executed in episode.signals else None,
                signals={SIGNAL_PREFIX + name: episode.signals[name][index] for name in others},
                reward=float(episode.reward[index]),
                instruction=episode.instructions[index] if episode.instructions else None,
                subtask=episode.subtasks[index] if episode.subtasks else None,
            )

    semantics = semantics_of(episode)
    return Episode(
        episode_id=str(metadata.get("episode_id", "")),
        length=len(episode),
        instruction=episode.instruction,
        semantics=semantics,
        cameras=sizes,
        instructions=tuple(dict.fromkeys(episode.instructions)),
        subtasks=tuple(dict.fromkeys(episode.subtasks)),
        success=_success(episode),
        robot=str(metadata.get("robot", "")),
        joint_names=tuple(map(str, _parsed(metadata, "joint_names", []))),
        fps=_rate(metadata.get("fps", 0.0)) or (semantics.rate_hz if semantics else 0.0),
        vectors=names.vectors,
        signals={name: value for name, value in names.signals.items() if name != EXECUTED},
        metadata={key: value for key, value in metadata.items() if key not in {*OWN_FIELDS, "outcome", "fps"}},
        read=read,
    )


OUTCOMES: Mapping[bool | None, str] = {True: "success", False: "failure", None: "unknown"}
"""Outcome to its text in ``episode_metadata/outcome``, which datasets have if not every episode says its success."""


def _success(episode: RldsEpisode) -> bool | None:
    """Return whether an episode solved its task: as its metadata say it, else as its rewards do."""
    metadata = episode.metadata
    if "success" in metadata:
        success = str(metadata["success"]).strip().lower()
        return {"true": True, "1": True, "1.0": True, "false": False, "0": False, "0.0": False}.get(success)
    if "outcome" in metadata:
        return {text: value for value, text in OUTCOMES.items()}.get(str(metadata["outcome"]))
    return solved(episode.reward)


def _rate(stated: MetaValue) -> float:
    """Return a rate as it was before it was stored in single precision; 0: it is none."""
    rate = float(f"{stated:.7g}") if isinstance(stated, int | float) else 0.0
    return rate if np.isfinite(rate) and rate > 0 else 0.0


def semantics_of(episode: RldsEpisode) -> ActionSemantics | None:
    """Return the action semantics that an episode states; None: it states none.

    Raises:
        ConfigError: When a dataset of RoboXim states them in another format.
    """
    text = episode.metadata.get("action_semantics")
    try:
        return from_json(str(text), ActionSemantics, source="episode_metadata/action_semantics") if text else None
    except ConfigError:
        if is_own(episode.metadata):
            raise
        return None


@dataclass(frozen=True, kw_only=True)
class ComponentNames:
    """Names of the components of everything in a dataset's steps."""

    action: tuple[str, ...]
    """Of the action."""
    vectors: dict[str, tuple[str, ...]]
    """Of each observed vector."""
    signals: dict[str, tuple[str, ...]]
    """Of each signal, by its name with the prefix ``sim.``."""


def component_names_of(episode: RldsEpisode, features: RldsFeatures) -> ComponentNames:
    """Return the names of components, as an episode states them; else numbered, e.g. ``state.0``.

    Raises:
        ConfigError: When the metadata that state them are not readable.
    """
    metadata = episode.metadata
    joints = tuple(map(str, _parsed(metadata, "joint_names", [])))
    stated = {"state": _parsed(metadata, "state_layout", []), **_parsed(metadata, "vectors", {})}
    if "joint_positions" in features.vectors:
        stated.setdefault("joint_positions", component_names((ProprioField.JOINT_POSITIONS,), joints))

    def named(name: str, size: int, key: str) -> tuple[str, ...]:
        given = stated.get(key)
        names = tuple(map(str, given)) if isinstance(given, list | tuple) else ()
        return names if len(names) == size else tuple(f"{name}.{index}" for index in range(size))

    semantics = semantics_of(episode)
    action: tuple[str, ...] = ()
    if semantics is not None:
        try:
            action = semantics.component_names(joints)
        except InvalidRequestError as error:
            if is_own(metadata):
                raise ConfigError(f"the meaning of the actions cannot be read: {error}") from None
    if len(action) != features.action_size:
        action = named("action", features.action_size, "action")
    signals = {name: SIGNAL_PREFIX + name for name in features.signals}
    return ComponentNames(
        action=action,
        vectors={name: named(name, size, name) for name, size in features.vectors.items()},
        signals={
            key: action if key == EXECUTED else named(name, features.signals[name], key)
            for name, key in signals.items()
        },
    )


def camera_keys(episode: RldsEpisode) -> dict[str, str]:
    """Return camera to image key: as stored in the dataset, else by the default names.

    Two images never become one camera: then each has the name of its key.

    Raises:
        ConfigError: If the camera names of RoboXim's own dataset are not readable.
    """
    cameras = _parsed(episode.metadata, "cameras", {})
    usual = {key: camera for camera, key in USUAL_KEYS.items()}
    names = [str(cameras.get(key, usual.get(key, key))) for key in episode.images]
    if len(set(names)) < len(names):
        names = list(episode.images)
    return dict(zip(names, episode.images, strict=True))


def not_understood(metadata: Mapping[str, MetaValue]) -> set[str]:
    """Return the keys that RoboXim uses too, with values in another form: those of another tool."""
    found = set()
    for key, default in _FORMS.items():
        try:
            _parsed_strictly(metadata, key, default)
        except ConfigError:
            found.add(key)
    episode = RldsEpisode(images={}, vectors={}, action=_NO_ROWS, reward=_NO_ROWS, instruction="", metadata=metadata)
    if metadata.get("action_semantics") and semantics_of(episode) is None:
        found.add("action_semantics")
    if {"success", "outcome"} & metadata.keys() and _success(episode) is None:
        found |= {key for key in ("success", "outcome") if metadata.get(key, "unknown") not in ("", "unknown")}
    if metadata.get("fps") and not _rate(metadata["fps"]):
        found.add("fps")
    return found


def is_own(metadata: Mapping[str, object]) -> bool:
    """Return whether keys of metadata are RoboXim's, which have all of these; another tool may use one of the names."""
    return metadata.keys() >= {"action_semantics", *_FORMS} - {"vectors"}  # which earlier exports did not have


def _parsed(metadata: Mapping[str, MetaValue], key: str, default: list[str] | dict[str, str]) -> Any:
    """Return metadata that are JSON in a dataset of RoboXim; the default: they are another tool's, of another form."""
    try:
        return _parsed_strictly(metadata, key, default)
    except ConfigError:
        if is_own(metadata):
            raise
        return default


def _parsed_strictly(metadata: Mapping[str, MetaValue], key: str, default: list[str] | dict[str, str]) -> Any:
    value = parse_json(str(metadata.get(key) or json.dumps(default)), source=f"episode_metadata/{key}")
    if type(value) is not type(default):
        raise ConfigError(f"episode_metadata/{key} is a {type(value).__name__}, expected a {type(default).__name__}")
    return value


_FORMS: dict[str, list[str] | dict[str, str]] = {"cameras": {}, "state_layout": [], "joint_names": [], "vectors": {}}
"""Metadata that are JSON in a dataset of RoboXim, to their form."""
_NO_ROWS = np.zeros(0, np.float32)
