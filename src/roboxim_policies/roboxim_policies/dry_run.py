"""Finds typical faults of a policy's convention in a few answers.

The findings are hints: a model may hold still on purpose. The answers are compared with the convention's ranges and
with the expert's actions in the same situations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from roboxim_core.actions import ActionContext, ActionSemantics
from roboxim_core.actions.transforms import convert_rows
from roboxim_core.config_folders import config_names
from roboxim_core.conventions import Convention, decode_actions, from_actions, load_convention
from roboxim_core.conventions.images import Picture
from roboxim_core.errors import RoboximError
from roboxim_core.rotation.representations import Floats, encode, identity_rotation

SATURATED = 0.5
"""Smallest share of numbers at a bound at which answers count as saturated."""
SPEED_RATIO = 8.0
"""Ratio to the expert's mean speed from which on a speed is suspicious."""
JUMP_RAD = 0.5
"""Smallest suspicious distance of a commanded joint position from the measured one [rad]."""
BLANK = 2.0
"""Standard deviation of a picture's numbers, 0..255, below which it shows nothing."""
ORIENTATIONS = {
    (False, False): "upright",
    (True, False): "mirrored (left and right exchanged)",
    (True, True): "turned by 180 degrees",
    (False, True): "upside down (top and bottom exchanged)",
}
"""In words, whether left and right, and top and bottom, of a picture are exchanged, relative to what a camera sees."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RoundTrip:
    """What became of the expert's actions, sent backwards and forwards through a convention."""

    motion: float
    """Largest error of a translation [m]."""
    rotation: float
    """Largest error of a rotation's component [rad]."""
    opening: float
    """Largest error of the gripper's opening."""
    clipped: int
    """Number of actions with a number that the policy cannot say (``input_range``)."""
    count: int
    """Number of actions."""
    failure: str = ""
    """Why the actions cannot be expressed; empty: they can."""

    @property
    def is_exact(self) -> bool:
        """Whether the actions come back, up to rounding."""
        return not self.failure and not self.clipped and max(self.motion, self.rotation, self.opening) < 1e-4

    def __str__(self) -> str:
        """Return the result in words."""
        if self.failure:
            return f"the expert's actions cannot be expressed: {self.failure}"
        text = (
            f"{self.count} actions of the expert come back with errors of at most {self.motion:.1e} m, "
            f"{self.rotation:.1e} rad, {self.opening:.1e} of the opening"
        )
        clipped = f"; {self.clipped} of them are beyond the policy's range and would be clipped"
        return text + clipped * bool(self.clipped)


def round_trip(convention: Convention, actions: Floats, track: Sequence[ActionContext]) -> RoundTrip:
    """Send the expert's actions backwards and forwards through a convention.

    Args:
        convention: The convention.
        actions: Actions of RoboXim's default meaning, at the convention's rate, shape (n, 7).
        track: State of the arm before each action.
    """
    default = ActionSemantics(rate_hz=convention.rate_hz)
    try:
        raw = from_actions(convention, actions, track, source=default)
        back = decode_actions(convention, raw)
        if convention.semantics.differing(default):
            back = convert_rows(back, convention.semantics, default, track)
    except RoboximError as error:
        return RoundTrip(motion=0, rotation=0, opening=0, clipped=0, count=len(actions), failure=str(error))
    low, high = _bounds(convention)
    motion = raw[:, list(convention.action.order or range(convention.action.natural_size))[:-1]]
    inside = ((motion >= low - 1e-9) & (motion <= high + 1e-9)).all(axis=1)
    errors = np.abs(back - actions)[inside]
    return RoundTrip(
        motion=float(errors[:, :3].max(initial=0)), rotation=float(errors[:, 3:-1].max(initial=0)),
        opening=float(errors[:, -1].max(initial=0)), clipped=int((~inside).sum()), count=len(actions),
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Answers:
    """A policy's answers at several ticks of the expert's episode, and what the expert did there."""

    raw: Sequence[Floats]
    """The policy's numbers at each tick, each of shape (n, D)."""
    pictures: Mapping[str, Picture]
    """The pictures of the first request, by key, as they were sent."""
    upright: Mapping[str, Picture]
    """The same pictures as the camera sees them, resized alike but not mirrored."""
    expert: Floats
    """The expert's actions at these ticks, of RoboXim's default meaning, shape (ticks, 7)."""
    expert_speed: float
    """Mean speed of the expert's tool centre point in its episode [m/s]."""
    joints: Floats
    """Measured arm joint positions at these ticks, shape (ticks, joints) [rad]."""
    expert_joint_speed: float
    """Mean speed of the expert's arm joints in its episode, as the norm over all joints [rad/s]."""


def suspicions(convention: Convention, answers: Answers) -> list[str]:
    """Return in words what looks wrong; empty: nothing."""
    found = _of_pictures(convention, answers.pictures) + _of_orientation(convention, answers)
    raw = np.concatenate(list(answers.raw))
    firsts = np.stack([rows[0] for rows in answers.raw])
    if len(firsts) > 1 and float(np.ptp(firsts, axis=0).max()) == 0.0:
        found.append(
            f"constant: the answers to {len(firsts)} different observations are equal; does the server read the "
            "request?"
        )
    low, high = _bounds(convention)
    motion = raw[:, list(convention.action.order or range(convention.action.natural_size))[:-1]]
    share = float(((motion <= low) | (motion >= high)).mean())
    if share >= SATURATED:
        found.append(
            f"saturated: {share:.0%} of the numbers of motion are at or beyond the convention's bounds; is another "
            "scale or un-normalisation expected?"
        )
    decoded = decode_actions(convention, raw)
    found += _of_motion(convention, decoded, answers)
    found += _of_gripper(decode_actions(convention, firsts)[:, -1], answers.expert[:, -1])
    return found


def _bounds(convention: Convention) -> tuple[Floats, Floats]:
    """Return the lowest and the highest number of each component of the motion; infinite where there is no bound."""
    action = convention.action
    if action.control.is_joint_space:
        spans = [action.joint_range] * (action.natural_size - 1)
    else:
        spans = [action.translation_range] * 3 + [action.rotation_range] * action.rotation.size
    low, high = zip(*[span or (-np.inf, np.inf) for span in spans], strict=True)
    return np.array(low, dtype=float), np.array(high, dtype=float)


def _of_pictures(convention: Convention, pictures: Mapping[str, Picture]) -> list[str]:
    found = []
    for image in convention.images:
        picture = pictures.get(image.key)
        if picture is not None and float(np.std(picture)) < BLANK:
            found.append(f"picture '{image.key}' shows nothing: all of its pixels are nearly equal")
    return found


def proven(convention: Convention) -> Convention | None:
    """Return the convention whose proof holds for one: itself, or a shipped one of the same keys, rate and numbers."""
    if convention.proof:
        return convention
    shipped = (load_convention(name) for name in config_names("conventions"))
    return next((other for other in shipped if other.proof and _family(other) == _family(convention)), None)


def _family(convention: Convention) -> tuple[object, ...]:
    """Return what conventions of one family have in common."""
    action = convention.action
    keys = {image.key for image in convention.images} | {state.key for state in convention.states}
    return keys, convention.rate_hz, action.rotation, action.gripper.open, action.gripper.closed


def orientation(sent: Picture, upright: Picture) -> tuple[bool, bool]:
    """Return whether left and right, and top and bottom, of a sent picture are exchanged; found in its pixels."""

    def difference(exchanged: tuple[bool, bool]) -> float:
        sides, ends = (-1 if exchange else 1 for exchange in exchanged)
        return float(np.abs(sent.astype(int) - upright[::ends, ::sides]).mean())

    return min(ORIENTATIONS, key=difference)


def _of_orientation(convention: Convention, answers: Answers) -> list[str]:
    """Compare how the pictures lie with the proof of the family."""
    family = proven(convention)
    if family is None or family.proof is None:
        return []
    found = []
    for image in family.images:
        lies = orientation(answers.pictures[image.key], answers.upright[image.key])
        if lies != (image.mirror, image.upside_down):
            found.append(
                f"picture '{image.key}' is sent {ORIENTATIONS[lies]}; the genuine client sends it "
                f"{ORIENTATIONS[image.mirror, image.upside_down]} ({family.proof.client}, compared on "
                f"{family.proof.date}, convention '{family.name}'). Give it mirror: {str(image.mirror).lower()} and "
                f"upside_down: {str(image.upside_down).lower()}"
            )
    return found


def _of_motion(convention: Convention, decoded: Floats, answers: Answers) -> list[str]:
    meaning = convention.semantics
    if meaning.control.is_joint_space:
        return _of_joints(convention, decoded[:, :-1], answers)
    if meaning.control == "end_effector_absolute":
        far = float(np.linalg.norm(decoded[:, :3], axis=1).max())
        return [f"a commanded position is {far:.2g} m away from the robot's base: wrong unit or frame?"] * (far > 2.0)
    mean = float(np.linalg.norm(decoded[:, :3], axis=1).mean())
    if mean > meaning.max_translation_m:
        found = [
            f"un-normalised? the mean motion is {mean:.2g} m per tick, the convention allows "
            f"{meaning.max_translation_m:g} m; the numbers may still be normalised (unnorm_key, normalisation), or in "
            "another unit"
        ]
    else:
        found = _of_speed(mean, meaning.rate_hz, answers.expert_speed, "m/s")
    identity = encode(identity_rotation(), meaning.rotation)
    if float(np.abs(decoded[:, 3:-1] - identity).max()) == 0.0:
        found.append("all rotations are exactly zero: are they left out, or at other places of the action?")
    return found


def _of_joints(convention: Convention, motion: Floats, answers: Answers) -> list[str]:
    """Check positions by their distance from the arm's, and motions by their speed."""
    meaning, count = convention.semantics, answers.joints.shape[1]
    if motion.shape[1] != count:
        return [f"the convention commands {motion.shape[1]} joints, the robot has {count}"]
    if meaning.control == "joint_position":
        firsts = decode_actions(convention, np.stack([rows[0] for rows in answers.raw]))[:, :-1]
        jump = float(np.abs(firsts - answers.joints).max())
        if jump <= JUMP_RAD:
            return []
        return [
            f"un-normalised? a joint is commanded to a position {jump:.2g} rad away from it; the numbers may still be "
            "normalised, deltas, in another unit, or in another order of the joints"
        ]
    mean = float(np.linalg.norm(motion, axis=1).mean())
    return _of_speed(
        mean, 1.0 if meaning.control == "joint_velocity" else meaning.rate_hz, answers.expert_joint_speed, "rad/s"
    )


def _of_speed(mean: float, per_second: float, expert: float, unit: str) -> list[str]:
    """Compare the mean of motions with the expert's speed; motions of any rate (0 per second) have no speed."""
    if mean == 0.0:
        return ["the arm does not move in any answer"]
    speed = mean * per_second
    if not per_second or expert <= 0 or 1 / SPEED_RATIO <= speed / expert <= SPEED_RATIO:
        return []
    rate = f"; the convention states {per_second:g} Hz" if per_second != 1.0 else ""
    return [f"wrong rate or scale? the mean speed is {speed:.2g} {unit}, the expert's {expert:.2g} {unit}{rate}"]


def _of_gripper(openings: Floats, expert: Floats) -> list[str]:
    clear = np.abs(openings - 0.5) > 0.2
    if clear.sum() < 2:
        return []
    opposite = (openings[clear] > 0.5) != (expert[clear] > 0.5)
    if not opposite.all():
        return []
    return [
        f"inverted gripper? in all {int(clear.sum())} situations it is open where the expert's is closed and vice versa"
    ]
