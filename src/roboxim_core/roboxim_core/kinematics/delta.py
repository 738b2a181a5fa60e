"""The delta controller: how an action becomes joint targets, for policies, the expert's roll-out and replay alike.

Deltas integrate on the *commanded* pose, never on the measured one: integrating on a measurement adds the arm's lag to
every step and makes replay drift. The controller is a pure function of its state and the action. Its result holds the
action after clipping; stepping with that action again gives the same bits, so replay is exact.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from roboxim_core.actions import ActionArray, ActionSemantics, check_chunk
from roboxim_core.errors import ErrorCode, InvalidRequestError
from roboxim_core.kinematics.arm import ArmKinematics
from roboxim_core.poses import IDENTITY, Pose
from roboxim_core.specs import WorkspaceSpec

_SLACK = 1.0 + 1e-6
"""A clipped action, rounded to float32, must pass the limit that clipped it."""


@dataclass(frozen=True, kw_only=True)
class ControllerState:
    """What the next action integrates on."""

    pose: Pose
    """Commanded pose of the tool centre point in the robot's base."""
    joints: tuple[float, ...]
    """Commanded arm joint positions [rad]."""
    gripper: float
    """Commanded opening, 1 = open, 0 = closed."""


@dataclass(frozen=True, kw_only=True)
class DeltaStep:
    """What one action leads to."""

    state: ControllerState
    """The next state: the joint target of the tick is its ``joints``."""
    action_executed: tuple[float, ...]
    """The action after clipping, 7 float32 values; stepping with it again gives the same bits."""
    clipped: bool
    """Whether the action was beyond a limit."""
    left_workspace: bool
    """Whether the pose would have left the workspace and was moved back to its border."""
    unreached: bool
    """Whether the arm cannot reach the pose in this tick; then the commanded pose is what it does reach."""


class DeltaController:
    """Turns actions into commanded poses and joint targets. Bit-deterministic; not thread-safe (see `ArmKinematics`).

    Non-obvious: a commanded pose that starts outside the workspace is not pulled in, it only cannot get farther out.
    """

    def __init__(
        self,
        arm: ArmKinematics,
        *,
        workspace: WorkspaceSpec | None = None,
        pose_base_in_world: Pose = IDENTITY,
        semantics: ActionSemantics | None = None,
    ) -> None:
        """Make a controller.

        Args:
            arm: Kinematics.
            workspace: Box in the world that the commanded tool centre point stays in; none: the default.
            pose_base_in_world: Where the robot stands.
            semantics: Rate and limits; none: the default.
        """
        self.arm = arm
        self.workspace = workspace or WorkspaceSpec()
        self.semantics = semantics or ActionSemantics()
        self._base = pose_base_in_world
        self._base_is_identity = pose_base_in_world == IDENTITY
        self._max_joint_step = arm.velocity / self.semantics.rate_hz

    def start(self, joints: npt.ArrayLike, gripper: float = 1.0) -> ControllerState:
        """Return the state of an arm that stands still.

        Args:
            joints: Arm joint positions, shape (n,) [rad].
            gripper: Opening, 1 = open.
        """
        return ControllerState(
            pose=self.arm.fk(joints), joints=tuple(np.asarray(joints, dtype=float).tolist()), gripper=float(gripper)
        )

    def step(self, state: ControllerState, action: npt.ArrayLike) -> DeltaStep:
        """Integrate one action.

        Args:
            state: Where the command is.
            action: 7 numbers, see `roboxim_core.actions`.

        Raises:
            InvalidRequestError: With code ``INVALID_ACTION`` on a wrong shape or a NaN.
        """
        chunk = check_chunk(action)
        if len(chunk) != 1:
            raise InvalidRequestError(
                f"one tick takes one action, shape (7,), got {np.shape(action)}", ErrorCode.INVALID_ACTION
            )
        executed, clipped = self._clip(chunk[0])
        position = np.array(state.pose.position) + executed[:3].astype(float)
        rotation = Rotation.from_euler("xyz", executed[3:6].astype(float)) * state.pose.rotation
        position, left = self._keep_inside(np.array(state.pose.position), position)
        pose, joints, unreached = state.pose, state.joints, False
        if left or executed[:6].any():
            pose = Pose.from_arrays(position, rotation)
            result = self.arm.ik_near(pose, state.joints, posture=self.arm.model.home, max_step=self._max_joint_step)
            joints, unreached = tuple(result.joints.tolist()), not result.converged
            if unreached:
                pose = self.arm.fk(result.joints)
        return DeltaStep(
            state=ControllerState(pose=pose, joints=joints, gripper=float(executed[6])),
            action_executed=tuple(executed.tolist()),
            clipped=clipped,
            left_workspace=left,
            unreached=unreached,
        )

    def rollout(
        self, joints: npt.ArrayLike, actions: Iterable[npt.ArrayLike], gripper: float = 1.0
    ) -> tuple[DeltaStep, ...]:
        """Integrate actions one after the other from an arm that stands still.

        Args:
            joints: Arm joint positions at the start, shape (n,) [rad].
            actions: The actions.
            gripper: Opening at the start.
        """
        state, steps = self.start(joints, gripper), []
        for action in actions:
            steps.append(self.step(state, action))
            state = steps[-1].state
        return tuple(steps)

    def _clip(self, action: ActionArray) -> tuple[ActionArray, bool]:
        executed = action.copy()
        clipped = False
        distance = float(np.linalg.norm(executed[:3].astype(float)))
        if distance > self.semantics.max_translation_m * _SLACK:
            executed[:3] *= self.semantics.max_translation_m / distance
            clipped = True
        angles = executed[3:6].astype(float)
        if np.abs(angles).sum() > self.semantics.max_rotation_rad:  # cheap bound: the angle is never more than the sum
            vector = Rotation.from_euler("xyz", angles).as_rotvec()
            angle = float(np.linalg.norm(vector))
            if angle > self.semantics.max_rotation_rad * _SLACK or np.abs(angles).max() > math.pi:
                vector *= min(1.0, self.semantics.max_rotation_rad / angle)
                executed[3:6] = Rotation.from_rotvec(vector).as_euler("xyz")
                clipped = True
        gripper = np.clip(executed[6], 0.0, 1.0)
        clipped = clipped or bool(gripper != executed[6])
        executed[6] = gripper
        return executed, clipped

    def _keep_inside(
        self, now: npt.NDArray[np.float64], then: npt.NDArray[np.float64]
    ) -> tuple[npt.NDArray[np.float64], bool]:
        if self._base_is_identity:
            now_world, then_world = now, then
        else:
            now_world, then_world = self._base.apply(now), self._base.apply(then)
        lower = np.minimum(self.workspace.lower, now_world)
        upper = np.maximum(self.workspace.upper, now_world)
        inside = np.clip(then_world, lower, upper)
        if np.all(np.abs(inside - then_world) < 1e-9):
            return then, False
        return (inside if self._base_is_identity else self._base.inverse().apply(inside)), True


def delta_between(commanded: Pose, following: Pose, gripper: float) -> ActionArray:
    """Return the action that leads from a commanded pose to the next one.

    Args:
        commanded: Commanded pose of the tool centre point in the base.
        following: Wanted next pose in the base.
        gripper: Opening, 1 = open.

    Returns:
        float32, shape (7,). The rotation is that of ``R_next R_commanded^T``, so it never jumps at +-pi.
    """
    action = np.empty(7, dtype=np.float32)
    action[:3] = np.subtract(following.position, commanded.position)
    action[3:6] = (following.rotation * commanded.rotation.inv()).as_euler("xyz")
    action[6] = gripper
    return action
