"""Shared parts of the controllers: the commanded state, the result of an action, and the box that the tool stays in."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roboxim_core.actions import ActionSemantics
from roboxim_core.kinematics.arm import ArmKinematics
from roboxim_core.poses import IDENTITY, Pose, Vec3
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


class WorkspaceBox:
    """A workspace in the world, queried with positions in the robot's base.

    Note: a position that starts outside of the box is not moved inside; it only cannot move farther out.
    """

    def __init__(self, workspace: WorkspaceSpec, pose_base_in_world: Pose) -> None:
        """Describe the box.

        Args:
            workspace: The box in the world.
            pose_base_in_world: Pose of the robot's base.
        """
        self._workspace = workspace
        self._base = pose_base_in_world
        self._base_is_identity = pose_base_in_world == IDENTITY

    def keep(self, now: Vec3, then: Vec3) -> Vec3 | None:
        """Return the border position that replaces a position outside the box.

        Args:
            now: Position before the motion, in the base [m].
            then: Position after it.

        Returns:
            The replacement in the base; None: the motion stays inside.
        """
        now_world, then_world = (now, then) if self._base_is_identity else map(self._in_world, (now, then))
        bounds = zip(self._workspace.lower, self._workspace.upper, now_world, then_world, strict=True)
        inside = [min(max(c, min(low, b)), max(high, b)) for low, high, b, c in bounds]
        if all(abs(a - b) < 1e-9 for a, b in zip(inside, then_world, strict=True)):
            return None
        x, y, z = inside if self._base_is_identity else self._base.inverse().apply(inside).tolist()
        return x, y, z

    def _in_world(self, position: Vec3) -> Vec3:
        x, y, z = self._base.apply(position).tolist()
        return x, y, z


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
