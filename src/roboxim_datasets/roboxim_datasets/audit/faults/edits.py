"""Faults that an edit of recorded values plants."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from roboxim_core.actions import ControlMode
from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.documents import parse_json
from roboxim_core.rotation.representations import RotationRepresentation
from roboxim_datasets.audit.faults.values import DATASET_FAULTS, DatasetFault, EditableEpisode
from roboxim_datasets.episode import Episode, Floats

QUATERNIONS = (RotationRepresentation.QUATERNION_XYZW, RotationRepresentation.QUATERNION_WXYZ)


def _middle(episode: EditableEpisode, rng: np.random.Generator) -> int:
    """Return a tick in the middle half of an episode with some ticks after it."""
    quarter = len(episode) // 4
    return int(rng.integers(quarter, max(quarter + 1, 3 * quarter - 1)))


@DATASET_FAULTS.register("wrong_instruction")
class WrongInstruction(DatasetFault):
    """The instruction of another episode."""

    title = "the instruction of another episode"
    found_by = "wrong_instruction"

    def edit(self, episode: EditableEpisode, others: Sequence[Episode], rng: np.random.Generator) -> str:
        """Take the instruction of an episode with another task."""
        own_task = _task(episode.episode)
        for place in rng.permutation(len(others)):
            other = others[int(place)]
            if other.instruction != episode.instruction and (_task(other) != own_task or not own_task):
                before, episode.instruction = episode.instruction, other.instruction
                return f"'{other.instruction}' instead of '{before}'"
        return ""


def _task(episode: Episode) -> str:
    """Return the skill and the named objects of an episode's recorded task; empty: it is not known."""
    try:
        task = parse_json(str(episode.metadata["task"]), source="task")
        things = {role: thing["model"] for role, thing in task["objects"].items() if "distractor" not in role}
        modifiers = {role: task["objects"][role]["modifiers"] for role in things}
        words = [value for value in task["arguments"].values() if isinstance(value, str)]
        return f"{task['skill']} {things} {modifiers} {words}"
    except (ConfigError, KeyError, TypeError, AttributeError):
        return ""


@DATASET_FAULTS.register("rotation_jump")
class RotationJump(DatasetFault):
    """Labels of the same rotations with other numbers."""

    title = "rotation labels that jump by a full turn, or quaternions that flip"
    found_by = "rotation_jump"

    def edit(self, episode: EditableEpisode, others: Sequence[Episode], rng: np.random.Generator) -> str:
        """Add a turn to the rotation of every label from a tick in the middle on, or change the quaternion's sign."""
        semantics = episode.episode.semantics
        kinds = (ControlMode.END_EFFECTOR_DELTA, ControlMode.END_EFFECTOR_ABSOLUTE)
        if semantics is None or semantics.control not in kinds or len(episode) < 4:
            return ""
        tick, kind = _middle(episode, rng), semantics.rotation
        part = slice(3, 3 + kind.size)
        episode.actions = episode.actions.copy()
        if kind in QUATERNIONS:
            episode.actions[tick:, part] *= -1
            return f"the quaternion flips at tick {tick}"
        if kind in (RotationRepresentation.EULER_XYZ_EXTRINSIC, RotationRepresentation.EULER_XYZ_INTRINSIC):
            component = 3 + int(rng.integers(3))
            sign = 1.0 if float(episode.actions[tick:, component].mean()) < 0 else -1.0
            episode.actions[tick:, component] += np.float32(sign * 2 * math.pi)
            return f"component {component} jumps by {sign * 2 * math.pi:.2f} at tick {tick}"
        if kind == RotationRepresentation.ROTATION_VECTOR:
            vectors = episode.actions[tick:, part]
            angles = np.linalg.norm(vectors, axis=1, keepdims=True)
            axes = np.where(angles > 1e-6, vectors / np.maximum(angles, 1e-6), np.array([1.0, 0.0, 0.0], np.float32))
            episode.actions[tick:, part] = axes * (angles - 2 * math.pi)
            return f"the rotation vector goes the other way round from tick {tick}"
        return ""


@DATASET_FAULTS.register("idle")
class Idle(DatasetFault):
    """Ticks in which nothing moves."""

    title = "two seconds of rest in the middle"
    found_by = "idle"
    keeps_length = False

    def edit(self, episode: EditableEpisode, others: Sequence[Episode], rng: np.random.Generator) -> str:
        """Repeat a step with an action that commands no motion."""
        semantics = episode.episode.semantics
        if semantics is None or not semantics.control.is_relative:
            return ""
        tick, count = _middle(episode, rng), round(2 * (episode.episode.fps or semantics.rate_hz or 10.0))
        held = episode.actions[tick].copy()
        held[:-1] = 0.0
        episode.take([*range(tick), *[tick] * count, *range(tick, len(episode))])
        for actions in (episode.actions, episode.executed):
            if actions is not None:
                actions[tick : tick + count] = held
        return f"{count} ticks of rest from tick {tick}"


@DATASET_FAULTS.register("saturation")
class Saturation(DatasetFault):
    """Labels that are larger than the limits, and clipped."""

    title = "labels three times as large, clipped at the limits"
    found_by = "saturation"

    def edit(self, episode: EditableEpisode, others: Sequence[Episode], rng: np.random.Generator) -> str:
        """Scale and clip translations."""
        semantics = episode.episode.semantics
        if semantics is None or semantics.control != ControlMode.END_EFFECTOR_DELTA:
            return ""
        moved = episode.actions[:, :3] * np.float32(3.0)
        lengths = np.linalg.norm(moved, axis=1, keepdims=True)
        limit = np.float32(semantics.max_translation_m)
        episode.actions = episode.actions.copy()
        episode.actions[:, :3] = moved * np.minimum(1.0, limit / np.maximum(lengths, 1e-9))
        clipped = int((lengths >= limit).sum())
        return f"{clipped} translations clipped at {limit:g} m" if clipped > 0.06 * len(episode) else ""


@DATASET_FAULTS.register("gripper_inverted")
class GripperInverted(DatasetFault):
    """Labels of the gripper with the other polarity."""

    title = "the gripper's labels inverted"
    found_by = "gripper"

    def edit(self, episode: EditableEpisode, others: Sequence[Episode], rng: np.random.Generator) -> str:
        """Exchange open and closed."""
        semantics, opening = episode.episode.semantics, _gripper_opening(episode)
        if semantics is None or opening is None or np.ptp(episode.actions[:, -1]) < 0.5 or np.ptp(opening) < 0.2:
            return ""
        convention = semantics.gripper
        episode.actions = episode.actions.copy()
        episode.actions[:, -1] = convention.open_value + convention.closed_value - episode.actions[:, -1]
        return "open and closed are exchanged"


@DATASET_FAULTS.register("gripper_range")
class GripperRange(DatasetFault):
    """Labels of the gripper in other units."""

    title = "the gripper's labels in millimetres"
    found_by = "gripper"

    def edit(self, episode: EditableEpisode, others: Sequence[Episode], rng: np.random.Generator) -> str:
        """Multiply by 80."""
        if not np.abs(episode.actions[:, -1]).max() > 0.1:
            return ""
        episode.actions = episode.actions.copy()
        episode.actions[:, -1] *= 80.0
        return "the gripper's labels are multiplied by 80"


def _gripper_opening(episode: EditableEpisode) -> Floats | None:
    place = episode.column("gripper.opening")
    return episode.proprio[place[0]][:, place[1]] if place else None


@DATASET_FAULTS.register("state_lag")
class StateLag(DatasetFault):
    """Images that are ahead of the state."""

    title = "images two ticks ahead of the state"
    found_by = "state_lag"
    ticks = 2

    def edit(self, episode: EditableEpisode, others: Sequence[Episode], rng: np.random.Generator) -> str:
        """Shift every camera's images."""
        if not episode.images or len(episode) < 24 or _position(episode) is None:
            return ""
        for camera, images in episode.images.items():
            episode.images[camera] = [*images[self.ticks :], *images[-1:] * self.ticks]
        return f"images {self.ticks} ticks ahead"


def _position(episode: EditableEpisode) -> Floats | None:
    places = [episode.column(f"tcp.{axis}") for axis in "xyz"]
    found = [episode.proprio[place[0]][:, place[1]] for place in places if place is not None]
    return np.stack(found, axis=1) if len(found) == 3 else None


@DATASET_FAULTS.register("frozen_camera")
class FrozenCamera(DatasetFault):
    """A camera that repeats an image."""

    title = "a camera that stands still for six ticks"
    found_by = "frozen_camera"
    ticks = 6

    def edit(self, episode: EditableEpisode, others: Sequence[Episode], rng: np.random.Generator) -> str:
        """Repeat the image of a tick at which the hand moves."""
        position = _position(episode)
        if not episode.images or position is None or len(episode) <= self.ticks:
            return ""
        moved = np.linalg.norm(position[self.ticks - 1 :] - position[: 1 - self.ticks], axis=1)
        starts = np.flatnonzero(moved > 0.02)
        if not len(starts):
            return ""
        start = int(rng.choice(starts))
        camera = sorted(episode.images)[int(rng.integers(len(episode.images)))]
        images = list(episode.images[camera])
        images[start : start + self.ticks] = [images[start]] * self.ticks
        episode.images[camera] = images
        return f"{camera} shows tick {start} for {self.ticks} ticks"


@DATASET_FAULTS.register("blank_camera")
class BlankCamera(DatasetFault):
    """Images without content."""

    title = "a camera that is black for three ticks"
    found_by = "blank_camera"
    ticks = 3

    def edit(self, episode: EditableEpisode, others: Sequence[Episode], rng: np.random.Generator) -> str:
        """Make images black."""
        if not episode.images or len(episode) < self.ticks:
            return ""
        camera = sorted(episode.images)[int(rng.integers(len(episode.images)))]
        start = int(rng.integers(len(episode) - self.ticks + 1))
        images = list(episode.images[camera])
        images[start : start + self.ticks] = [np.zeros_like(images[start])] * self.ticks
        episode.images[camera] = images
        return f"{camera} is black from tick {start} on for {self.ticks} ticks"


@DATASET_FAULTS.register("joint_limits")
class JointLimits(DatasetFault):
    """Joint positions in degrees."""

    title = "joint positions in degrees"
    found_by = "kinematics"

    def edit(self, episode: EditableEpisode, others: Sequence[Episode], rng: np.random.Generator) -> str:
        """Convert radians to degrees."""
        places = [episode.column(f"{name}.position") for name in episode.episode.joint_names]
        if not places or None in places:
            return ""
        for vector, place in (place for place in places if place is not None):
            episode.proprio[vector] = episode.proprio[vector].copy()
            episode.proprio[vector][:, place] *= np.float32(180 / math.pi)
        return "the joint positions are in degrees"


@DATASET_FAULTS.register("outlier")
class Outlier(DatasetFault):
    """A single wild number."""

    title = "one label of a metre"
    found_by = "statistics"

    def edit(self, episode: EditableEpisode, others: Sequence[Episode], rng: np.random.Generator) -> str:
        """Set a component of one label."""
        tick, component = _middle(episode, rng), int(rng.integers(3))
        episode.actions = episode.actions.copy()
        episode.actions[tick, component] = 1.0
        return f"action[{component}] is 1 at tick {tick}"


@DATASET_FAULTS.register("wrong_execution")
class WrongExecution(DatasetFault):
    """Executed actions that were not executed."""

    title = "one executed action 2 cm off"
    found_by = "replay"

    def edit(self, episode: EditableEpisode, others: Sequence[Episode], rng: np.random.Generator) -> str:
        """Change an executed action."""
        if episode.executed is None:
            return ""
        tick = _middle(episode, rng)
        episode.executed = episode.executed.copy()
        episode.executed[tick, 0] += 0.02
        return f"the executed action of tick {tick} is 2 cm off"
