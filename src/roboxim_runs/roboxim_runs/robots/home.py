"""A home pose for an arm: the tool above the table's middle, joints near the middle of their ranges."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ConfigError, PlannerError
from roboxim_core.kinematics.arm import ArmKinematics
from roboxim_core.models.description import RobotModel
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_planner.ik import IkSolver
from roboxim_planner.robot import PlannerRobot

TOOL_DOWN = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0))
"""Quaternions (x, y, z, w) of a tool that points down and opens along the base's y axis; a gripper is symmetric."""
PLACES = ((0.5, 0.0, 0.4), (0.45, 0.0, 0.35), (0.4, 0.0, 0.3), (0.3, 0.0, 0.25), (0.2, 0.0, 0.2))
"""Positions of the TCP in the base to try, farthest first [m]; a small arm reaches the last ones only."""


def same_place(robot: RobotModel, name: str, folder: Path) -> list[float]:
    """Return arm joint positions that hold another gripper where a robot's own is at home [rad].

    Args:
        robot: The robot.
        name: Id of the same arm with the other gripper.
        folder: Configuration folder that has it in ``robots``.
    """
    other = ArmKinematics(ModelLibrary(folder).robot(name))
    joints = np.array(robot.home)
    for _ in range(10):  # each call takes a fixed number of steps
        found = other.ik_near(ArmKinematics(robot).fk(robot.home), joints)
        joints = found.joints
        if found.converged:
            return [float(q) for q in joints]
    return [float(q) for q in home_of(name, folder)]


def home_of(name: str, folder: Path) -> npt.NDArray[np.float64]:
    """Return arm joint positions, shape (dof,) [rad].

    Args:
        name: Id of the robot.
        folder: Configuration folder that has it in ``robots``.

    Raises:
        ConfigError: When the arm cannot point its tool down above the table.
    """
    robot = ModelLibrary(folder).robot(name)
    solver = IkSolver(PlannerRobot(robot))
    lower, upper = np.array(robot.limits.lower), np.array(robot.limits.upper)
    middle = (lower + upper) / 2
    for place, turn in itertools.product(PLACES, TOOL_DOWN):
        try:
            found = solver.solve(Pose(position=place, quat_xyzw=turn), middle, seed=0, thorough=True)
        except PlannerError:
            continue
        off = np.abs(found - middle) / (upper - lower)
        return np.asarray(found[np.argmin(np.linalg.norm(off, axis=1) + off.max(axis=1))])
    raise ConfigError(
        f"{name}: no joint positions point the tool down above the table (tried x = 0.2 to 0.5 m from the base); "
        "check base, flange and the mount of the gripper, whose z axis must point out of the flange (if the flange's "
        "x axis points out, --mount-rpy '0 1.5708 0' turns it), or give home"
    )
