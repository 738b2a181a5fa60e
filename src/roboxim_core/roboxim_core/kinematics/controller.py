"""Shared parts of the controllers: the commanded state, the result of an action, and the choice of a controller."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roboxim_core.actions import ActionSemantics
from roboxim_core.kinematics.arm import ArmKinematics
from roboxim_core.kinematics.workspace import WorkspaceBox
from roboxim_core.poses import IDENTITY, Pose
from roboxim_core.specs import WorkspaceSpec


@dataclass(frozen=True, kw_only=True)
class ControllerState:
    """Commanded state that the next action starts from."""

    pose: Pose
    """Commanded pose of the tool centre point in the robot's base."""
    joints: tuple[float, ...]
    """Commanded arm joint positions [rad]."""
    gripper: float
    """Commanded opening, 1 = open, 0 = closed."""


@dataclass(frozen=True, kw_only=True)
class ControlStep:
    """Result of one action."""

    state: ControllerState
    """The next state; its ``joints`` are the joint target of the tick."""
    action_executed: tuple[float, ...]
    """The action after clipping, D float32 values; stepping with it again gives the same bits."""
    clipped: bool
    """Whether the action exceeded a limit."""
    left_workspace: bool
    """Whether the tool centre point would have left the workspace and was kept at its border."""
    unreached: bool
    """Whether the arm cannot reach the pose in this tick; the commanded pose is then the one that it does reach. With
    fewer than three rotations: whether it cannot reach the position."""


class Controller(ABC):
    """Converter of actions of one meaning to joint targets: a pure function of its arguments."""

    def __init__(
        self,
        arm: ArmKinematics,
        *,
        semantics: ActionSemantics,
        workspace: WorkspaceSpec | None = None,
        pose_base_in_world: Pose = IDENTITY,
    ) -> None:
        """Make a controller.

        Args:
            arm: Kinematics and limits.
            semantics: Meaning of the actions, with the control rate.
            workspace: Box in the world that the commanded tool centre point stays in; None: the default.
            pose_base_in_world: Pose of the robot's base.
        """
        self.arm = arm
        self.semantics = semantics
        self._max_joint_step = arm.velocity / semantics.rate_hz
        self._box = WorkspaceBox(workspace or WorkspaceSpec(), pose_base_in_world)

    def start(self, joints: npt.ArrayLike, gripper: float = 1.0) -> ControllerState:
        """Return the controller's state for an arm at rest.

        Args:
            joints: Arm joint positions, shape (n,) [rad].
            gripper: Opening, 1 = open.
        """
        return ControllerState(
            pose=self.arm.fk(joints), joints=tuple(np.asarray(joints, dtype=float).tolist()), gripper=float(gripper)
        )

    @abstractmethod
    def step(self, state: ControllerState, action: npt.ArrayLike, joints_measured: Sequence[float] = ()) -> ControlStep:
        """Integrate one action."""
