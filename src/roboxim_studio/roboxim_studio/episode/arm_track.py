"""The poses of an arm in an episode of any dataset, if it states joint positions of an arm that is known here.

Formats name robots and joints freely. Nothing is guessed: the arm must be named, or chosen by a person, and every
position must lie within its limits. So degrees, other zero positions and other arms are refused.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from roboxim_core.models.description import RobotModel
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_core.state import RobotState
from roboxim_datasets.episode import Episode, Step

ALIASES = (
    ("fr3", "fr3"), ("franka", "panda"), ("kuka", "iiwa14"), ("iiwa", "iiwa14"), ("kinova", "gen3"), ("xarm", "xarm7"),
)  # fmt: skip
"""Words in the names that datasets give to arms, and the arms that they mean; the first that fits counts."""
UNLIKE = ("ur5e", "gen2", "jaco", "xarm5", "xarm6", "iiwa7")
"""Words in the names of arms that only look like one that is known here."""
JOINT_VECTORS = (
    "joint_positions", "joint_position", "joint_pos", "joint_states", "joint_state", "joints", "qpos",
    "robot0_joint_pos",
)  # fmt: skip
"""Names of vectors that hold the arm's joint positions first, and perhaps fingers after them."""
MAX_FINGERS = 2
NO_POSITIONS = ("vel", "effort", "torque")
"""Words in the names of vectors that hold something else of each joint."""
SUFFIX = re.compile(r"[._](pos|position|positions|qpos)$")
NUMBERED = re.compile(r"(?:^|[._/])(?:joint|j|q)[._]?(\d+)$")
SLACK_RAD = 0.05
"""How far beyond its limits a measured joint may be [rad]."""
OPENING = "gripper.opening"


@dataclass(frozen=True, kw_only=True)
class ArmTrack:
    """Where an arm is at every step of an episode."""

    model: RobotModel
    """The arm."""
    joints: npt.NDArray[np.float64]
    """Joint positions at every step, shape (steps, joints) [rad]."""
    opening: npt.NDArray[np.float64] | None
    """Opening of the gripper at every step, shape (steps,), 1 = open; None: none under RoboXim's name."""
    source: str
    """The vector that they are from."""

    def state(self, step: int) -> RobotState:
        """Return the arm at a step, as a state record has it; without velocities, and without poses of the tool."""
        joints = tuple(float(value) for value in self.joints[step])
        opening = 1.0 if self.opening is None else float(np.clip(self.opening[step], 0.0, 1.0))
        fingers = (self.model.gripper.driven(opening),) * len(self.model.gripper.joint_names)
        return RobotState(
            joint_names=self.model.joint_names, joint_positions=joints, joint_velocities=(0.0,) * len(joints),
            joint_commands=joints, pose_tcp_measured=Pose(), pose_tcp_commanded=Pose(), gripper_opening=opening,
            gripper_command=opening, finger_positions=fingers,
        )  # fmt: skip


def named_arm(episode: Episode, library: ModelLibrary) -> str:
    """Return the id of the arm that an episode names, by its robot or by its joints; empty: none that is known."""
    word = re.sub(r"[^a-z0-9]", "", episode.robot.lower())
    if any(unlike in word for unlike in UNLIKE):
        return ""
    for known, arm in (*((name, name) for name in library.robot_ids), *ALIASES):
        if known in word and arm in library.robot_ids:
            return arm
    stated = {_base(name) for names in (episode.joint_names, *episode.vectors.values()) for name in names}
    fits = [name for name in library.robot_ids if set(library.robot(name).joint_names) <= stated]
    return fits[0] if len(fits) == 1 else ""


def arms_that_fit(episode: Episode, rows: Sequence[Step], library: ModelLibrary) -> tuple[str, ...]:
    """Return the arms whose joints an episode may be about, for a person to choose from."""
    found = (name for name in library.robot_ids if isinstance(arm_track(episode, rows, library.robot(name)), ArmTrack))
    return tuple(found)


def arm_track(episode: Episode, rows: Sequence[Step], model: RobotModel) -> ArmTrack | str:
    """Return the poses of an arm at every step, or why they are unknown.

    Args:
        episode: The episode.
        rows: All of its steps, without pictures.
        model: The arm.
    """
    count, reasons = len(model.joint_names), []
    for name, places in _sources(episode, rows, model):
        joints = np.array([row.proprio[name][places] for row in rows], dtype=float).reshape(-1, count)
        low, high = (np.array(ends) for ends in (model.limits.lower, model.limits.upper))
        beyond = np.argwhere(~((joints >= low - SLACK_RAD) & (joints <= high + SLACK_RAD)))
        if not len(beyond):
            return ArmTrack(model=model, joints=joints, opening=_opening(episode, rows), source=name)
        step, joint = (int(number) for number in beyond[0])
        reasons.append(
            f"'{name}' is not in radians, or not this arm's: joint {joint + 1} is {joints[step, joint]:.3g} at step "
            f"{step}, {model.id} has {low[joint]:.2f} to {high[joint]:.2f} rad"
        )
    return "; ".join(reasons) or f"it states no positions of {count} joints, which {model.id} has"


def _sources(episode: Episode, rows: Sequence[Step], model: RobotModel) -> Iterable[tuple[str, list[int]]]:
    """Yield the vectors that may hold the joint positions, with the places of the joints in them."""
    if not rows:
        return
    count = len(model.joint_names)
    vectors: Mapping[str, Any] = {
        name: episode.vectors.get(name, ())
        for name in rows[0].proprio
        if not any(word in name for word in NO_POSITIONS)
    }
    for name, parts in vectors.items():
        places = _by_names([_base(part) for part in parts], model)
        if places:
            yield name, places
    for name in vectors:
        plain = name.rpartition("/")[2].rpartition(".")[2]
        size = len(rows[0].proprio[name])
        if plain in JOINT_VECTORS and count <= size <= count + MAX_FINGERS:
            yield name, list(range(count))


def _by_names(parts: Sequence[str], model: RobotModel) -> list[int]:
    """Return the places of an arm's joints among the names of a vector's components; empty: not all are there."""
    found = []
    for joint in model.joint_names:
        places = [n for n, part in enumerate(parts) if part and (joint == part or joint.endswith(f"_{part}"))]
        if len(places) == 1:
            found.append(places[0])
    if len(found) == len(model.joint_names):
        return found
    numbered = {int(match[1]): place for place, part in enumerate(parts) if (match := NUMBERED.search(part))}
    first = min(numbered, default=0)
    wanted = list(range(first, first + len(model.joint_names)))
    return [numbered[number] for number in wanted] if first in (0, 1) and sorted(numbered) == wanted else []


def _base(name: str) -> str:
    """Return the name of a component without what says that it is a position."""
    return SUFFIX.sub("", name.rpartition("/")[2])


def _opening(episode: Episode, rows: Sequence[Step]) -> npt.NDArray[np.float64] | None:
    for name, parts in episode.vectors.items():
        if OPENING in parts and name in rows[0].proprio:
            place = parts.index(OPENING)
            return np.array([row.proprio[name][place] for row in rows], dtype=float)
    return None
