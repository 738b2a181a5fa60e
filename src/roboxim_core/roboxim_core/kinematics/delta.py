"""The delta controller: converts actions to joint targets, for policies, the expert's rollout and replay.

Deltas are added to the *commanded* pose, never to the measured one, which would add the arm's lag to every step and let
replay drift. The controller is a pure function of its state and the action. Its result contains the action after
clipping; stepping with that action again gives the same bits, so replay is exact.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from roboxim_core.actions import ActionArray, ActionSemantics, check_chunk
from roboxim_core.errors import ErrorCode, InvalidRequestError
from roboxim_core.kinematics.arm import ArmKinematics
from roboxim_core.kinematics.controller import Controller, ControllerState, ControlStep
from roboxim_core.poses import Pose
from roboxim_core.rotation.quaternions import euler_from_quat, quat_from_euler, quat_inverse, quat_product

_SLACK = 1.0 + 1e-6
"""Tolerance factor of the limits, so that a clipped action, rounded to float32, passes the limit that clipped it."""


class DeltaController(Controller):
    """Converter of actions to commanded poses and joint targets.

    Bit-deterministic; not thread-safe (see `ArmKinematics`).

    An arm whose tool turns in fewer than three directions goes to the commanded position and turns as far as it can
    there; the commanded pose is then that one.

    Note: a commanded pose that starts outside the workspace is not moved inside; it only cannot move farther out.
    """

    def __init__(self, arm: ArmKinematics, *, semantics: ActionSemantics | None = None, **place: Any) -> None:
        """Make a controller.

        Args:
            arm: Kinematics.
            semantics: Rate and limits; None: the default.
            **place: Workspace and base, see `Controller`.
        """
        super().__init__(arm, semantics=semantics or ActionSemantics(), **place)

    def step(self, state: ControllerState, action: npt.ArrayLike, joints_measured: Sequence[float] = ()) -> ControlStep:
        """Integrate one action.

        Args:
            state: The commanded state before the action.
            action: 7 numbers, see `roboxim_core.actions`.
            joints_measured: Not used.

        Raises:
            InvalidRequestError: With code ``INVALID_ACTION`` on a wrong shape or a NaN.
        """
        chunk = check_chunk(action)
        if len(chunk) != 1:
            raise InvalidRequestError(
                f"one tick takes one action, shape (7,), got {np.shape(action)}", ErrorCode.INVALID_ACTION
            )
        executed, clipped = self._clip(chunk[0])
        x, y, z, *angles, gripper = executed.tolist()
        here = state.pose.position
        wanted = (here[0] + x, here[1] + y, here[2] + z)
        border = self._box.keep(here, wanted)
        position, left = (wanted, False) if border is None else (border, True)
        pose, joints, unreached = state.pose, state.joints, False
        if left or x or y or z or any(angles):
            pose = Pose(position=position, quat_xyzw=quat_product(quat_from_euler(*angles), state.pose.quat_xyzw))
            result = self.arm.ik_near(pose, state.joints, posture=self.arm.model.home, max_step=self._max_joint_step)
            joints = tuple(result.joints.tolist())
            unreached = not (result.converged if self.arm.model.rotations == 3 else result.placed)
            if not result.converged:
                pose = self.arm.fk(result.joints)
        return ControlStep(
            state=ControllerState(pose=pose, joints=joints, gripper=gripper),
            action_executed=(x, y, z, *angles, gripper),
            clipped=clipped,
            left_workspace=left,
            unreached=unreached,
        )

    def _clip(self, action: ActionArray) -> tuple[ActionArray, bool]:
        from scipy.spatial.transform import Rotation

        executed = action.copy()
        clipped = False
        *shift, roll, pitch, yaw, gripper = action.tolist()
        distance = math.hypot(*shift)
        if distance > self.semantics.max_translation_m * _SLACK:
            executed[:3] *= self.semantics.max_translation_m / distance
            clipped = True
        if abs(roll) + abs(pitch) + abs(yaw) > self.semantics.max_rotation_rad:  # the angle never exceeds the sum
            vector = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_rotvec()
            angle = float(np.linalg.norm(vector))
            if angle > self.semantics.max_rotation_rad * _SLACK or max(map(abs, (roll, pitch, yaw))) > math.pi:
                vector *= min(1.0, self.semantics.max_rotation_rad / angle)
                executed[3:6] = Rotation.from_rotvec(vector).as_euler("xyz")
                clipped = True
        if not 0.0 <= gripper <= 1.0:
            executed[6] = min(max(gripper, 0.0), 1.0)
            clipped = True
        return executed, clipped


def delta_between(commanded: Pose, following: Pose, gripper: float) -> ActionArray:
    """Return the action that moves a commanded pose to the next one.

    Args:
        commanded: Commanded pose of the tool centre point in the base.
        following: Next pose in the base.
        gripper: Opening, 1 = open.

    Returns:
        float32, shape (7,). The rotation is that of ``R_next R_commanded^T``, so it never jumps at +-pi.
    """
    turn = quat_product(following.quat_xyzw, quat_inverse(commanded.quat_xyzw))
    shift = (b - a for a, b in zip(commanded.position, following.position, strict=True))
    return np.array((*shift, *euler_from_quat(turn), gripper), dtype=np.float32)
