"""What an action means, as a value that travels with every dataset, policy and evaluation.

Every field is a closed set of values or a number. `roboxim_core.actions.transforms` converts actions of one meaning
into those of another.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from roboxim_core.errors import ErrorCode, EvaluationError, InvalidRequestError, one_of
from roboxim_core.rates import ANY_RATE, DEFAULT_RATE_HZ
from roboxim_core.rotations import RotationRepresentation


class _Closed(StrEnum):
    @classmethod
    def _missing_(cls, value: object) -> None:
        raise ValueError(f"unknown value {value!r}; {one_of(list(cls), str(value))}")


class ControlMode(_Closed):
    """What an action commands."""

    END_EFFECTOR_DELTA = "end_effector_delta"
    """Motion of the tool centre point in a tick."""
    END_EFFECTOR_ABSOLUTE = "end_effector_absolute"
    """Pose of the tool centre point at the end of the tick, in the robot's base."""
    JOINT_POSITION = "joint_position"
    """Arm joint positions at the end of the tick [rad]."""
    JOINT_VELOCITY = "joint_velocity"
    """Arm joint velocities during the tick [rad/s]."""
    JOINT_DELTA = "joint_delta"
    """Motion of the arm joints in the tick [rad]."""

    @property
    def is_joint_space(self) -> bool:
        """Whether the arm's joints are commanded rather than the tool centre point."""
        return self in (ControlMode.JOINT_POSITION, ControlMode.JOINT_VELOCITY, ControlMode.JOINT_DELTA)

    @property
    def is_relative(self) -> bool:
        """Whether the target depends on where the arm is."""
        return self not in (ControlMode.END_EFFECTOR_ABSOLUTE, ControlMode.JOINT_POSITION)


class ReferenceFrame(_Closed):
    """Frame that a motion or pose of the tool centre point is expressed in."""

    ROBOT_BASE = "robot_base"
    """The base: p_next = p + dp, R_next = dR R."""
    TOOL = "tool"
    """The tool before the tick: p_next = p + R dp, R_next = R dR. Only for deltas."""
    NONE = "none"
    """Joint space."""


class GripperConvention(_Closed):
    """Polarity and range of the gripper's number, the last of an action; linear in the total opening."""

    ABSOLUTE_OPEN_1_CLOSED_0 = "absolute_open_1_closed_0"
    ABSOLUTE_OPEN_0_CLOSED_1 = "absolute_open_0_closed_1"
    ABSOLUTE_OPEN_1_CLOSED_MINUS_1 = "absolute_open_1_closed_minus_1"
    ABSOLUTE_OPEN_MINUS_1_CLOSED_1 = "absolute_open_minus_1_closed_1"

    @property
    def open_value(self) -> float:
        """The number that opens."""
        return _GRIPPER[self][0]

    @property
    def closed_value(self) -> float:
        """The number that closes."""
        return _GRIPPER[self][1]

    def opening(self, value: float) -> float:
        """Return the opening, 1 = open, that a number means. Numbers beyond the range are not clipped."""
        return (value - self.closed_value) / (self.open_value - self.closed_value)

    def number(self, opening: float) -> float:
        """Return the number that means an opening, 1 = open."""
        return self.closed_value + opening * (self.open_value - self.closed_value)


_GRIPPER = {
    GripperConvention.ABSOLUTE_OPEN_1_CLOSED_0: (1.0, 0.0),
    GripperConvention.ABSOLUTE_OPEN_0_CLOSED_1: (0.0, 1.0),
    GripperConvention.ABSOLUTE_OPEN_1_CLOSED_MINUS_1: (1.0, -1.0),
    GripperConvention.ABSOLUTE_OPEN_MINUS_1_CLOSED_1: (-1.0, 1.0),
}


class DeltaBase(_Closed):
    """What a relative action adds to."""

    COMMANDED = "commanded"
    """The commanded pose or joints: the arm's lag and injected noise do not accumulate."""
    MEASURED = "measured"
    """The measured ones."""
    NONE = "none"
    """The action is absolute."""


@dataclass(frozen=True, kw_only=True)
class ActionSemantics:
    """Meaning of an action vector. The default is the only one that the simulator executes.

    Strings are taken for the enumerations' values. A field that the control mode does not use becomes ``none``, so that
    equal meanings are equal values.
    """

    control: ControlMode = ControlMode.END_EFFECTOR_DELTA
    """What is commanded."""
    frame: ReferenceFrame = ReferenceFrame.ROBOT_BASE
    """Frame that a motion of the tool centre point is expressed in."""
    rotation: RotationRepresentation = RotationRepresentation.EULER_XYZ_EXTRINSIC
    """Representation of its rotation."""
    gripper: GripperConvention = GripperConvention.ABSOLUTE_OPEN_1_CLOSED_0
    """Polarity and range of the gripper's number."""
    delta_base: DeltaBase = DeltaBase.COMMANDED
    """What a relative action adds to."""
    rate_hz: float = DEFAULT_RATE_HZ
    """Control rate [Hz]; must divide the physics rate. 0 (`ANY_RATE`): whatever rate the run has."""
    max_translation_m: float = 0.05
    """Largest translation per tick, as a distance [m]; more is clipped and counted."""
    max_rotation_rad: float = 0.25
    """Largest rotation per tick, as an angle [rad]; more is clipped and counted."""

    def __post_init__(self) -> None:
        """Check the values, and set fields that the control mode does not use to ``none``.

        Raises:
            InvalidRequestError: On an unknown value, a combination without meaning, or a number out of range.
        """
        for name, kind in _ENUMERATIONS.items():
            try:
                object.__setattr__(self, name, kind(getattr(self, name)))
            except ValueError as error:
                raise InvalidRequestError(f"{name}: {error}") from None
        unused: dict[str, StrEnum] = {}
        if self.control.is_joint_space:
            unused |= {"frame": ReferenceFrame.NONE, "rotation": RotationRepresentation.NONE}
        if not self.control.is_relative:
            unused["delta_base"] = DeltaBase.NONE
        for name in ("frame", "rotation", "delta_base"):
            if name in unused:
                object.__setattr__(self, name, unused[name])
            elif getattr(self, name) == "none":
                raise InvalidRequestError(f"{name}: control '{self.control}' needs one, got 'none'")
        if self.control == ControlMode.END_EFFECTOR_ABSOLUTE and self.frame == ReferenceFrame.TOOL:
            raise InvalidRequestError(
                "frame: an absolute pose in the tool's own frame has no meaning; use 'robot_base', or "
                "control 'end_effector_delta'"
            )
        for name, positive in (("rate_hz", False), ("max_translation_m", True), ("max_rotation_rad", True)):
            value = getattr(self, name)
            if not (math.isfinite(value) and (value > 0 or (value == 0 and not positive))):
                raise InvalidRequestError(f"{name}: must be {'> 0' if positive else '>= 0'} and finite, got {value}")

    def dimension(self, robot_joints: int = 0) -> int:
        """Return the count of an action's numbers.

        Args:
            robot_joints: Arm joints of the robot; needed in joint space only.

        Raises:
            InvalidRequestError: In joint space without a number of joints.
        """
        if self.control.is_joint_space:
            if robot_joints < 1:
                raise InvalidRequestError(f"the size of an action of control '{self.control}' depends on the robot")
            return robot_joints + 1
        return 3 + self.rotation.size + 1

    def component_names(self, joint_names: Sequence[str] = ()) -> tuple[str, ...]:
        """Return the names of an action's numbers, e.g. ``dx`` or ``panda_joint1.velocity``.

        Args:
            joint_names: Arm joints of the robot; needed in joint space only.
        """
        if self.control.is_joint_space:
            self.dimension(len(joint_names))
            kind = self.control.value.removeprefix("joint_")
            return (*(f"{name}.{kind}" for name in joint_names), "gripper")
        prefix = "d" if self.control.is_relative else ""
        return (*(f"{prefix}{name}" for name in ("x", "y", "z", *self.rotation.component_names)), "gripper")

    def differing(self, other: ActionSemantics) -> tuple[str, ...]:
        """Return the fields that give an action another meaning; limits may differ, and `ANY_RATE` fits every rate."""
        names = [name for name in _ENUMERATIONS if getattr(self, name) != getattr(other, name)]
        if self.rate_hz != other.rate_hz and ANY_RATE not in (self.rate_hz, other.rate_hz):
            names.append("rate_hz")
        return tuple(names)

    def require_compatible(self, other: ActionSemantics, *, mine: str, theirs: str) -> None:
        """Refuse a mismatch of meaning or rate; the limits may differ.

        Args:
            other: The other side's semantics.
            mine: What this one belongs to, for the message, e.g. ``"policy 'bc'"``.
            theirs: What the other belongs to.

        Raises:
            EvaluationError: With code ``SEMANTICS_MISMATCH``, naming every differing field and whether a transform
                exists.
        """
        if differing := self.differing(other):
            fields = "; ".join(
                f"{name}: {_shown(getattr(self, name))} against {_shown(getattr(other, name))}" for name in differing
            )
            raise EvaluationError(
                f"action semantics of {mine} and {theirs} differ ({fields}); {_advice(self, other)}",
                ErrorCode.SEMANTICS_MISMATCH,
            )


_ENUMERATIONS: dict[str, type[StrEnum]] = {
    "control": ControlMode,
    "frame": ReferenceFrame,
    "rotation": RotationRepresentation,
    "gripper": GripperConvention,
    "delta_base": DeltaBase,
}


def _shown(value: StrEnum | float) -> str:
    return repr(value.value) if isinstance(value, StrEnum) else repr(value)


def _advice(source: ActionSemantics, target: ActionSemantics) -> str:
    if "rate_hz" in source.differing(target):
        return "no transform exists: an action of one rate is none of another; run both at the same rate"
    crosses = source.control.is_joint_space != target.control.is_joint_space
    return (
        f"a transform exists{' that needs the kinematics of the robot' if crosses else ''}: convert the actions with "
        "roboxim_core.actions.ActionTransform.between, or declare the same semantics on both sides"
    )
