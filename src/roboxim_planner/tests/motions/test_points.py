"""Points of plans, as a joint trajectory controller interpolates them."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.interpolate import BPoly, CubicHermiteSpline

from roboxim_core.errors import PlannerError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_planner.motions.points import MIN_GAP_S, TOLERANCE
from roboxim_planner.motions.retime import retime
from roboxim_planner.pipeline import MotionOptions, Plan, Planner
from roboxim_planner.scene import PlanningScene

PLANS = 40
"""Of each robot, kind and period."""


@cache
def robot_planner(robot: str) -> Planner:
    return Planner(ModelLibrary().robot(robot))


def drawn_plan(planner: Planner, kind: str, seed: int) -> Plan | None:
    """Return a random plan, or none where there is no way."""
    rng = np.random.default_rng(seed)
    robot = planner.robot
    near = [
        np.clip(planner.named_state("home") + rng.normal(scale=0.3, size=robot.dof), robot.lower, robot.upper)
        for _ in range(4)
    ]
    options = MotionOptions(acceleration_scaling=float(rng.choice([1.0, 0.3])))
    try:
        if kind == "joints":
            return planner.plan_to_joints(PlanningScene(), near[0], near[1], options)
        if kind == "cartesian":
            target = robot.fk(near[0]) @ Pose(position=tuple(rng.uniform(-0.1, 0.1, 3).tolist()))
            return planner.plan_cartesian(PlanningScene(), near[0], [target], options)
        return retime(planner, near, options)
    except PlannerError:
        return None


@pytest.mark.parametrize("kind", ["joints", "cartesian", "retimed"])
@pytest.mark.parametrize("robot", ["panda", "ur5"])
@pytest.mark.thorough
def test_cubic_and_quintic_splines_through_the_points_keep_the_limits(robot: str, kind: str) -> None:
    planner = robot_planner(robot)
    plans = [plan for seed in range(PLANS) if (plan := drawn_plan(planner, kind, seed)) is not None]
    assert len(plans) > 0.6 * PLANS
    for number, plan in enumerate(plans):
        period = (0.01, 0.02, 0.1)[number % 3]
        points = plan.points(period)
        spans = np.diff(points.times)
        assert spans.min() > 0.5 * MIN_GAP_S
        assert spans.max() < period + 1e-9
        every_ms = np.append(np.arange(0.0, points.times[-1], 1e-3), points.times[-1])
        derivatives = np.stack([points.positions, points.velocities, points.accelerations], axis=1)
        for spline in (
            CubicHermiteSpline(points.times, points.positions, points.velocities),
            BPoly.from_derivatives(points.times, derivatives),
        ):
            for order, limit in ((1, plan.limits.velocity), (2, plan.limits.acceleration)):
                reached = np.abs(spline.derivative(order)(every_ms)).max(axis=0)
                assert (reached <= (1.0 + TOLERANCE) * limit).all(), (number, order, reached / limit)


def test_points_at_the_period_alone_would_break_them() -> None:
    """The test above bites: the motion's samples, without further points, break the acceleration's limit."""
    planner = robot_planner("panda")
    worst = 0.0
    for seed in range(10):
        plan = drawn_plan(planner, "joints", seed)
        assert plan is not None
        samples = plan.sample(0.01)
        spline = CubicHermiteSpline(samples.times, samples.positions, samples.velocities).derivative(2)
        worst = max(worst, (np.abs(spline(np.arange(0.0, plan.duration, 1e-3))) / plan.limits.acceleration).max())
    assert worst > 1.2


def test_points_are_the_motions_own_and_hold_every_multiple_of_the_period() -> None:
    plan = drawn_plan(robot_planner("panda"), "joints", 3)
    assert plan is not None
    points, samples = plan.points(0.02), plan.sample(0.02)
    even = [i for i, t in enumerate(points.times) if round(t * 1e9) % 20_000_000 == 0 or i == len(points.times) - 1]
    assert points.positions[even].tobytes() == samples.positions.tobytes()
    assert len(points.times) > len(samples.times)
    assert np.abs(points.positions - plan.motion.evaluate(points.times)[0]).max() < 1e-12
    assert np.abs(points.times * 1e9 - np.round(points.times * 1e9)).max() < 1e-4, "messages hold whole nanoseconds"
