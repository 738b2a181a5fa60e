"""Collision-free joint paths: OMPL over whole-edge checks in the native kernel, then random shortcuts.

RRTConnect finds a path in open space within a few dozen iterations, but hardly ever one through narrow openings. The
KPIECE family has the opposite strengths. So a search is a list of planners with budgets, tried in this order.

OMPL draws from a global random number generator, so searches take turns under a lock and set its seed first. Budgets
are iterations, not seconds: the same request gives the same path under any load.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou

from roboxim_planner.collisions.checker import CollisionWorld

Array = npt.NDArray[np.float64]
Watch = Callable[[str, int], None]
"""Called with the stage and the iterations spent; raises to end the request (deadline passed, cancelled)."""

_OMPL_LOCK = threading.Lock()
_WATCH_EVERY = 16
ou.setLogLevel(ou.LOG_NONE)  # OMPL warns about each new seed, although seeding under the lock is reproducible

SAME_RAD = 1e-7
"""Waypoints that differ by at most this in every joint count as one [rad]."""
IMPROVERS = ("BITstar", "RRTstar", "InformedRRTstar")
"""Planners that keep improving a path."""
FINDERS = ("RRTConnect", "LBKPIECE1", "BKPIECE1", "KPIECE1", "RRT")
"""Planners that stop at the first path."""


@dataclass(frozen=True, kw_only=True)
class SearchConfig:
    """Budget of the path search."""

    planners: tuple[tuple[str, int], ...] = (("RRTConnect", 250), ("LBKPIECE1", 12000), ("BKPIECE1", 3000))
    """Planners in the order tried, each with its iterations."""
    range_rad: float = 1.2
    """Longest edge that a tree grows by [rad]."""
    resolution_m: float = 5e-4
    """Resolution of edge checks: the motion of the arm's points below which a free state stands for its surroundings on
    the edge [m]. For a pair that keeps a larger distance, that distance."""
    shortcuts: int = 100
    """Random shortcuts tried."""
    upright_iterations: int = 3000
    """Iterations of the search under a path constraint."""
    upright_step_rad: float = 0.25
    """Longest edge of that search [rad]."""
    improve_iterations: int = 3000
    """Iterations of a planner that improves a path, for requests that give none."""


class _EdgeValidator(ob.MotionValidator):  # type: ignore[misc]
    """Checks whole edges in the native kernel. It must not refer to the space information: that cycle would leak."""

    def __init__(self, info: ob.SpaceInformation, world: CollisionWorld, resolution: float) -> None:
        super().__init__(info)
        self._free = world.native.path_is_free
        self._margins = world.margins(resolution)
        self._dof = world.robot.dof
        self._edge = np.empty((2, self._dof))

    def checkMotion(self, start: ob.State, end: ob.State) -> bool:  # noqa: N802 - OMPL's name
        edge = self._edge
        edge[0] = start[0 : self._dof]
        edge[1] = end[0 : self._dof]
        return self._free(edge, self._margins)


class _Stop:
    """Ends a search after n iterations or when the watch raises; stores the exception, which OMPL cannot propagate."""

    def __init__(self, watch: Watch, iterations: int) -> None:
        self._watch = watch
        self._left = iterations
        self.spent = 0
        self.error: BaseException | None = None

    def __call__(self) -> bool:
        self.spent += 1
        if self.error is None and self.spent % _WATCH_EVERY == 1:
            try:
                self._watch("search", self.spent)
            except BaseException as error:  # raised again after OMPL has returned
                self.error = error
        return self.error is not None or self.spent > self._left


def search(
    world: CollisionWorld, start: Array, goals: Array, *, seed: int, config: SearchConfig, watch: Watch
) -> Array | None:
    """Search a collision-free path from a configuration to any of several.

    Args:
        world: Robot and obstacles.
        start: Free arm configuration, shape (dof,) [rad].
        goals: Free arm configurations, shape (N, dof) [rad].
        seed: Seed of the search.
        config: Budget.
        watch: Called regularly; ends the search by raising.

    Returns:
        Waypoints, shape (M, dof), the last one a goal; none if the budget is spent.
    """
    if world.upright is not None:
        found = world.native.connect_upright(
            start,
            goals,
            seed,
            config.upright_iterations,
            config.upright_step_rad,
            world.margins(config.resolution_m),
            lambda spent: watch("search", spent),
        )
        return found if len(found) else None
    with _OMPL_LOCK:
        _seed(world, seed)
        for name, iterations in config.planners:
            path = _solve(name, world, start, goals, iterations, config, watch)
            if path is not None:
                return path
    return None


def improve(
    planner: str, world: CollisionWorld, path: Array, *, seed: int, iterations: int, config: SearchConfig, watch: Watch
) -> Array:
    """Look for a shorter path with the same ends.

    Args:
        planner: One of `IMPROVERS`.
        world: Robot and obstacles.
        path: Free waypoints, shape (N, dof) [rad].
        seed: Seed of the search.
        iterations: Iterations of the planner.
        config: Remaining settings of the search.
        watch: Called regularly; ends the search by raising.

    Returns:
        The shorter of the given and the found path.
    """
    with _OMPL_LOCK:
        _seed(world, seed)
        found = _solve(planner, world, path[0], path[-1:], iterations, config, watch)
    if found is None:
        return path
    found = shorten(world, without_repeats(found), seed=seed, config=config, watch=watch)
    return min(path, found, key=lambda points: _length(world, points))


def _seed(world: CollisionWorld, seed: int) -> None:
    """Reseed OMPL's random numbers, after all one-time draws are done."""
    _space(tuple(world.robot.lower.tolist()), tuple(world.robot.upper.tolist()))
    ou.RNG.setSeed(seed % (2**31 - 1) + 1)


def _length(world: CollisionWorld, path: Array) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0) / world.robot.max_velocity, axis=1).sum())


def _solve(
    name: str, world: CollisionWorld, start: Array, goals: Array, iterations: int, config: SearchConfig, watch: Watch
) -> Array | None:
    robot = world.robot
    info = ob.SpaceInformation(_space(tuple(robot.lower.tolist()), tuple(robot.upper.tolist())))
    # RRTConnect keeps a state only with the edge to it, whose check includes its ends
    by_edges = name == "RRTConnect"
    info.setStateValidityChecker(lambda state: by_edges or world.is_free(state[0 : robot.dof]))
    info.setMotionValidator(_EdgeValidator(info, world, config.resolution_m))
    info.setup()
    problem = ob.ProblemDefinition(info)
    targets = ob.GoalStates(info)
    _, state = _scratch(robot.dof)  # OMPL copies it
    for i, joints in enumerate((start, *goals)):
        for j, value in enumerate(joints):
            state[j] = float(value)
        if i == 0:
            problem.addStartState(state)
        else:
            targets.addState(state)
    problem.setGoal(targets)
    if name in IMPROVERS:
        problem.setOptimizationObjective(ob.PathLengthOptimizationObjective(info))
    planner = getattr(og, name)(info)
    if hasattr(planner, "setRange"):
        planner.setRange(config.range_rad)
    planner.setProblemDefinition(problem)
    planner.setup()
    stop = _Stop(watch, iterations)
    planner.solve(ob.PlannerTerminationCondition(stop))
    if stop.error is not None:
        raise stop.error
    if not problem.hasExactSolution():
        return None
    states = problem.getSolutionPath().getStates()
    return np.array([state[0 : robot.dof] for state in states])


@lru_cache(maxsize=8)
def _space(lower: tuple[float, ...], upper: tuple[float, ...]) -> ob.RealVectorStateSpace:
    """Return the space of configurations within limits [rad]; creating it takes a third of a short search's time.

    It is set up here once, because its first setup draws different random numbers than later ones.
    """
    space = ob.RealVectorStateSpace(len(lower))
    bounds = ob.RealVectorBounds(len(lower))
    for i, (low, high) in enumerate(zip(lower, upper, strict=True)):
        bounds.setLow(i, low)
        bounds.setHigh(i, high)
    space.setBounds(bounds)
    space.setup()
    return space


@lru_cache(maxsize=8)
def _scratch(dof: int) -> tuple[ob.RealVectorStateSpace, ob.State]:
    """Return a scratch state and its space. The bindings never free a state, so there is only one."""
    space = ob.RealVectorStateSpace(dof)
    return space, space.allocState()


def shorten(world: CollisionWorld, path: Array, *, seed: int, config: SearchConfig, watch: Watch) -> Array:
    """Shorten a free path: drop waypoints, then cut corners between random places. The ends stay.

    Args:
        world: Robot and obstacles.
        path: Waypoints, shape (N, dof).
        seed: Seed of the random cuts.
        config: Budget.
        watch: Called once.

    Returns:
        Waypoints of a free path that is no longer.
    """
    watch("search", 0)
    weights = 1.0 / world.robot.max_velocity
    return world.native.shorten(
        path, seed, config.shortcuts, weights / weights.max(), world.margins(config.resolution_m)
    )


def without_repeats(path: Array) -> Array:
    """Drop waypoints that equal their predecessor; the last waypoint always stays."""
    kept = [path[0]]
    for point in path[1:]:
        if np.abs(point - kept[-1]).max() > SAME_RAD:
            kept.append(point)
    if len(kept) > 1:
        kept[-1] = path[-1]
    return np.array(kept)
