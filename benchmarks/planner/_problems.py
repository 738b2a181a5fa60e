"""Planning problems by seed: the format that all contenders receive, and tabletop scenes.

A problem consists of plain values in the frame of the robot's base, so that a process without RoboXim can read it. This
module does not use the planner: goals come from random configurations and `roboxim_core`'s kinematics, and the referee
decides whether a configuration is free.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
import pinocchio as pin
from benchmarks.planner._machines import machine
from benchmarks.planner._referee import Referee, Solid

from roboxim_core.kinematics.arm import ArmKinematics
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose

Array = npt.NDArray[np.float64]
PADDING_M = 0.005
"""Distance to obstacles that contenders keep while searching, if the problem's start and goal allow it."""
TABLE = Solid(kind="box", size=(0.9, 1.4, 0.05), position=(0.5, 0.0, -0.025))
STICK = Solid(kind="box", size=(0.02, 0.02, 0.12), position=(0.0, 0.0, 0.03))


@dataclass(frozen=True, kw_only=True)
class Problem:
    """One planning problem."""

    name: str
    """Family and seed, e.g. ``tabletop-17``."""
    solids: tuple[Solid, ...]
    """Obstacles, poses in the robot's base."""
    held: Solid | None = None
    """Solids that the gripper holds, poses in the tcp frame."""
    start: tuple[float, ...]
    """Arm configuration [rad]."""
    goal: tuple[float, ...]
    """Tcp in the base: position [m] and quaternion xyzw, 7 numbers; or an arm configuration, see ``goal_is_joints``."""
    goal_is_joints: bool = False
    """Whether the goal is an arm configuration."""
    padding_m: float = 0.0
    """Distance to keep from obstacles while searching [m]."""
    robot: str = "panda"
    """The arm, as in ``config/robots``."""
    detour: bool = False
    """Whether the direct joint line to the nearest goal configuration collides."""

    @property
    def family(self) -> str:
        """Kind of scene."""
        return self.name.rsplit("-", 1)[0]

    @property
    def goal_value(self) -> pin.SE3 | Array:
        """The goal in the referee's format."""
        return np.array(self.goal) if self.goal_is_joints else pin.XYZQUATToSE3(np.array(self.goal))

    def referee(self) -> Referee:
        """Return the referee of the problem's scene."""
        return Referee(self.solids, self.held, self.robot)

    def plain(self) -> dict[str, Any]:
        """Return the problem as JSON types."""
        return dataclasses.asdict(self)


@cache
def arm(robot: str = "panda") -> ArmKinematics:
    """Return an arm's kinematics."""
    return ArmKinematics(ModelLibrary().robot(robot))


def problem(name: str, referee: Referee, start: Array, end: Array, *, joints: bool = False) -> Problem:
    """Create a problem from a scene and two free configurations.

    Args:
        name: Name of the problem.
        referee: The scene.
        start: Configuration at the start.
        end: A configuration at the goal.
        joints: Whether the goal is that configuration instead of its tcp pose.
    """
    goal = referee.tcp(end)
    wide = all(referee.keeps(q, 1.1 * PADDING_M) for q in (start, end))
    return Problem(
        name=name,
        solids=referee.solids,
        held=referee.held,
        start=tuple(start.tolist()),
        goal=tuple(end.tolist() if joints else pin.SE3ToXYZQUAT(goal).tolist()),
        goal_is_joints=joints,
        padding_m=PADDING_M if wide else 0.0,
        robot=referee.machine.name,
        detour=is_detour(referee, start, end, goal, joints=joints),
    )


def is_detour(referee: Referee, start: Array, end: Array, goal: pin.SE3, *, joints: bool = False) -> bool:
    """Return whether the joint lines to a goal configuration and to the one nearest to the start collide."""
    if not referee.edge_collides(start, end):
        return False
    near = arm(referee.machine.name).ik_near(Pose.from_matrix(goal.homogeneous), start)
    return joints or not near.converged or referee.edge_collides(start, near.joints)


def configuration_at(rng: np.random.Generator, pose: pin.SE3, robot: str = "panda") -> Array | None:
    """Return a random arm configuration with the tcp at a pose, or none if the attempt fails."""
    lower, upper = machine(robot).lower, machine(robot).upper
    seed = rng.uniform(0.8 * lower + 0.2 * upper, 0.2 * lower + 0.8 * upper)
    found = arm(robot).ik_near(Pose.from_matrix(pose.homogeneous), seed)
    inside = found.converged and bool(((found.joints >= lower) & (found.joints <= upper)).all())
    return found.joints if inside else None


def free_configuration(
    rng: np.random.Generator, referee: Referee, draw: Callable[[np.random.Generator], pin.SE3], attempts: int = 60
) -> Array | None:
    """Return a free configuration at one of some random tcp poses, or none."""
    for _ in range(attempts):
        joints = configuration_at(rng, draw(rng), referee.machine.name)
        if joints is not None and not referee.collides(joints) and not referee.folds(joints):
            return joints
    return None


def tabletop(seed: int, salt: int = 0, robot: str = "panda") -> Problem:
    """Draw a tabletop problem: 3 to 10 boxes, cylinders and spheres on a table; every third with a stick in the hand.

    In every second problem the direct joint line collides. A solution exists unless the path is blocked completely.

    Args:
        seed: Number of the problem.
        salt: Selects a set of problems.
        robot: The arm, one of ``_machines.MACHINES``.
    """
    rng = np.random.default_rng([20260, salt, seed])
    while True:
        solids = [TABLE, *(_on_table(rng) for _ in range(rng.integers(3, 11)))]
        referee = Referee(solids, STICK if seed % 3 == 0 else None, robot)
        for _ in range(10):
            start, end = (free_configuration(rng, referee, _above_table) for _ in range(2))
            if start is None or end is None:
                break
            drawn = problem(f"tabletop-{seed}", referee, start, end)
            if drawn.detour or seed % 2:
                return drawn


def _on_table(rng: np.random.Generator) -> Solid:
    kind = rng.choice(["box", "box", "cylinder", "sphere"])
    height = rng.uniform(0.05, 0.4)
    size: tuple[float, ...] = (rng.uniform(0.03, 0.15), rng.uniform(0.03, 0.15), height)
    if kind == "cylinder":
        size = (rng.uniform(0.015, 0.08), height)
    elif kind == "sphere":
        size = (rng.uniform(0.03, 0.08),)
        height = 2.0 * size[0]
    yaw = rng.uniform(0.0, np.pi)
    place = (rng.uniform(0.3, 0.8), rng.uniform(-0.5, 0.5), height / 2 + 0.001)
    return Solid(kind=str(kind), size=size, position=place, quat_xyzw=(0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)))


def _above_table(rng: np.random.Generator) -> pin.SE3:
    tilt = pin.rpy.rpyToMatrix(rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5), rng.uniform(-np.pi, np.pi))
    return pin.SE3(tilt @ np.diag([1.0, -1.0, -1.0]), rng.uniform([0.3, -0.45, 0.05], [0.75, 0.45, 0.45]))
