"""What the controllers share: the commanded state, the result of an action, and the choice of a controller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy.typing as npt

from roboxim_core.kinematics.arm import ArmKinematics
from roboxim_core.poses import Pose


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
    """Whether the arm cannot reach the pose in this tick; the commanded pose is then the one that it does reach."""


class Controller(Protocol):
    """Converter of actions of one meaning to joint targets: a pure function of its arguments."""

    arm: ArmKinematics

    def start(self, joints: npt.ArrayLike, gripper: float = 1.0) -> ControllerState:
        """Return the controller's state for an arm at rest."""
        ...

    def step(self, state: ControllerState, action: npt.ArrayLike, joints_measured: Sequence[float] = ()) -> ControlStep:
        """Integrate one action."""
        ...
