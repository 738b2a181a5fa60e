"""The planner: goals, direct edge, search, shortcuts, blends, time law, verification; it replans when a step fails.

`Planner` returns a plan only after `verify` has passed the timed motion. The plan is a function of the request and its
seed. A deadline can only end a request (see `Watch`), never change its answer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ErrorCode, InvalidRequestError, PlannerError
from roboxim_core.poses import Pose
from roboxim_planner.checks import PlannerConfig, SceneChecks, in_base, no_watch
from roboxim_planner.collisions.checker import CollisionWorld
from roboxim_planner.collisions.sweep import PaddedSweep, Sweep
from roboxim_planner.constraint import Upright
from roboxim_planner.motions.lines import plan_line
from roboxim_planner.motions.paths import IMPROVERS, SearchConfig, Watch, improve, search, shorten, without_repeats
from roboxim_planner.motions.points import Trajectory
from roboxim_planner.motions.timing import Motion, MotionSequence, still, time_path
from roboxim_planner.motions.verify import at_fault, verify_motion
from roboxim_planner.plans import MotionOptions, PathIncompleteError, Plan
from roboxim_planner.scene import ROBOT, AllowedContact, PlanningScene

Array = npt.NDArray[np.float64]
Goals = tuple[Array, list[int]]
"""Arm configurations, nearest first, shape (N, dof) [rad], and the index of the goal that each belongs to."""
_BUDGETS = (1, 1, 2, 2, 4, 4)
"""Budgets of successive searches, as multiples of the configured one."""
_DIRECT = 8
"""Number of goal configurations to which the straight joint line is tried."""
_PADDINGS = (1.0, 0.2, 1.0, 0.2, 0.2, 0.0)
"""Paddings of successive searches, as fractions of the requested one."""

__all__ = ["MotionOptions", "PathIncompleteError", "Plan", "Planner", "PlannerConfig", "Trajectory", "Upright"]


class Planner(SceneChecks):
    """Plans motions of one robot. Not thread-safe; create one per thread."""

    def plan_to_pose(
        self,
        scene: PlanningScene,
        start: npt.ArrayLike,
        targets: list[Pose],
        options: MotionOptions | None = None,
        watch: Watch = no_watch,
    ) -> Plan:
        """Plan a motion of the TCP to one of several poses.

        That is the first pose to whose nearest configuration the straight joint line is free. If there is none, it is
        the pose of the nearest configuration that a search reaches.

        Args:
            scene: Obstacles to avoid.
            start: Arm configuration at the start, shape (dof,) [rad].
            targets: Goals of the TCP in the world, at least one.
            options: Limits, padding, seed; none: the defaults.
            watch: Called regularly; ends the request by raising.

        Raises:
            PlannerError: If there is no plan; the message says why.
            InvalidRequestError: On malformed input.
        """
        options = options or MotionOptions()
        if not targets:
            raise InvalidRequestError("plan_to_pose needs at least one target pose")
        worlds = self._worlds(scene, options)
        begin = self._check_start(worlds, start)
        goals = [in_base(scene.robot_pose, target) for target in targets]
        _check_upright(options, targets)
        watch("goals", 0)
        for i, goal in enumerate(goals):
            near = self.ik.nearest(goal, begin)
            if near is None or not worlds.exact.is_free(near):
                continue
            if worlds.eased(begin, near).free_edge(begin, near[None], self.config.search.resolution_m) < 0:
                continue
            plan = self._direct(worlds, begin, near, options, i)
            if plan is not None:
                return plan
        found = self._goal_configurations(worlds, begin, goals, options.seed, watch)

        def more() -> Goals:
            return self._goal_configurations(worlds, begin, goals, options.seed + 1, watch, thorough=True)

        return self._plan(worlds, begin, found, options, watch, more)

    def plan_to_joints(
        self,
        scene: PlanningScene,
        start: npt.ArrayLike,
        target: npt.ArrayLike,
        options: MotionOptions | None = None,
        watch: Watch = no_watch,
    ) -> Plan:
        """Plan a motion to an arm configuration; arguments and errors as `plan_to_pose`."""
        options = options or MotionOptions()
        worlds = self._worlds(scene, options)
        begin = self._check_start(worlds, start)
        goal = self.check_goal(scene, target, options)
        return self._plan(worlds, begin, (goal[None], [-1]), options, watch)

    def check_goal(self, scene: PlanningScene, target: npt.ArrayLike, options: MotionOptions) -> Array:
        """Return an arm configuration that a motion may end at, within the limits.

        Args:
            scene: Obstacles that it must not touch.
            target: The arm configuration, shape (dof,) [rad].
            options: The path constraint.

        Raises:
            PlannerError: ``GOAL_UNREACHABLE``, ``CONSTRAINT_VIOLATED`` or ``GOAL_IN_COLLISION``.
            InvalidRequestError: On malformed input.
        """
        goal = self.robot.check_joints(target, what="target")
        broken = self.robot.limit_violations(goal)
        if broken:
            raise PlannerError(f"goal unreachable: {'; '.join(broken)}", ErrorCode.GOAL_UNREACHABLE)
        goal = np.clip(goal, self.robot.lower, self.robot.upper)
        _check_upright(options, [scene.robot_pose @ self.robot.fk(goal)])
        world = self._worlds(scene, options).exact
        if not world.is_free(goal):
            raise PlannerError(f"goal in collision: {_contacts(world, goal)}", ErrorCode.GOAL_IN_COLLISION)
        return goal

    def plan_cartesian(
        self,
        scene: PlanningScene,
        start: npt.ArrayLike,
        waypoints: list[Pose],
        options: MotionOptions | None = None,
        *,
        min_fraction: float = 1.0,
        ignore_collisions: bool = False,
        wide: bool = True,
        watch: Watch = no_watch,
    ) -> Plan:
        """Plan straight lines of the TCP through poses, stopping at each.

        Args:
            scene: Obstacles to avoid.
            start: Arm configuration at the start, shape (dof,) [rad].
            waypoints: Poses of the TCP in the world, at least one.
            options: Limits and seed; the padding is not used, because a line is checked exactly.
            min_fraction: Smallest fraction of the lines that counts as success, 0..1.
            ignore_collisions: Whether collisions are ignored; limits and the path constraint always hold.
            wide: Whether to search widely; see `plan_line`.
            watch: Called regularly; ends the request by raising.

        Raises:
            PathIncompleteError: If less than ``min_fraction`` can be done; it holds the plan of the executable part.
            PlannerError: See `plan_to_pose`.
        """
        options = options or MotionOptions()
        if not waypoints or not 0.0 <= min_fraction <= 1.0:
            raise InvalidRequestError(
                f"plan_cartesian needs waypoints and min_fraction in 0..1, got {len(waypoints)} and {min_fraction}"
            )
        limits = self.limits(options)
        worlds = self._worlds(scene, options)
        begin = self._check_start(worlds, start, collisions=not ignore_collisions)
        sweep: Sweep | None = worlds
        if ignore_collisions:
            alone = PlanningScene(robot_pose=scene.robot_pose, allowed=(AllowedContact(body_a=ROBOT),))
            sweep = None if options.upright is None else self._worlds(alone, options)
        motions: list[Motion] = []
        at, done, reason = begin, 0.0, ""
        for i, waypoint in enumerate(waypoints):
            watch("goals", i)
            target = in_base(scene.robot_pose, waypoint)
            line = plan_line(self.robot, sweep, at, target, limits, watch, wide=wide)
            motions.append(line.motion)
            at, done, reason = line.end, done + line.part, line.reason
            if line.part < 1.0:
                break
        fraction = done / len(waypoints)
        watch("verify", 0)
        motion = MotionSequence(motions)
        plan = Plan(motion=motion, limits=limits, route="cartesian", fraction=fraction, waypoints=np.stack([begin, at]))
        if fraction < min_fraction - 1e-9:
            raise PathIncompleteError(
                f"only {100.0 * fraction:.1f} % of the straight line can be done, {100.0 * min_fraction:.0f} % needed: "
                f"{reason}",
                plan,
            )
        return plan

    def _check_start(self, worlds: PaddedSweep, start: npt.ArrayLike, *, collisions: bool = True) -> Array:
        begin = self.robot.check_joints(start, what="start")
        broken = self.robot.limit_violations(begin, tolerance=1e-3)
        if broken:
            raise PlannerError(f"start outside limits: {'; '.join(broken)}", ErrorCode.START_OUTSIDE_LIMITS)
        begin = np.clip(begin, self.robot.lower, self.robot.upper)
        worlds.check_upright(begin)
        if collisions and not worlds.exact.is_free(begin):
            raise PlannerError(
                f"start in collision: {_contacts(worlds.exact, begin)}; allow the contact or attach the body",
                ErrorCode.START_IN_COLLISION,
            )
        return begin

    def _goal_configurations(
        self, worlds: PaddedSweep, begin: Array, goals: list[Pose], seed: int, watch: Watch, *, thorough: bool = False
    ) -> Goals:
        all_found: list[Array] = []
        owners: list[int] = []
        failure: PlannerError | None = None
        for i, goal in enumerate(goals):
            watch("goals", i)
            try:
                solutions = self.ik.solve(goal, begin, seed=seed, thorough=thorough)
                free = worlds.exact.free_states(solutions)
                if not free and not thorough:
                    solutions = self.ik.solve(goal, begin, seed=seed + 1, thorough=True)
                    free = worlds.exact.free_states(solutions)
            except PlannerError as error:
                failure = failure or error
                continue
            if not free:
                failure = self._no_free_goal(worlds.exact, solutions)
            all_found += free
            owners += [i] * len(free)
        if not all_found:
            assert failure is not None
            raise failure
        order = np.argsort([np.abs(q - begin).max() for q in all_found], kind="stable")
        return np.array(all_found)[order], [owners[k] for k in order]

    def _direct(
        self, worlds: PaddedSweep, begin: Array, goal: Array, options: MotionOptions, owner: int
    ) -> Plan | None:
        """Return the plan of a straight joint line, or none if it is not valid."""
        path = np.stack([begin, goal])
        limits = self.limits(options)
        if float(np.abs(goal - begin).max()) < 1e-9:
            return Plan(motion=still(begin), limits=limits, route="still", goal_index=owner, waypoints=path)
        motion = time_path(path, np.zeros(0), limits, self.robot.kinematics.jacobian)
        if not verify_motion(worlds, self.robot, motion, limits, goal, explain=False).valid:
            return None
        return Plan(motion=motion, limits=limits, route="direct", goal_index=owner, waypoints=path)

    def _first_direct(
        self,
        worlds: PaddedSweep,
        world: CollisionWorld,
        begin: Array,
        found: Goals,
        options: MotionOptions,
        watch: Watch,
    ) -> Plan | None:
        """Return the plan of the first valid straight joint line to one of the goals, or none."""
        watch("direct", 0)
        goals, owners = found[0][:_DIRECT], found[1]
        at = 0
        while at < len(goals):
            k = world.free_edge(begin, goals[at:], self.config.search.resolution_m)
            if k < 0:
                return None
            plan = self._direct(worlds, begin, goals[at + k], options, owners[at + k])
            if plan is not None:
                return plan
            at += k + 1
        return None

    def _plan(
        self,
        worlds: PaddedSweep,
        begin: Array,
        found: Goals,
        options: MotionOptions,
        watch: Watch,
        more: Callable[[], Goals] | None = None,
    ) -> Plan:
        """Try direct edges to the goals, nearest first; then search until a motion passes verification.

        ``more`` returns the goal configurations of a longer search with another seed. They take the place of the known
        ones when the first search gives no valid motion: most are near one of these, the nearest one nearly always.
        """
        goals, owners = found
        world = worlds.eased(begin, goals)
        plan = self._first_direct(worlds, world, begin, found, options, watch)
        if plan is not None:
            return plan
        failed: tuple[Motion, Array] | None = None
        refused = 0
        for attempt, budget in enumerate(_BUDGETS[: self.config.attempts]):
            if attempt == 1 and more is not None:
                goals, owners = more()
            if attempt:
                world = worlds.eased(begin, goals, _PADDINGS[attempt])
            seed = options.seed + 7919 * attempt
            config = self._search_config(options, budget, refused)
            path = search(world, begin, goals, seed=seed, config=config, watch=watch)
            if path is None:
                continue
            path = without_repeats(path)
            owner = owners[int(np.argmin(np.abs(goals - path[-1]).max(axis=1)))]
            path = shorten(world, path, seed=seed, config=config, watch=watch)
            if options.planner in IMPROVERS and options.upright is None:
                iterations = options.improve_iterations or config.improve_iterations
                path = improve(
                    options.planner, world, path, seed=seed, iterations=iterations, config=config, watch=watch
                )
            motion, valid = self._time_and_verify(worlds, world, path, options, watch)
            if valid:
                limits = self.limits(options)
                return Plan(motion=motion, limits=limits, route="sampled", goal_index=owner, waypoints=path)
            failed = motion, path[-1]
            refused += 1
        if failed is not None:
            finding = verify_motion(worlds, self.robot, failed[0], self.limits(options), failed[1])
            raise PlannerError(f"no path passed verification, the last because {finding}", ErrorCode.TRAJECTORY_INVALID)
        constraint = "" if options.upright is None else " that keeps the tool upright"
        raise PlannerError(
            f"no path{constraint} found to {len(goals)} goal configuration(s) in {self.config.attempts} searches; "
            "obstacles may close the way"
        )

    def _search_config(self, options: MotionOptions, budget: int, refused: int) -> SearchConfig:
        """Return the settings of a search: its resolution becomes finer with every motion that verification refuses."""
        base = self.config.search
        planners = base.planners
        if budget == 1 and not refused and options.planner in (*IMPROVERS, planners[0][0]):
            return base
        if options.planner not in IMPROVERS and options.planner != planners[0][0]:
            max_iterations = max(iterations for _, iterations in planners)
            planners = ((options.planner, max_iterations), *planners)
        return replace(
            base,
            planners=tuple((name, budget * iterations) for name, iterations in planners),
            upright_iterations=budget * base.upright_iterations,
            resolution_m=base.resolution_m / (1 + refused),
        )

    def _time_and_verify(
        self, sweep: Sweep, world: CollisionWorld, path: Array, options: MotionOptions, watch: Watch
    ) -> tuple[Motion, bool]:
        """Time a path with blends, then with smaller blends, then with stops at its waypoints, until one is valid.

        Returns:
            The last motion tried, and whether it is valid.
        """
        limits = self.limits(options)
        corners = world.blends(path, self.config.max_blend_rad, self.config.search.resolution_m)
        for shrink in (1.0, 0.4, 0.0) if corners.any() else (1.0,):
            watch("timing", 0)
            motion = time_path(path, corners * shrink, limits, self.robot.kinematics.jacobian)
            watch("verify", 0)
            if verify_motion(sweep, self.robot, motion, limits, path[-1], explain=False).valid:
                return motion, True
        return motion, False


def _contacts(world: CollisionWorld, joints: Array) -> str:
    return "; ".join(str(contact) for contact in at_fault(world, joints)[0])


def _check_upright(options: MotionOptions, targets: list[Pose]) -> None:
    """Check that the tool is upright at one of several goals, given as poses of the TCP in the world."""
    if options.upright is None:
        return
    tool, world = (np.array(axis) for axis in (options.upright.tool_axis, options.upright.world_axis))
    cosines = [target.rotation.apply(tool) @ world for target in targets]
    tilt = float(np.arccos(np.clip(max(cosines) / (np.linalg.norm(tool) * np.linalg.norm(world)), -1.0, 1.0)))
    if tilt > options.upright.tolerance_rad:
        raise PlannerError(
            f"the tool is tilted by {tilt:.3f} rad at the goal, {options.upright.tolerance_rad:g} rad allowed",
            ErrorCode.CONSTRAINT_VIOLATED,
        )
