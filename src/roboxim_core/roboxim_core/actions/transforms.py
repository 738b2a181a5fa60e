"""Transforms between actions of different meaning.

An action of any meaning, together with the arm's commanded and measured state, defines a *target*: a pose of the tool
centre point or arm joint positions, and an opening of the gripper. A transform computes the target from an action of
one meaning and expresses it in the other. Requirements and invertibility:

| from, to | requires | invertible |
| --- | --- | --- |
| end effector to end effector | poses that a delta adds to | yes, up to rounding |
| joint space to joint space | joints that a delta adds to | yes, up to rounding |
| joint space to end effector | the same, and kinematics (FK) | no: a redundant arm reaches a pose in many ways |
| end effector to joint space | the same, and kinematics (IK) | by FK, to the IK's tolerance, where reachable |
| different rates | - | no transform exists |

Every transform that requires no kinematics is invertible: its inverse returns an equivalent action, with the same
numbers if the original ones were canonical (Euler angles within +-pi, a quaternion of norm 1). Numbers are not clipped,
neither to the gripper's range nor to the limits per tick.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from roboxim_core.actions.semantics import ActionSemantics, ControlMode, DeltaBase, ReferenceFrame
from roboxim_core.errors import ErrorCode, EvaluationError, InvalidRequestError
from roboxim_core.poses import IDENTITY, Pose
from roboxim_core.rates import ANY_RATE
from roboxim_core.rotation.representations import Floats, decode, encode, gripper_down, identity_rotation
from roboxim_core.state import StateRecord

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

Joints = tuple[float, ...]
T = TypeVar("T")


class Kinematics(Protocol):
    """Kinematics that a transform between joint space and end effector requires; `ArmKinematics` implements it."""

    def fk(self, joints: npt.ArrayLike) -> Pose:
        """Return the pose of the tool centre point in the base for arm joint positions [rad]."""
        ...

    def reach(self, pose: Pose, near: npt.ArrayLike) -> Floats:
        """Return arm joint positions [rad], close to ``near``, that reach a pose in the base.

        Raises:
            InvalidRequestError: If there are none.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class ActionContext:
    """State of the arm before an action. Fields that a transform does not need may be None."""

    pose_commanded: Pose | None = None
    """Commanded pose of the tool centre point in the base."""
    pose_measured: Pose | None = None
    """Measured pose of the tool centre point in the base."""
    joints_commanded: Joints | None = None
    """Commanded arm joint positions [rad]."""
    joints_measured: Joints | None = None
    """Measured arm joint positions [rad]."""
    joints_after: Joints | None = None
    """Commanded arm joint positions after the action [rad], where a recording has them. A transform into joint space
    takes them instead of the inverse kinematics."""
    kinematics: Kinematics | None = None
    """The robot's kinematics."""

    @staticmethod
    def of(
        state: StateRecord, pose_base_in_world: Pose = IDENTITY, kinematics: Kinematics | None = None
    ) -> ActionContext:
        """Return the context of the action that follows a state.

        Args:
            state: The state.
            pose_base_in_world: Pose of the robot's base.
            kinematics: The robot's kinematics; None: transforms between joint space and end effector are refused.
        """
        to_base = pose_base_in_world.inverse()
        return ActionContext(
            pose_commanded=to_base @ state.robot.pose_tcp_commanded,
            pose_measured=to_base @ state.robot.pose_tcp_measured,
            joints_commanded=state.robot.joint_commands,
            joints_measured=state.robot.joint_positions,
            kinematics=kinematics,
        )

    def after(self, target: Target) -> ActionContext:
        """Return the context after a target was commanded. It has no measured state, which is not known yet."""
        return replace(
            self,
            pose_commanded=target.pose,
            pose_measured=None,
            joints_commanded=target.joints,
            joints_measured=None,
            joints_after=None,
        )


@dataclass(frozen=True, kw_only=True)
class Target:
    """State that an action commands for the end of its tick."""

    pose: Pose | None = None
    """Pose of the tool centre point in the base; None in joint space."""
    joints: Joints | None = None
    """Arm joint positions [rad]; None outside joint space."""
    opening: float = 1.0
    """Opening of the gripper, 1 = open, 0 = closed."""


@dataclass(frozen=True, kw_only=True)
class ActionTransform:
    """Converter of actions from one meaning to another; create it with `between`."""

    source: ActionSemantics
    """Meaning of the actions that `apply` takes."""
    target: ActionSemantics
    """Meaning of the actions that `apply` returns."""

    @staticmethod
    def between(source: ActionSemantics, target: ActionSemantics) -> ActionTransform:
        """Return the transform from one meaning to another.

        Args:
            source: Meaning of the input actions.
            target: Meaning of the output actions.

        Raises:
            EvaluationError: With code ``SEMANTICS_MISMATCH`` when the rates differ.
        """
        if "rate_hz" in source.differing(target):
            source.require_compatible(
                replace(source, rate_hz=target.rate_hz), owner="the source", other_owner="the target"
            )
        rate_hz = source.rate_hz or target.rate_hz
        if rate_hz == ANY_RATE and ControlMode.JOINT_VELOCITY in (source.control, target.control):
            raise EvaluationError(
                "a joint velocity is a motion per tick at a known rate only: set rate_hz on either side",
                ErrorCode.SEMANTICS_MISMATCH,
            )
        return ActionTransform(source=replace(source, rate_hz=rate_hz), target=replace(target, rate_hz=rate_hz))

    @property
    def needs_kinematics(self) -> bool:
        """Whether it leads from joint space to the end effector or back."""
        return self.source.control.is_joint_space != self.target.control.is_joint_space

    @property
    def needs(self) -> tuple[str, ...]:
        """Fields of the `ActionContext` that it requires."""
        needed = {
            f"{'joints' if side.control.is_joint_space else 'pose'}_{side.delta_base}"
            for side in (self.source, self.target)
            if side.control.is_relative
        }
        if self.needs_kinematics:
            needed |= {"kinematics"}
            needed |= {"joints_commanded"} if self.target.control.is_joint_space else set()  # where the IK starts
        return tuple(sorted(needed))

    def apply(self, action: npt.ArrayLike, context: ActionContext) -> Floats:
        """Convert one action.

        Args:
            action: Shape (D,), of the source's meaning.
            context: State of the arm before the action.

        Returns:
            float64, shape (D',), in the target's meaning.

        Raises:
            InvalidRequestError: When the context lacks a field (the message names it), the action has a wrong shape,
                its numbers do not describe a rotation, or a pose cannot be reached.
        """
        return self._convert(action, context)[0]

    def apply_chunk(self, actions: npt.ArrayLike, context: ActionContext) -> Floats:
        """Convert consecutive actions; each one starts from the state that the previous one commanded.

        Args:
            actions: Shape (horizon, D).
            context: State of the arm before the first action.

        Returns:
            float64, shape (horizon, D').

        Raises:
            InvalidRequestError: As `apply`; also when a later row adds to a measured state, which is not known yet.
        """
        rows = []
        for action in np.atleast_2d(np.asarray(actions, dtype=float)):
            row, target = self._convert(action, context)
            rows.append(row)
            context = context.after(target)
        return np.stack(rows)

    def _convert(self, action: npt.ArrayLike, context: ActionContext) -> tuple[Floats, Target]:
        replaced = ("kinematics", "joints_commanded") if context.joints_after else ()
        for name in self.needs:
            if getattr(context, name) is None and name not in replaced:
                raise InvalidRequestError(
                    f"the transform from {_shown(self.source)} to {_shown(self.target)} needs '{name}', which the "
                    "context lacks; a measurement is known for the first action of a chunk only"
                )
        target = target_of(action, self.source, context)
        if self.needs_kinematics:
            target = _change_space(target, self.target.control.is_joint_space, context)
        return action_of(target, self.target, context), target


def convert_rows(
    rows: npt.ArrayLike, source: ActionSemantics, target: ActionSemantics, track: Sequence[ActionContext]
) -> Floats:
    """Convert actions, each with the state before it, e.g. those of a recorded episode.

    A delta to the measured state is exact for every action, also inside of a chunk.

    Args:
        rows: Shape (n, D).
        source: Meaning of the actions.
        target: Meaning of the result; of the same rate.
        track: State of the arm before each of the n actions.

    Returns:
        float64, shape (n, D').

    Raises:
        InvalidRequestError: As `ActionTransform.apply`, or when the numbers of actions and states differ.
        EvaluationError: With code ``SEMANTICS_MISMATCH`` when the rates differ.
    """
    transform, values = ActionTransform.between(source, target), np.asarray(rows, dtype=float)
    if len(values) != len(track):
        raise InvalidRequestError(f"{len(values)} actions need the state before each, got {len(track)} states")
    return np.stack([transform.apply(row, context) for row, context in zip(values, track, strict=True)])


def target_of(action: npt.ArrayLike, semantics: ActionSemantics, context: ActionContext) -> Target:
    """Return the target that an action commands.

    Args:
        action: Shape (D,).
        semantics: Its meaning; a joint velocity needs a rate.
        context: State of the arm; a relative action requires the state that its ``delta_base`` names.

    Raises:
        InvalidRequestError: On a wrong shape, numbers that do not describe a rotation, or a missing field of the
            context.
    """
    row = np.asarray(action, dtype=float)
    base_joints, base_pose = _bases(semantics, context)
    size = semantics.dimension(len(base_joints) if base_joints else max(row.size - 1, 1))
    if row.shape != (size,) or not np.isfinite(row).all():
        raise InvalidRequestError(
            f"an action of {_shown(semantics)} is {size} finite numbers, got shape {row.shape}: {row}",
            ErrorCode.INVALID_ACTION,
        )
    opening = semantics.gripper.opening(float(row[-1]))
    if semantics.control.is_joint_space:
        joints = row[:-1] / (semantics.rate_hz if semantics.control == ControlMode.JOINT_VELOCITY else 1.0)
        if base_joints is not None:
            joints = joints + np.array(base_joints)
        return Target(joints=tuple(joints.tolist()), opening=opening)
    translation, rotation = row[:3], decode(row[3:-1], semantics.rotation)
    if base_pose is None:
        return Target(pose=_pose(translation, rotation), opening=opening)
    now, turned = np.array(base_pose.position), base_pose.rotation
    if semantics.frame == ReferenceFrame.TOOL:
        return Target(pose=_pose(now + turned.apply(translation), turned * rotation), opening=opening)
    return Target(pose=_pose(now + translation, rotation * turned), opening=opening)


def action_of(target: Target, semantics: ActionSemantics, context: ActionContext) -> Floats:
    """Return the action that commands a target; the inverse of `target_of` for the same context.

    Args:
        target: The target; in joint space if the semantics are.
        semantics: Meaning of the action.
        context: State of the arm before the action.

    Raises:
        InvalidRequestError: When the target or the context lacks a required field.
    """
    base_joints, base_pose = _bases(semantics, context)
    gripper = semantics.gripper.number(target.opening)
    if semantics.control.is_joint_space:
        joints = np.array(_present(target.joints, "joints of the target"))
        if base_joints is not None:
            joints = joints - np.array(base_joints)
        if semantics.control == ControlMode.JOINT_VELOCITY:
            joints = joints * semantics.rate_hz
        return np.array([*joints, gripper])
    pose = _present(target.pose, "pose of the target")
    if base_pose is None:
        return np.array([*pose.position, *encode(pose.rotation, semantics.rotation, gripper_down()), gripper])
    turned = base_pose.rotation
    translation = np.subtract(pose.position, base_pose.position)
    if semantics.frame == ReferenceFrame.TOOL:
        translation, rotation = turned.inv().apply(translation), turned.inv() * pose.rotation
    else:
        rotation = pose.rotation * turned.inv()
    return np.array([*translation, *encode(rotation, semantics.rotation, identity_rotation()), gripper])


def _bases(semantics: ActionSemantics, context: ActionContext) -> tuple[Joints | None, Pose | None]:
    """Return the joint positions or the pose that a relative action is added to; (None, None) for an absolute one."""
    if not semantics.control.is_relative:
        return None, None
    measured = semantics.delta_base == DeltaBase.MEASURED
    if semantics.control.is_joint_space:
        joints = context.joints_measured if measured else context.joints_commanded
        return _present(joints, f"joints_{semantics.delta_base}"), None
    pose = context.pose_measured if measured else context.pose_commanded
    return None, _present(pose, f"pose_{semantics.delta_base}")


def _change_space(target: Target, into_joint_space: bool, context: ActionContext) -> Target:
    """Convert a target to joint space by inverse kinematics, or out of it by forward kinematics."""
    if into_joint_space and context.joints_after:
        return replace(target, joints=context.joints_after)
    kinematics = _present(context.kinematics, "kinematics")
    if not into_joint_space:
        return replace(target, pose=kinematics.fk(_present(target.joints, "joints of the target")))
    pose = _present(target.pose, "pose of the target")
    joints = kinematics.reach(pose, _present(context.joints_commanded, "joints_commanded"))
    return replace(target, joints=tuple(np.asarray(joints, dtype=float).tolist()))


def _present(value: T | None, name: str) -> T:
    if value is None:
        raise InvalidRequestError(f"the transform needs '{name}', which is not given")
    return value


def _pose(position: Floats, rotation: Rotation) -> Pose:
    return Pose.from_arrays(position, rotation)


def _shown(semantics: ActionSemantics) -> str:
    return f"'{semantics.control}'"
