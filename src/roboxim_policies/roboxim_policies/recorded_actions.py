"""Loads recorded actions for the ``replay`` policy: from ``.npz``, ``.json``, a recorded bag, or a dataset."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from roboxim_core.actions import ActionArray, ActionContext, ActionSemantics, ControlMode, check_chunk
from roboxim_core.actions.transforms import Target, action_of
from roboxim_core.errors import ConfigError, InvalidRequestError, RecorderError
from roboxim_core.plain_data.documents import read_json
from roboxim_datasets.episode import Episode
from roboxim_datasets.formats import open_dataset
from roboxim_policies.learning.checkpoint_file import UNREADABLE, require_no_bomb
from roboxim_ros.messages.conversions import from_msg

STEP_TOPIC = "evaluator/step"
STATE_TOPIC = "sim/state"


def load_actions(
    source: Path, *, episode: int = 0, control: ControlMode | None = None
) -> tuple[ActionArray, ActionSemantics]:
    """Load an episode's actions and their meaning.

    Args:
        source: ``.npz`` (array ``actions``, or the only array), ``.json`` (a list, or an object with ``actions``), a
            bag (``.mcap`` file, or a folder with one), or a dataset of any registered format.
        episode: Number of the episode in a dataset, through all of its splits.
        control: In joint space, the motion of a bag's commanded joints in this control mode, instead of the recorded
            actions. None: the recorded actions.

    Returns:
        Actions of shape (T, D), and their semantics (the default if the file does not state them).

    Raises:
        ConfigError: When the source is missing, of an unknown kind, or contains no valid actions.
    """
    if not source.exists():
        raise ConfigError(f"no such file or folder: {source}")
    semantics = ActionSemantics()
    bags = sorted(source.glob("*.mcap")) if source.is_dir() else [source] if source.suffix == ".mcap" else []
    if control is not None and not bags:
        raise ConfigError(f"{source}: only a bag holds the commanded joints that control '{control}' needs")
    if control is not None:
        actions, semantics = _joint_motion(bags[0], control)
    elif bags:
        actions, semantics = _from_bag(bags[0])
    elif source.is_dir():
        actions, semantics = _from_dataset(source, episode)
    elif source.suffix == ".npz":
        actions = _from_npz(source)
    elif source.suffix == ".json":
        actions = _from_json(source)
    elif source.suffix in (".hdf5", ".h5"):
        actions, semantics = _from_dataset(source, episode)
    else:
        raise ConfigError(f"{source}: cannot read actions from this; give .npz, .json, .mcap or a dataset")
    try:
        shape = np.asarray(actions).shape
        joints = max(shape[-1] - 1, 1) if shape else 1
        return check_chunk(actions, size=semantics.dimension(joints)), semantics
    except (InvalidRequestError, ValueError) as error:  # also rows of different lengths
        raise ConfigError(f"{source}: {error}") from None


def _from_npz(source: Path) -> npt.ArrayLike:
    try:
        require_no_bomb(source)
        with np.load(source) as arrays:
            names = list(arrays)
            if "actions" not in names and len(names) != 1:
                raise ConfigError(f"{source}: needs an array 'actions', has {', '.join(names) or 'none'}")
            return np.asarray(arrays["actions" if "actions" in names else names[0]])
    except UNREADABLE as error:
        raise ConfigError(f"{source} is not a readable .npz: {str(error) or type(error).__name__}") from None


def _from_json(source: Path) -> npt.ArrayLike:
    data = read_json(source)
    actions: npt.ArrayLike = data.get("actions", []) if isinstance(data, dict) else data
    return actions


def _from_bag(source: Path) -> tuple[npt.ArrayLike, ActionSemantics]:
    """Read the executed actions."""
    with _opened(source) as (reader, by_topic):
        steps = {}
        for step in _messages(reader, by_topic[STEP_TOPIC]):
            if step.phase == "act":
                steps[int(step.seq)] = np.asarray(step.action_executed, np.float32)
        semantics = _semantics(reader, by_topic.get("episode/info"))
    if sorted(steps) != list(range(1, len(steps) + 1)):
        raise ConfigError(f"{source}: the bag has gaps (actions of ticks {sorted(steps)}); it cannot be replayed")
    return [steps[seq] for seq in sorted(steps)], semantics


def _joint_motion(source: Path, control: ControlMode) -> tuple[npt.ArrayLike, ActionSemantics]:
    """Return the commanded joints of a bag's actions, converted to a control mode in joint space."""
    actions, recorded = _from_bag(source)
    with _opened(source, STATE_TOPIC) as (reader, by_topic):
        robots = {int(state.seq): state.robot for state in _messages(reader, by_topic[STATE_TOPIC])}
    semantics = ActionSemantics(control=control, rate_hz=recorded.rate_hz)
    rows = []
    for seq in range(1, len(np.asarray(actions)) + 1):
        before, after = robots[seq - 1], robots[seq]
        target = Target(joints=tuple(after.joint_commands.tolist()), opening=float(after.gripper_command))
        context = ActionContext(joints_commanded=tuple(before.joint_commands.tolist()))
        rows.append(action_of(target, semantics, context))
    return rows, semantics


@contextmanager
def _opened(source: Path, topic: str = STEP_TOPIC) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Open a bag without ROS, since it contains its message definitions; yield the reader and its connections."""
    from rosbags.highlevel import AnyReader
    from rosbags.highlevel.anyreader import AnyReaderError

    try:
        with AnyReader([source]) as reader:
            by_topic = {c.topic.removeprefix("/"): c for c in reader.connections}
            if missing := {STEP_TOPIC, topic} - set(by_topic):
                raise ConfigError(f"{source}: no topic '{missing.pop()}'; is it a bag recorded by RoboXim?")
            yield reader, by_topic
    except (AnyReaderError, OSError) as error:
        raise ConfigError(f"{source} is not a readable bag: {error}") from None


def _messages(reader: Any, connection: Any) -> Iterator[Any]:
    for _, _, raw in reader.messages(connections=[connection]):
        yield reader.deserialize(raw, connection.msgtype)


def _semantics(reader: Any, connection: Any) -> ActionSemantics:
    for _, _, raw in reader.messages(connections=[connection]) if connection else ():
        semantics = reader.deserialize(raw, connection.msgtype).semantics
        try:
            return from_msg(semantics, ActionSemantics)
        except (AttributeError, InvalidRequestError) as error:
            raise ConfigError(
                f"the meaning of the bag's actions cannot be read ({error}); another version of RoboXim recorded it"
            ) from None
    return ActionSemantics()


def _from_dataset(source: Path, episode: int) -> tuple[npt.ArrayLike, ActionSemantics]:
    try:
        dataset = open_dataset(source)
        found = dataset.episode(episode)
        return found.actions(), require_semantics(found, dataset.path)
    except ConfigError as error:
        raise ConfigError(f"{source} has no recorded actions: {error}") from None
    except (RecorderError, InvalidRequestError) as error:
        raise ConfigError(str(error)) from None


def require_semantics(episode: Episode, path: Path) -> ActionSemantics:
    """Return the action semantics of a dataset's episode.

    Raises:
        ConfigError: When the dataset does not state them.
    """
    if episode.semantics is None:
        raise ConfigError(f"{path}: the dataset does not state its action semantics; RoboXim's exports do")
    return episode.semantics
