"""Transforms of many actions at once, e.g. of a whole episode: the same as `ActionTransform`, action by action.

Each action has the state of the arm before it, so a delta to the measured state is exact for every action, also inside
of a chunk. Only a step between joint space and end effector runs the kinematics once per action.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import numpy.typing as npt

from roboxim_core.actions.semantics import ActionSemantics, ControlMode, DeltaBase, ReferenceFrame
from roboxim_core.actions.transforms import ActionContext, ActionTransform, Kinematics
from roboxim_core.errors import ErrorCode, InvalidRequestError
from roboxim_core.poses import IDENTITY, Pose
from roboxim_core.rotation.representations import Floats, decode_rows, encode_rows, gripper_down, identity_rotation
from roboxim_core.state import StateRecord

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

T = TypeVar("T")
Rows = TypeVar("Rows", Floats, "PoseRows")


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseRows:
    """n poses of the tool centre point in the base."""

    positions: Floats
    """Shape (n, 3) [m]."""
    rotations: Rotation
    """n rotations."""

    @staticmethod
    def of(poses: Sequence[Pose]) -> PoseRows:
        """Return poses as arrays."""
        from scipy.spatial.transform import Rotation

        return PoseRows(
            positions=np.array([pose.position for pose in poses], dtype=float).reshape(-1, 3),
            rotations=Rotation.from_quat(np.array([pose.quat_xyzw for pose in poses], dtype=float).reshape(-1, 4)),
        )

    def __len__(self) -> int:
        """Count the poses."""
        return len(self.positions)

    def pose(self, index: int) -> Pose:
        """Return one of the poses."""
        return Pose.from_arrays(self.positions[index], self.rotations[index])


@dataclass(frozen=True, kw_only=True, eq=False)
class ArmTrack:
    """State of the arm before each of n actions. Fields that a transform does not need may be None."""

    commanded: PoseRows | None = None
    """Commanded poses."""
    measured: PoseRows | None = None
    """Measured poses."""
    joints_commanded: Floats | None = None
    """Commanded arm joint positions, shape (n, joints) [rad]."""
    joints_measured: Floats | None = None
    """Measured arm joint positions, shape (n, joints) [rad]."""
    joints_after: Floats | None = None
    """Commanded arm joint positions after each action, shape (n, joints) [rad], from a recording. A transform into
    joint space takes them instead of the inverse kinematics. Rows of NaN are unknown, e.g. where noise replaced the
    action."""
    kinematics: Kinematics | None = None
    """The robot's kinematics."""

    @staticmethod
    def of(
        states: Sequence[StateRecord], pose_base_in_world: Pose = IDENTITY, kinematics: Kinematics | None = None
    ) -> ArmTrack:
        """Return the track of the actions that follow states; action k leads from state k to state k + 1.

        Args:
            states: The state before each action.
            pose_base_in_world: Pose of the robot's base.
            kinematics: The robot's kinematics.
        """
        to_base = pose_base_in_world.inverse()
        robots = [state.robot for state in states]
        return ArmTrack(
            commanded=PoseRows.of([to_base @ robot.pose_tcp_commanded for robot in robots]),
            measured=PoseRows.of([to_base @ robot.pose_tcp_measured for robot in robots]),
            joints_commanded=np.array([robot.joint_commands for robot in robots], dtype=float),
            joints_measured=np.array([robot.joint_positions for robot in robots], dtype=float),
            kinematics=kinematics,
        )

    def context(self, index: int) -> ActionContext:
        """Return the state before one action."""

        def joints(rows: Floats | None) -> tuple[float, ...] | None:
            return None if rows is None else tuple(rows[index].tolist())

        return ActionContext(
            pose_commanded=self.commanded.pose(index) if self.commanded else None,
            pose_measured=self.measured.pose(index) if self.measured else None,
            joints_commanded=joints(self.joints_commanded),
            joints_measured=joints(self.joints_measured),
            kinematics=self.kinematics,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class TargetRows:
    """States that n actions command for the ends of their ticks."""

    poses: PoseRows | None = None
    """Poses of the tool centre point in the base; None in joint space."""
    joints: Floats | None = None
    """Arm joint positions, shape (n, joints) [rad]; None outside joint space."""
    openings: Floats
    """Openings of the gripper, shape (n,), 1 = open."""


def convert_rows(rows: npt.ArrayLike, source: ActionSemantics, target: ActionSemantics, track: ArmTrack) -> Floats:
    """Convert actions, each with the state before it.

    Args:
        rows: Shape (n, D).
        source: Meaning of the actions.
        target: Meaning of the result; of the same rate.
        track: State of the arm before each action.

    Returns:
        float64, shape (n, D').

    Raises:
        InvalidRequestError: On a wrong shape, numbers that do not describe a rotation, a field that the track lacks, or
            a pose that cannot be reached.
        EvaluationError: With code ``SEMANTICS_MISMATCH`` when the rates differ.
    """
    steps = ActionTransform.between(source, target)
    targets = target_rows(rows, steps.source, track)
    if target.control.is_joint_space != source.control.is_joint_space:
        targets = _change_space(targets, target.control.is_joint_space, track)
    return action_rows(targets, steps.target, track)


def target_rows(rows: npt.ArrayLike, semantics: ActionSemantics, track: ArmTrack) -> TargetRows:
    """Return the targets that actions command. Arguments and errors as `convert_rows`."""
    values = np.asarray(rows, dtype=float)
    size = semantics.dimension(max(values.shape[-1] - 1, 1)) if values.ndim == 2 else 0
    if values.ndim != 2 or values.shape[1] != size or not np.isfinite(values).all():
        raise InvalidRequestError(
            f"actions of '{semantics.control}' must be finite, of shape (n, {size or 'D'}), got shape {values.shape}",
            ErrorCode.INVALID_ACTION,
        )
    gripper = semantics.gripper
    openings = (values[:, -1] - gripper.closed_value) / (gripper.open_value - gripper.closed_value)
    if semantics.control.is_joint_space:
        joints = values[:, :-1] / (semantics.rate_hz if semantics.control == ControlMode.JOINT_VELOCITY else 1.0)
        if semantics.control.is_relative:
            joints = joints + _joint_base(semantics, track, len(values))
        return TargetRows(joints=joints, openings=openings)
    shifts, turns = values[:, :3], decode_rows(values[:, 3:-1], semantics.rotation)
    if not semantics.control.is_relative:
        return TargetRows(poses=PoseRows(positions=shifts, rotations=turns), openings=openings)
    base = _pose_base(semantics, track, len(values))
    if semantics.frame == ReferenceFrame.TOOL:
        shifts, turns = base.rotations.apply(shifts), base.rotations * turns
    else:
        turns = turns * base.rotations
    return TargetRows(poses=PoseRows(positions=base.positions + shifts, rotations=turns), openings=openings)


def action_rows(targets: TargetRows, semantics: ActionSemantics, track: ArmTrack) -> Floats:
    """Return the actions that command targets; the inverse of `target_rows` for the same track.

    Raises:
        InvalidRequestError: When the targets or the track lack a field.
    """
    gripper = semantics.gripper
    numbers = gripper.closed_value + targets.openings * (gripper.open_value - gripper.closed_value)
    if semantics.control.is_joint_space:
        joints = _present(targets.joints, "joints of the targets")
        if semantics.control.is_relative:
            joints = joints - _joint_base(semantics, track, len(joints))
        if semantics.control == ControlMode.JOINT_VELOCITY:
            joints = joints * semantics.rate_hz
        return np.column_stack([joints, numbers])
    poses = _present(targets.poses, "poses of the targets")
    if not semantics.control.is_relative:
        turned = encode_rows(poses.rotations, semantics.rotation, gripper_down())
        return np.column_stack([poses.positions, turned, numbers])
    base = _pose_base(semantics, track, len(poses))
    shifts = poses.positions - base.positions
    if semantics.frame == ReferenceFrame.TOOL:
        shifts, turns = base.rotations.inv().apply(shifts), base.rotations.inv() * poses.rotations
    else:
        turns = poses.rotations * base.rotations.inv()
    return np.column_stack([shifts, encode_rows(turns, semantics.rotation, identity_rotation()), numbers])


def _joint_base(semantics: ActionSemantics, track: ArmTrack, count: int) -> Floats:
    measured = semantics.delta_base == DeltaBase.MEASURED
    return _as_many(
        _present(track.joints_measured if measured else track.joints_commanded, f"joints_{semantics.delta_base}"), count
    )


def _pose_base(semantics: ActionSemantics, track: ArmTrack, count: int) -> PoseRows:
    measured = semantics.delta_base == DeltaBase.MEASURED
    return _as_many(_present(track.measured if measured else track.commanded, f"poses {semantics.delta_base}"), count)


def _change_space(targets: TargetRows, into_joint_space: bool, track: ArmTrack) -> TargetRows:
    """Convert targets to joint space by a recording or inverse kinematics, or out of it by forward kinematics."""
    if not into_joint_space:
        kinematics = _present(track.kinematics, "kinematics")
        joints = _present(targets.joints, "joints of the targets")
        return replace(targets, joints=None, poses=PoseRows.of([kinematics.fk(row) for row in joints]))
    poses = _present(targets.poses, "poses of the targets")
    found = np.full((len(poses), 0), np.nan) if track.joints_after is None else np.array(track.joints_after)
    unknown = np.flatnonzero(np.isnan(found).any(axis=1) | (found.shape[1] == 0))
    if len(unknown):
        kinematics = _present(track.kinematics, "kinematics")
        near = _as_many(_present(track.joints_commanded, "joints_commanded"), len(poses))
        found = found if found.shape[1] else np.array(near)
        for index in unknown:
            found[index] = kinematics.reach(poses.pose(int(index)), near[index])
    return replace(targets, poses=None, joints=found)


def _present(value: T | None, name: str) -> T:
    if value is None:
        raise InvalidRequestError(f"the transform needs '{name}', which the track lacks")
    return value


def _as_many(value: Rows, count: int) -> Rows:
    if len(value) != count:
        raise InvalidRequestError(f"{count} actions need the state before each, got {len(value)} states")
    return value
