"""Requests to the planner as plain values, independent of ROS messages.

The node converts messages to queries. A dump stores a query in a file, so that a failure can be run again and drawn
without the graph in which it happened.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import InvalidRequestError, one_of
from roboxim_core.poses import Pose
from roboxim_planner.motions.paths import Watch
from roboxim_planner.motions.retime import DEFAULT_TOLERANCE_RAD, retime
from roboxim_planner.pipeline import MotionOptions, Plan, Planner
from roboxim_planner.scene import PlanningScene
from roboxim_planner.sequence import Stage, plan_sequence

Array = npt.NDArray[np.float64]
IK_MODES = ("nearest", "any", "all")
_ALL = 10_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Answer:
    """Answer to a query."""

    plans: tuple[Plan, ...] = ()
    """Motions; one, or one per stage of a sequence."""
    goal_indices: tuple[int, ...] = ()
    """Index of the goal that each plan reached; -1 if there is a single goal."""
    solutions: Array = field(default_factory=lambda: np.empty((0, 0)))
    """Solutions of inverse kinematics, shape (N, dof) [rad]."""

    @property
    def digest(self) -> str:
        """Hash of goal indices, solutions and plans (sampled every 10 ms), 16 hexadecimal digits."""
        hashed = hashlib.blake2b(digest_size=8)
        hashed.update(repr((self.goal_indices, self.solutions.shape)).encode())
        hashed.update(self.solutions.tobytes())
        for plan in self.plans:
            samples = plan.sample(0.01)
            hashed.update(samples.times.tobytes() + samples.positions.tobytes())
        return hashed.hexdigest()


@dataclass(frozen=True, kw_only=True)
class Query:
    """Base class of all queries."""

    kind: ClassVar[str] = ""
    """Name of the service."""

    robot: str
    """Id of the robot model."""
    scene: PlanningScene = PlanningScene()
    """Scene whose bodies to avoid."""
    start: tuple[float, ...] = ()
    """Arm joints at the start; for inverse kinematics: the reference to measure distances from [rad]."""
    options: MotionOptions = MotionOptions()
    """Limits, padding, seed."""

    def run(self, planner: Planner, watch: Watch, entered: Callable[[int], None] = lambda _: None) -> Answer:
        """Answer the query.

        Args:
            planner: Planner of the robot.
            watch: Called regularly; ends the query by raising.
            entered: Called with the index of the stage of a sequence that is being planned.

        Raises:
            RoboximError: If there is no answer; the message says why.
        """
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class PoseQuery(Query):
    """A motion of the TCP to one of several poses."""

    kind: ClassVar[str] = "plan_to_pose"

    targets: tuple[Pose, ...]
    """Goals of the TCP in the world."""

    def run(self, planner: Planner, watch: Watch, entered: Callable[[int], None] = lambda _: None) -> Answer:
        """Answer the query."""
        plan = planner.plan_to_pose(self.scene, self.start, list(self.targets), self.options, watch)
        return Answer(plans=(plan,), goal_indices=(plan.goal_index,))


@dataclass(frozen=True, kw_only=True)
class JointsQuery(Query):
    """A motion to an arm configuration."""

    kind: ClassVar[str] = "plan_to_joints"

    goal: tuple[float, ...]
    """Arm joints at the goal [rad]."""

    def run(self, planner: Planner, watch: Watch, entered: Callable[[int], None] = lambda _: None) -> Answer:
        """Answer the query."""
        plan = planner.plan_to_joints(self.scene, self.start, self.goal, self.options, watch)
        return Answer(plans=(plan,), goal_indices=(-1,))


@dataclass(frozen=True, kw_only=True)
class LineQuery(Query):
    """Straight lines of the TCP."""

    kind: ClassVar[str] = "plan_cartesian"

    waypoints: tuple[Pose, ...]
    """Poses of the TCP in the world."""
    min_fraction: float = 1.0
    """Smallest fraction that counts as success, 0..1."""
    ignore_collisions: bool = False
    """Whether collisions are ignored."""

    def run(self, planner: Planner, watch: Watch, entered: Callable[[int], None] = lambda _: None) -> Answer:
        """Answer the query."""
        plan = planner.plan_cartesian(
            self.scene,
            self.start,
            list(self.waypoints),
            self.options,
            min_fraction=self.min_fraction,
            ignore_collisions=self.ignore_collisions,
            watch=watch,
        )
        return Answer(plans=(plan,), goal_indices=(-1,))


@dataclass(frozen=True, kw_only=True)
class SequenceQuery(Query):
    """Several motions, one after the other."""

    kind: ClassVar[str] = "plan_sequence"

    stages: tuple[Stage, ...]
    """The motions."""

    def run(self, planner: Planner, watch: Watch, entered: Callable[[int], None] = lambda _: None) -> Answer:
        """Answer the query."""
        found = plan_sequence(planner, self.scene, self.start, self.stages, self.options, watch, entered=entered)
        return Answer(plans=found.plans, goal_indices=found.goal_indices)


@dataclass(frozen=True, kw_only=True)
class RetimeQuery(Query):
    """A time law for a path."""

    kind: ClassVar[str] = "retime_path"

    path: tuple[tuple[float, ...], ...]
    """Arm configurations [rad]."""
    tolerance_rad: float = DEFAULT_TOLERANCE_RAD
    """Largest distance of the motion from the path, in any joint [rad]."""
    stop_at_points: bool = False
    """Whether to stop at every point."""
    check_collisions: bool = False
    """Whether the motion must keep clear of the scene."""

    def run(self, planner: Planner, watch: Watch, entered: Callable[[int], None] = lambda _: None) -> Answer:
        """Answer the query."""
        watch("timing", 0)
        plan = retime(
            planner,
            self.path,
            self.options,
            tolerance_rad=self.tolerance_rad,
            stop_at_points=self.stop_at_points,
            scene=self.scene if self.check_collisions else None,
            watch=watch,
        )
        return Answer(plans=(plan,), goal_indices=(-1,))


@dataclass(frozen=True, kw_only=True)
class IkQuery(Query):
    """Arm configurations for a pose of the TCP."""

    kind: ClassVar[str] = "compute_ik"

    target: Pose
    """The TCP in the world."""
    mode: str = "nearest"
    """``nearest``, ``any`` or ``all``."""
    count: int = 1
    """Largest number of solutions; 0: no limit."""
    avoid_collisions: bool = False
    """Whether solutions must be free of collisions."""

    def run(self, planner: Planner, watch: Watch, entered: Callable[[int], None] = lambda _: None) -> Answer:
        """Answer the query."""
        if self.mode not in IK_MODES:
            raise InvalidRequestError(f"unknown mode '{self.mode}'; {one_of(IK_MODES, self.mode)}")
        watch("goals", 0)
        count = self.count or _ALL
        solutions = planner.inverse_kinematics(
            self.target,
            self.start,
            scene=self.scene if self.avoid_collisions else None,
            robot_pose=self.scene.robot_pose,
            count=count if self.mode != "nearest" else _ALL,
            seed=self.options.seed,
            watch=watch,
        )
        return Answer(solutions=solutions[:count])


QUERIES: dict[str, type[Query]] = {
    cls.kind: cls for cls in (PoseQuery, JointsQuery, LineQuery, SequenceQuery, RetimeQuery, IkQuery)
}
"""Query classes by the name of their service."""


def run_query(query: Query, planner: Planner, watch: Watch, entered: Callable[[int], None] = lambda _: None) -> Answer:
    """Run a query and call the watch once more at the end; see `Query.run`."""
    answer = query.run(planner, watch, entered)
    watch("answer", 0)
    return answer
