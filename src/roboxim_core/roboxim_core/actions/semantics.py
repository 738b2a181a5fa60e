"""The meaning of an action, as a value that every dataset, policy and evaluation carries.

Every field is a number or a member of a closed enumeration. `roboxim_core.actions.transforms` converts actions between
meanings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import ClassVar

from roboxim_core.errors import ErrorCode, EvaluationError, InvalidRequestError
from roboxim_core.plain_data.closed_enum import ClosedEnum
from roboxim_core.rates import ANY_RATE, DEFAULT_RATE_HZ
from roboxim_core.rotation.representations import RotationRepresentation


class ControlMode(ClosedEnum):
    """Quantity that an action commands."""

    END_EFFECTOR_DELTA = "end_effector_delta"
    """Motion of the tool centre point during the tick."""
    END_EFFECTOR_ABSOLUTE = "end_effector_absolute"
    """Pose of the tool centre point at the end of the tick, in the robot's base."""
    JOINT_POSITION = "joint_position"
    """Arm joint positions at the end of the tick [rad]."""
    JOINT_VELOCITY = "joint_velocity"
    """Arm joint velocities during the tick [rad/s]."""
    JOINT_DELTA = "joint_delta"
    """Motion of the arm joints during the tick [rad]."""

    @property
    def is_joint_space(self) -> bool:
        """Whether actions command the arm's joints rather than the tool centre point."""
        return self in (ControlMode.JOINT_POSITION, ControlMode.JOINT_VELOCITY, ControlMode.JOINT_DELTA)

    @property
    def is_relative(self) -> bool:
        """Whether the target depends on the arm's state before the action."""
        return self not in (ControlMode.END_EFFECTOR_ABSOLUTE, ControlMode.JOINT_POSITION)


class ReferenceFrame(ClosedEnum):
    """Frame that a motion or pose of the tool centre point is expressed in."""

    ROBOT_BASE = "robot_base"
    """The base: p_next = p + dp, R_next = dR R."""
    TOOL = "tool"
    """The tool before the tick: p_next = p + R dp, R_next = R dR. Only for deltas."""
    NONE = "none"
    """Joint space."""


class GripperConvention(ClosedEnum):
    """Polarity and range of the gripper component, the last one of an action; linear in the total opening."""

    ABSOLUTE_OPEN_1_CLOSED_0 = "absolute_open_1_closed_0"
    ABSOLUTE_OPEN_0_CLOSED_1 = "absolute_open_0_closed_1"
    ABSOLUTE_OPEN_1_CLOSED_MINUS_1 = "absolute_open_1_closed_minus_1"
    ABSOLUTE_OPEN_MINUS_1_CLOSED_1 = "absolute_open_minus_1_closed_1"

    @property
    def open_value(self) -> float:
        """The value of a fully open gripper."""
        return _GRIPPER[self][0]

    @property
    def closed_value(self) -> float:
        """The value of a closed gripper."""
        return _GRIPPER[self][1]

    def opening(self, value: float) -> float:
        """Return the opening, 1 = open, for a value of this convention. Values outside the range are not clipped."""
        return (value - self.closed_value) / (self.open_value - self.closed_value)

    def number(self, opening: float) -> float:
        """Return the value of this convention for an opening, 1 = open."""
        return self.closed_value + opening * (self.open_value - self.closed_value)


_GRIPPER = {
    GripperConvention.ABSOLUTE_OPEN_1_CLOSED_0: (1.0, 0.0),
    GripperConvention.ABSOLUTE_OPEN_0_CLOSED_1: (0.0, 1.0),
    GripperConvention.ABSOLUTE_OPEN_1_CLOSED_MINUS_1: (1.0, -1.0),
    GripperConvention.ABSOLUTE_OPEN_MINUS_1_CLOSED_1: (-1.0, 1.0),
}


class DeltaBase(ClosedEnum):
    """State that a relative action is added to."""

    COMMANDED = "commanded"
    """The commanded pose or joints: the arm's lag and injected noise do not accumulate."""
    MEASURED = "measured"
    """The measured ones."""
    NONE = "none"
    """The action is absolute."""


@dataclass(frozen=True, kw_only=True)
class ActionSemantics:
    """Meaning of an action vector. The simulator executes those that `executed` returns.

    Strings are converted to the enumerations. A field that the control mode does not use becomes ``none``, so that
    equal meanings compare equal.
    """

    NO_DEFAULTS_WHEN_READ: ClassVar[bool] = True
    """A recording that lacks a field is refused: a default would guess what its actions mean."""

    control: ControlMode = ControlMode.END_EFFECTOR_DELTA
    """Commanded quantity."""
    frame: ReferenceFrame = ReferenceFrame.ROBOT_BASE
    """Frame in which a motion or pose of the tool centre point is expressed."""
    rotation: RotationRepresentation = RotationRepresentation.EULER_XYZ_EXTRINSIC
    """Representation of the rotation."""
    gripper: GripperConvention = GripperConvention.ABSOLUTE_OPEN_1_CLOSED_0
    """Polarity and range of the gripper component."""
    delta_base: DeltaBase = DeltaBase.COMMANDED
    """State that a relative action is added to."""
    rate_hz: float = DEFAULT_RATE_HZ
    """Control rate [Hz]; must divide the physics rate. 0 (`ANY_RATE`): the rate of the run."""
    max_translation_m: float = 0.05
    """Largest translation per tick, as a distance [m]; larger ones are clipped and counted. Not used in joint space,
    where the model's joint limits apply."""
    max_rotation_rad: float = 0.25
    """Largest rotation per tick, as an angle [rad]; as ``max_translation_m``."""

    def __post_init__(self) -> None:
        """Check the values, and set fields that the control mode does not use to ``none``.

        Raises:
            InvalidRequestError: On an unknown value, a meaningless combination, or a number out of range.
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

    def executed(self, rate_hz: float) -> ActionSemantics:
        """Return the meaning in which the simulator executes, and a bag records, actions of this meaning.

        Joint space keeps its control mode and delta base; everything else becomes the default end-effector delta with
        these limits. The gripper is always 1 = open, 0 = closed.

        Args:
            rate_hz: Control rate of the episode [Hz].
        """
        if self.control.is_joint_space:
            return replace(self, gripper=GripperConvention.ABSOLUTE_OPEN_1_CLOSED_0, rate_hz=rate_hz)
        return ActionSemantics(
            rate_hz=rate_hz, max_translation_m=self.max_translation_m, max_rotation_rad=self.max_rotation_rad
        )

    @property
    def is_vector_delta(self) -> bool:
        """Whether an action is an end-effector delta with three rotation numbers, which may be scaled one by one."""
        return self.control == ControlMode.END_EFFECTOR_DELTA and self.rotation.size == 3

    def dimension(self, robot_joints: int = 0) -> int:
        """Return the number of components of an action.

        Args:
            robot_joints: Number of arm joints; needed in joint space only.

        Raises:
            InvalidRequestError: In joint space without a number of joints.
        """
        if self.control.is_joint_space:
            if robot_joints < 1:
                raise InvalidRequestError(f"the size of an action of control '{self.control}' depends on the robot")
            return robot_joints + 1
        return 3 + self.rotation.size + 1

    def component_names(self, joint_names: Sequence[str] = ()) -> tuple[str, ...]:
        """Return the names of an action's components, e.g. ``dx`` or ``panda_joint1.velocity``.

        Args:
            joint_names: Names of the arm joints; needed in joint space only.
        """
        if self.control.is_joint_space:
            self.dimension(len(joint_names))
            kind = self.control.value.removeprefix("joint_")
            return (*(f"{name}.{kind}" for name in joint_names), "gripper")
        prefix = "d" if self.control.is_relative else ""
        return (*(f"{prefix}{name}" for name in ("x", "y", "z", *self.rotation.component_names)), "gripper")

    def differing(self, other: ActionSemantics) -> tuple[str, ...]:
        """Return the names of the fields that make the meanings differ.

        Limits may differ, and `ANY_RATE` matches every rate.
        """
        names = [name for name in _ENUMERATIONS if getattr(self, name) != getattr(other, name)]
        if self.rate_hz != other.rate_hz and ANY_RATE not in (self.rate_hz, other.rate_hz):
            names.append("rate_hz")
        return tuple(names)

    def require_compatible(self, other: ActionSemantics, *, owner: str, other_owner: str) -> None:
        """Refuse a mismatch of meaning or rate; the limits may differ.

        Args:
            other: The semantics to compare with.
            owner: Owner of these semantics, for the message, e.g. ``"policy 'bc'"``.
            other_owner: Owner of the other semantics, for the message.

        Raises:
            EvaluationError: With code ``SEMANTICS_MISMATCH``, naming every differing field and whether a transform
                exists.
        """
        if differing := self.differing(other):
            fields = "; ".join(
                f"{name}: {_shown(getattr(self, name))} against {_shown(getattr(other, name))}" for name in differing
            )
            raise EvaluationError(
                f"action semantics of {owner} and {other_owner} differ ({fields}); {_advice(self, other)}",
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
        return "no transform exists between different rates; run both at the same rate"
    crosses = source.control.is_joint_space != target.control.is_joint_space
    return (
        f"a transform exists{' that needs the kinematics of the robot' if crosses else ''}: convert the actions with "
        "roboxim_core.actions.ActionTransform.between, or declare the same semantics on both sides"
    )
