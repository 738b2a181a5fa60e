"""Says whether a problem that nobody solved has a solution: a search of a minute with the referee's own eyes."""

from __future__ import annotations

import time

import numpy as np
import numpy.typing as npt
import pinocchio as pin
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou

from _problems import Problem, configuration_at
from _referee import LOWER, UPPER

Array = npt.NDArray[np.float64]
EDGE_RAD = 0.02


def is_solvable(problem: Problem, limit_s: float = 60.0, seed: int = 1) -> bool:
    """Search for a collision-free joint path to any goal configuration, without the planner's code.

    Args:
        problem: The problem.
        limit_s: Time.
        seed: Of the random numbers.
    """
    ou.setLogLevel(ou.LogLevel.LOG_NONE)
    begun = time.monotonic()
    rng = np.random.default_rng(seed)
    referee = problem.referee()
    goals: list[Array] = []
    while time.monotonic() - begun < limit_s:
        goals += _goal_configurations(problem, rng, 40)
        if not goals:
            continue
        space = ob.RealVectorStateSpace(7)
        bounds = ob.RealVectorBounds(7)
        for i in range(7):
            bounds.setLow(i, float(LOWER[i]))
            bounds.setHigh(i, float(UPPER[i]))
        space.setBounds(bounds)
        setup = og.SimpleSetup(space)
        setup.setStateValidityChecker(lambda state: not referee.collides(np.array(state[0:7])))
        information = setup.getSpaceInformation()
        information.setStateValidityCheckingResolution(EDGE_RAD / space.getMaximumExtent())
        start = space.allocState()
        start[0:7] = list(problem.start)
        setup.setStartState(start)
        states = ob.GoalStates(information)
        for goal in goals[-60:]:
            state = space.allocState()
            state[0:7] = goal.tolist()
            states.addState(state)
        setup.setGoal(states)
        planner = og.RRTConnect(information)
        setup.setPlanner(planner)
        setup.solve(float(min(15.0, max(0.1, limit_s - (time.monotonic() - begun)))))
        if setup.haveExactSolutionPath():
            return True
    return False


def _goal_configurations(problem: Problem, rng: np.random.Generator, attempts: int) -> list[Array]:
    if problem.goal_is_joints:
        return [np.array(problem.goal)]
    goal = problem.goal_value
    assert isinstance(goal, pin.SE3)
    referee = problem.referee()
    drawn = (configuration_at(rng, goal) for _ in range(attempts))
    return [joints for joints in drawn if joints is not None and not referee.collides(joints)]
