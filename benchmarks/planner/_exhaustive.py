"""Search for a solution of a problem that no contender solved: one minute with the referee's own checks.

A search that finds nothing proves nothing. A problem counts as infeasible only for one of the reasons that
`why_infeasible` returns. A problem that is neither solved nor proved infeasible remains unsolved.
"""

from __future__ import annotations

import time

import numpy as np
import numpy.typing as npt
import pinocchio as pin
from benchmarks.planner._machines import Machine
from benchmarks.planner._problems import Problem, configuration_at
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou

Array = npt.NDArray[np.float64]
EDGE_RAD = 0.02
GOAL_ATTEMPTS = 4000
"""Number of random initial configurations for inverse kinematics after which a goal pose counts as unreachable."""


def why_infeasible(problem: Problem, seed: int = 1, attempts: int = GOAL_ATTEMPTS) -> str:
    """Return why no motion can solve a problem; empty: infeasibility is not proved.

    Args:
        problem: The problem.
        seed: Seed of the random numbers.
        attempts: Number of random initial configurations for inverse kinematics.
    """
    referee = problem.referee()
    start = np.array(problem.start)
    if not _within_limits(referee.machine, start):
        return "the start is beyond the joint limits"
    if referee.collides(start):
        return "the start collides"
    if problem.goal_is_joints:
        goal = np.array(problem.goal)
        if not _within_limits(referee.machine, goal):
            return "the goal is beyond the joint limits"
        return "the goal collides" if referee.collides(goal) else ""
    pose = problem.goal_value
    assert isinstance(pose, pin.SE3)
    rng = np.random.default_rng(seed)
    reached = 0
    for _ in range(attempts):
        joints = configuration_at(rng, pose, problem.robot)
        if joints is not None:
            if not referee.collides(joints):
                return ""
            reached += 1
    if reached:
        return f"all {reached} goal configurations collide that {attempts} random starts of the arm lead to"
    return f"no configuration reaches the goal, from {attempts} random starts of the arm"


def _within_limits(arm: Machine, joints: Array) -> bool:
    return bool(((joints >= arm.lower) & (joints <= arm.upper)).all())


def is_solvable(problem: Problem, limit_s: float = 60.0, seed: int = 1) -> bool:
    """Search for a collision-free joint path to any goal configuration, without the planner's code.

    Args:
        problem: The problem.
        limit_s: Time limit [s].
        seed: Seed of the random numbers.
    """
    ou.setLogLevel(ou.LogLevel.LOG_NONE)
    begun = time.monotonic()
    rng = np.random.default_rng(seed)
    referee = problem.referee()
    goals: list[Array] = []
    dof = referee.machine.dof
    while time.monotonic() - begun < limit_s:
        goals += _goal_configurations(problem, rng, 40)
        if not goals:
            continue
        space = ob.RealVectorStateSpace(dof)
        bounds = ob.RealVectorBounds(dof)
        for i in range(dof):
            bounds.setLow(i, float(referee.machine.lower[i]))
            bounds.setHigh(i, float(referee.machine.upper[i]))
        space.setBounds(bounds)
        setup = og.SimpleSetup(space)
        setup.setStateValidityChecker(lambda state: not referee.collides(np.array(state[0:dof])))
        information = setup.getSpaceInformation()
        information.setStateValidityCheckingResolution(EDGE_RAD / space.getMaximumExtent())
        start = space.allocState()
        start[0:dof] = list(problem.start)
        setup.setStartState(start)
        states = ob.GoalStates(information)
        for goal in goals[-60:]:
            state = space.allocState()
            state[0:dof] = goal.tolist()
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
    drawn = (configuration_at(rng, goal, problem.robot) for _ in range(attempts))
    return [joints for joints in drawn if joints is not None and not referee.collides(joints)]
