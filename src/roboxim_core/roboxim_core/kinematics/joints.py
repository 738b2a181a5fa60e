"""The joint controller: converts actions in joint space to joint targets within the arm's limits.

The target of a tick is ``base + action``, with the base that the semantics name: nothing (positions), the commanded
joints, or the measured ones (as DROID's controller does). Three limits apply, in this order:

1. **speed**: no joint moves faster than its limit allows in a tick. The whole step from the commanded joints is
   shortened, so that its direction in joint space remains;
2. **position**: each joint stays within its limits;
3. **workspace**: the tool centre point stays in the workspace; the step ends where it would leave it.

The first two count as clipped. The controller is a pure function; the executed action gives the same bits again.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from roboxim_core.actions import ActionArray, ActionContext, check_chunk
from roboxim_core.actions.transforms import Target, action_of, target_of
from roboxim_core.errors import ErrorCode, InvalidRequestError
from roboxim_core.kinematics.controller import Controller, ControllerState, ControlStep
from roboxim_core.poses import Array

_SLACK_RAD = 1e-6
"""Tolerance of the limits, so that a clipped action, rounded to float32, passes the limits that clipped it [rad]."""
_BISECTIONS = 30


class JointController(Controller):
    """Converter of joint positions, velocities or deltas to joint targets. Not thread-safe (see `ArmKinematics`)."""

    def step(self, state: ControllerState, action: npt.ArrayLike, joints_measured: Sequence[float] = ()) -> ControlStep:
        """Integrate one action.

        Args:
            state: The commanded state before the action.
            action: One number per arm joint, in the model's order, and the gripper.
            joints_measured: Measured arm joint positions [rad]; needed with the delta base ``measured``.

        Raises:
            InvalidRequestError: With code ``INVALID_ACTION`` on a wrong number of joints or a NaN; the message names
                the expected components.
        """
        row = self._checked(action)
        context = ActionContext(joints_commanded=state.joints, joints_measured=tuple(joints_measured) or None)
        executed, clipped = self._clip(row, state, context)
        joints, left = self._keep_inside(state, self._target(executed, context))
        unchanged = joints == state.joints
        return ControlStep(
            state=ControllerState(
                pose=state.pose if unchanged else self.arm.fk(joints), joints=joints, gripper=float(executed[-1])
            ),
            action_executed=tuple(executed.tolist()),
            clipped=clipped,
            left_workspace=left,
            unreached=False,
        )

    def _checked(self, action: npt.ArrayLike) -> ActionArray:
        chunk, size = check_chunk(action, size=None), self.semantics.dimension(len(self.arm.model.joint_names))
        if chunk.shape != (1, size):
            names = ", ".join(self.semantics.component_names(self.arm.model.joint_names))
            raise InvalidRequestError(
                f"an action of '{self.semantics.control}' for this robot is {size} numbers ({names}), "
                f"got shape {np.shape(action)}",
                ErrorCode.INVALID_ACTION,
            )
        row: ActionArray = chunk[0]
        return row

    def _target(self, action: ActionArray, context: ActionContext) -> Array:
        """Return the joints that an action commands, within the position limits, shape (n,) [rad]."""
        wanted = np.array(target_of(action, self.semantics, context).joints)
        allowed: Array = np.clip(wanted, self.arm.lower, self.arm.upper)
        return allowed

    def _clip(self, action: ActionArray, state: ControllerState, context: ActionContext) -> tuple[ActionArray, bool]:
        """Return the action within the limits of speed, position and opening, and whether it exceeded one."""
        wanted = np.array(target_of(action, self.semantics, context).joints)
        now = np.array(state.joints)
        share = float(np.min(self._max_joint_step / np.maximum(np.abs(wanted - now), self._max_joint_step)))
        limited = np.clip(now + share * (wanted - now), self.arm.lower, self.arm.upper)
        opening = min(max(float(action[-1]), 0.0), 1.0)
        executed, clipped = action, opening != float(action[-1])
        if np.max(np.abs(limited - wanted)) > _SLACK_RAD:
            target = Target(joints=tuple(limited.tolist()), opening=opening)
            executed, clipped = action_of(target, self.semantics, context).astype(np.float32), True
        elif clipped:
            executed = np.array([*action[:-1], opening], np.float32)
        return executed, clipped

    def _keep_inside(self, state: ControllerState, target: Array) -> tuple[tuple[float, ...], bool]:
        """Return the joints on the straight line to a target at which the tool centre point is still allowed to be."""
        joints = tuple(target.tolist())
        if joints == state.joints:
            return joints, False
        here, now = state.pose.position, np.array(state.joints)
        if self._box.keep(here, self.arm.fk(target).position) is None:
            return joints, False
        inside, outside = 0.0, 1.0
        for _ in range(_BISECTIONS):
            middle = (inside + outside) / 2
            fits = self._box.keep(here, self.arm.fk(now + middle * (target - now)).position) is None
            inside, outside = (middle, outside) if fits else (inside, middle)
        return tuple((now + inside * (target - now)).tolist()), True
