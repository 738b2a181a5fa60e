"""What the planner says of a robot in a scene without planning: limits, checks, inverse kinematics, named states."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ErrorCode, InvalidRequestError, PlannerError, one_of
from roboxim_core.models.description import RobotModel
from roboxim_core.poses import IDENTITY, Pose
from roboxim_planner.collisions.checker import CollisionWorld
from roboxim_planner.collisions.sweep import PaddedSweep, Sweep
from roboxim_planner.ik import IkConfig, IkSolver
from roboxim_planner.motions.paths import SearchConfig, Watch
from roboxim_planner.motions.timing import MotionLimits
from roboxim_planner.motions.verify import Finding, at_fault, verify_samples
from roboxim_planner.plans import MotionOptions
from roboxim_planner.robot import PlannerRobot
from roboxim_planner.scene import PlanningScene

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class PlannerConfig:
    """Configuration of the planner."""

    padding_m: float = 0.005
    """Distance that the search keeps from obstacles where start and goal allow it [m]."""
    max_blend_rad: float = 0.4
    """Largest distance from a corner at which its blend begins [rad]."""
    attempts: int = 6
    """Largest number of searches, each with another seed, until a motion passes verification; at most 6."""
    ik: IkConfig = IkConfig()
    """Inverse kinematics."""
    search: SearchConfig = SearchConfig()
    """Path search."""


def no_watch(stage: str, iterations: int) -> None:
    """Watch that never ends a request."""


class SceneChecks:
    """A robot and the scenes that it is checked in; the last 4 are kept."""

    def __init__(self, robot: RobotModel, config: PlannerConfig | None = None) -> None:
        """Load the robot.

        Args:
            robot: The robot's description.
            config: Configuration; none: the defaults.
        """
        self.robot = PlannerRobot(robot)
        self.config = config or PlannerConfig()
        self.ik = IkSolver(self.robot, self.config.ik)
        self._kept: list[PaddedSweep] = []

    def check_state(self, scene: PlanningScene, joints: npt.ArrayLike) -> Finding:
        """Check an arm configuration of shape (dof,) [rad] for joint limits and collisions, without padding."""
        q = self.robot.check_joints(joints, what="state")
        world = self._worlds(scene, MotionOptions()).exact
        return Finding(contacts=world.contacts(q), violations=self.robot.limit_violations(q))

    def check_trajectory(
        self,
        scene: PlanningScene,
        positions: npt.ArrayLike,
        times: npt.ArrayLike | None = None,
        velocities: npt.ArrayLike | None = None,
        accelerations: npt.ArrayLike | None = None,
        options: MotionOptions | None = None,
        watch: Watch = no_watch,
    ) -> Finding:
        """Check a joint path or sampled trajectory, with straight lines between its points; see `verify_samples`.

        Args:
            scene: Obstacles to avoid.
            positions: Arm configurations, shape (N, dof), N >= 1 [rad].
            times: Strictly increasing, shape (N,) [s]; none: no speeds are checked.
            velocities: Shape (N, dof) [rad/s]; none: computed from positions and times.
            accelerations: Shape (N, dof) [rad/s^2]; none: not checked.
            options: Limits, path constraint and padding; if they give no padding, 0.
            watch: Called now and then; ends the request by raising.
        """
        options = options or MotionOptions()
        path = np.atleast_2d(np.asarray(positions, dtype=float))
        if path.shape[0] == 0 or path.shape[1] != self.robot.dof or not np.isfinite(path).all():
            raise InvalidRequestError(
                f"a trajectory needs finite positions of shape (N, {self.robot.dof}), N >= 1, got shape {path.shape}"
            )
        clock = None if times is None else np.asarray(times, dtype=float)
        if clock is not None and not (
            clock.shape == path.shape[:1] and np.isfinite(clock).all() and (np.diff(clock) > 0).all()
        ):
            raise InvalidRequestError("times of a trajectory must be finite, one per point, and strictly increasing")
        rates = []
        for name, values in (("velocities", velocities), ("accelerations", accelerations)):
            array = None if values is None else np.asarray(values, dtype=float)
            if array is not None and (array.shape != path.shape or not np.isfinite(array).all()):
                raise InvalidRequestError(f"{name} must be finite and of the positions' shape {path.shape}")
            rates.append(array)
        sweep: Sweep = self._worlds(scene, MotionOptions(upright=options.upright))
        if options.padding_m:
            sweep = Sweep(self.robot, scene, padding=options.padding_m, upright=options.upright)
        return verify_samples(sweep, self.limits(options), path, clock, rates[0], rates[1], watch)

    def inverse_kinematics(
        self,
        target: Pose,
        reference: npt.ArrayLike,
        *,
        scene: PlanningScene | None = None,
        robot_pose: Pose | None = None,
        count: int = 1,
        seed: int = 0,
        watch: Watch = no_watch,
    ) -> Array:
        """Return arm configurations that put the TCP at a pose, nearest to a reference first.

        A ``count`` of 1 is quick: the solution that a descent from the reference reaches, or else the nearest free one,
        or without a scene the first found. It may not be the nearest of all.

        Args:
            target: The TCP in the world.
            reference: Arm configuration to measure distances from, shape (dof,) [rad].
            scene: Obstacles that solutions must not touch; none: collisions are not checked.
            robot_pose: Pose of the base in the world if there is no scene; none: identity.
            count: Largest number of solutions.
            seed: Seed of the search.
            watch: Called now and then; ends the request by raising.

        Returns:
            Shape (N, dof), 1 <= N <= count.

        Raises:
            PlannerError: ``GOAL_UNREACHABLE`` or ``GOAL_IN_COLLISION``.
        """
        near = self.robot.check_joints(reference, what="seed_state")
        goal = in_base(scene.robot_pose if scene is not None else (robot_pose or IDENTITY), target)
        if count == 1 and scene is None:
            return self.ik.any(goal, near, seed=seed)[None]
        world = None if scene is None else self._worlds(scene, MotionOptions()).exact
        if count == 1 and world is not None:
            first = self.ik.nearest(goal, near)
            if first is not None and world.is_free(first):
                return first[None]
        watch("goals", 0)
        solutions = self.ik.solve(goal, near, seed=seed)
        if world is None:
            return solutions[:count]
        free = world.free_states(solutions)
        if len(free) < count:
            watch("goals", 1)
            solutions = self.ik.solve(goal, near, seed=seed + 1, thorough=True)
            free += world.free_states(solutions)
        if not free:
            raise self._no_free_goal(world, solutions)
        return self.ik.distinct(np.array(free), near)[:count]

    def limits(self, options: MotionOptions) -> MotionLimits:
        """Return the limits of this robot under the options."""
        return MotionLimits(
            velocity=self.robot.max_velocity * options.velocity_scaling,
            acceleration=self.robot.max_acceleration * options.acceleration_scaling,
            jerk=self.robot.max_jerk * options.acceleration_scaling,
            tcp_speed=options.max_tcp_speed_m_s,
            tcp_rot_speed=options.max_tcp_rot_speed_rad_s,
        )

    def _worlds(self, scene: PlanningScene, options: MotionOptions) -> PaddedSweep:
        """Return the geometry of a scene; the last 4 are cached, since successive requests share a scene."""
        padding = self.config.padding_m if options.padding_m is None else options.padding_m
        for kept in self._kept:
            if (kept.search_padding, kept.upright) == (padding, options.upright) and kept.scene == scene:
                return kept
        worlds = PaddedSweep(self.robot, scene, padding, options.upright)
        self._kept = [worlds, *self._kept[:3]]
        return worlds

    def named_state(self, name: str) -> Array:
        """Return a named arm configuration of the robot.

        Raises:
            InvalidRequestError: On an unknown name; the message lists the known names.
        """
        states = {"home": self.robot.description.home, **self.robot.description.named_states}
        if name not in states:
            raise InvalidRequestError(f"robot '{self.robot.description.id}': unknown state; {one_of(states, name)}")
        return np.array(states[name])

    @staticmethod
    def _no_free_goal(world: CollisionWorld, solutions: Array) -> PlannerError:
        contacts, broken = at_fault(world, solutions[0])
        causes = "; ".join([*(str(contact) for contact in contacts[:3]), *broken])
        return PlannerError(
            f"no {'collision-free' if contacts else 'upright'} goal among {len(solutions)} configurations; "
            f"at the nearest {causes}",
            ErrorCode.GOAL_IN_COLLISION if contacts else ErrorCode.CONSTRAINT_VIOLATED,
        )


def in_base(base: Pose, target: Pose) -> Pose:
    """Return a pose in the world relative to the pose of the base in the world."""
    return target if base == IDENTITY else base.inverse() @ target
