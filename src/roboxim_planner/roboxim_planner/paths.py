"""Collision-free joint paths: OMPL over whole-edge checks in the native kernel, then random shortcuts.

RRTConnect finds a way in the open within a few dozen iterations, and hardly ever one through narrow openings; the
KPIECE family is the other way round. So a search is a list of planners with budgets, tried in this order.

OMPL draws from a global random number generator, so searches take turns under a lock and set its seed first; with a
budget of iterations instead of seconds the same request gives the same path under any load.
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

from roboxim_planner.collision import CollisionWorld

Array = npt.NDArray[np.float64]
Watch = Callable[[str, int], None]
"""Called with the stage and the iterations spent; raises to end the request (deadline passed, cancelled)."""

_OMPL_LOCK = threading.Lock()
_WATCH_EVERY = 16
ou.setLogLevel(ou.LOG_NONE)  # OMPL objects to each new seed, though a seed set under the lock does reproduce

IMPROVERS = ("BITstar", "RRTstar", "InformedRRTstar")
"""Planners that go on improving a path."""
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
    """Motion of the arm's points below which a free state stands for what is around it on an edge [m]; of a pair that
    keeps a larger distance, that distance."""
    shortcuts: int = 100
    """Random shortcuts tried."""
    upright_iterations: int = 3000
    """Iterations of the search under a path constraint."""
    upright_step_rad: float = 0.25
    """Longest edge of that search [rad]."""
    improve_iterations: int = 3000
    """Iterations of a planner that improves a path, when a request does not say."""


class _EdgeValidator(ob.MotionValidator):  # type: ignore[misc]
    """Hands whole edges to the native kernel. It must not refer to the space information: that cycle leaks."""

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
    """Ends a search by iterations, or when the watch raises; keeps what it raised, since OMPL cannot carry it."""

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
            except BaseException as error:  # handed on after OMPL has returned
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
        watch: Called now and then; ends the search by raising.

    Returns:
        Waypoints, shape (M, dof), whose last is one of the goals; none when the budget is spent.
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
    """Look for a shorter path between the ends of one.

    Args:
        planner: One of `IMPROVERS`.
        world: Robot and obstacles.
        path: Free waypoints, shape (N, dof) [rad].
        seed: Seed of the search.
        iterations: Iterations of the planner.
        config: Budget of the rest.
        watch: Called now and then; ends the search by raising.

    Returns:
        The shorter of the path given and that found.
    """
    with _OMPL_LOCK:
        _seed(world, seed)
        found = _solve(planner, world, path[0], path[-1:], iterations, config, watch)
    if found is None:
        return path
    found = shorten(world, without_repeats(found), seed=seed, config=config, watch=watch)
    return min(path, found, key=lambda points: _length(world, points))


def _seed(world: CollisionWorld, seed: int) -> None:
    """Start OMPL's random numbers anew, after all that draws from them only once has done so."""
    _space(tuple(world.robot.lower.tolist()), tuple(world.robot.upper.tolist()))
    ou.RNG.setSeed(seed % (2**31 - 1) + 1)


def _length(world: CollisionWorld, path: Array) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0) / world.robot.max_velocity, axis=1).sum())


def _solve(
    name: str, world: CollisionWorld, start: Array, goals: Array, iterations: int, config: SearchConfig, watch: Watch
) -> Array | None:
    robot = world.robot
    info = ob.SpaceInformation(_space(tuple(robot.lower.tolist()), tuple(robot.upper.tolist())))
    # RRTConnect never keeps a state without the edge to it, whose check includes its ends
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
    """Return the space of configurations within limits [rad]; to make it takes a third of a short search.

    It is set up once here, because its first setup draws other random numbers than the following ones.
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
    """Return a state to hand values over in, and its space. The bindings never free a state, so there is only one."""
    space = ob.RealVectorStateSpace(dof)
    return space, space.allocState()


def shorten(world: CollisionWorld, path: Array, *, seed: int, config: SearchConfig, watch: Watch) -> Array:
    """Shorten a free path: leave out waypoints, then cut corners between random places. Ends stay.

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
    """Drop waypoints that repeat their predecessor; the last waypoint always stays."""
    kept = [path[0]]
    for point in path[1:]:
        if np.abs(point - kept[-1]).max() > 1e-7:
            kept.append(point)
    if len(kept) > 1:
        kept[-1] = path[-1]
    return np.array(kept)
