import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roboxim_core.poses import Pose
from roboxim_planner.motions.cartesian import LineMotion, follow_line, line_poses, time_line
from roboxim_planner.motions.timing import MotionSequence, still, time_path
from roboxim_planner.motions.verify import verify_motion
from roboxim_planner.pipeline import MotionOptions, Planner
from roboxim_planner.scene import PlanningScene


@given(seed=st.integers(0, 10_000), points=st.integers(2, 6), blend=st.floats(0.0, 1.0), limited=st.booleans())
@settings(max_examples=40, deadline=None)
def test_blended_path_keeps_every_limit_and_its_ends(
    planner: Planner, seed: int, points: int, blend: float, limited: bool
) -> None:
    robot = planner.robot
    scale = 0.05 if seed % 2 else 1.0
    middle = 0.5 * (robot.lower + robot.upper)
    path = middle + scale * np.random.default_rng(seed).uniform(robot.lower - middle, robot.upper - middle, (points, 7))
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    corners = blend * 0.499 * np.minimum(lengths[:-1], lengths[1:])
    options = MotionOptions(max_tcp_speed_m_s=0.2, max_tcp_rot_speed_rad_s=0.8) if limited else MotionOptions()
    limits = planner.limits(options)
    motion = time_path(path, corners, limits, robot.kinematics.jacobian)
    assert str(verify_motion(None, robot, motion, limits, path[-1])) == "valid"
    times = np.arange(0.0, motion.duration, 5e-4)
    q, v, _, _ = motion.evaluate(times)
    assert q[0] == pytest.approx(path[0], abs=1e-9)
    integral = q[0] + np.concatenate([[np.zeros(7)], np.cumsum((v[1:] + v[:-1]) / 2 * np.diff(times)[:, None], axis=0)])
    assert np.abs(integral - q).max() < 1e-4


def test_scaling_slows_down(planner: Planner) -> None:
    path = np.stack([planner.named_state("home"), planner.named_state("home") + 0.5])
    times = [
        time_path(path, np.zeros(0), planner.limits(options), planner.robot.kinematics.jacobian).duration
        for options in (
            MotionOptions(),
            MotionOptions(velocity_scaling=0.25),
            MotionOptions(acceleration_scaling=0.1),
            MotionOptions(max_tcp_speed_m_s=0.05),
        )
    ]
    assert all(slow > 1.5 * times[0] for slow in times[1:])


@pytest.mark.parametrize("turn", [0.0, 0.6])
def test_line_is_straight_even_and_within_limits(planner: Planner, turn: float) -> None:
    robot = planner.robot
    start = planner.named_state("home")
    begin = robot.fk(start)
    end = begin @ Pose(position=(0.05, -0.08, 0.1), quat_xyzw=(0.0, 0.0, np.sin(turn / 2), np.cos(turn / 2)))
    limits = planner.limits(MotionOptions(max_tcp_speed_m_s=0.3))
    path = follow_line(robot, start, end)
    motion = time_line(path, limits)
    assert path.fraction == 1.0
    assert str(verify_motion(None, robot, motion, limits)) == "valid"
    ideal = np.array([pose.position for pose in line_poses(begin, end, 2000)])
    for q in motion.evaluate(np.linspace(0.0, motion.duration, 40))[0]:
        assert np.linalg.norm(ideal - robot.fk(q).position, axis=1).min() < 2e-4
    assert robot.fk(motion.evaluate(np.array([motion.duration]))[0][0]).position == pytest.approx(
        end.position, abs=1e-6
    )


def test_sequence_runs_its_parts_in_turn(planner: Planner) -> None:
    a = planner.named_state("home")
    limits = planner.limits(MotionOptions())
    jacobian = planner.robot.kinematics.jacobian
    motions = [time_path(np.stack([a + i * 0.1, a + (i + 1) * 0.1]), np.zeros(0), limits, jacobian) for i in range(2)]
    whole = MotionSequence([motions[0], still(a + 0.1), motions[1]])
    times = np.linspace(0.0, whole.duration, 300)
    q = whole.evaluate(times)[0]
    assert q[0] == pytest.approx(a)
    assert q[-1] == pytest.approx(a + 0.2)
    assert (np.diff(q[:, 0]) >= -1e-12).all()


@pytest.mark.parametrize("count", [2, 3, 4])
def test_line_that_ends_after_a_few_steps_has_a_motion(planner: Planner, count: int) -> None:
    """A line that something stops at once is cut to as few configurations."""
    limits = planner.limits(MotionOptions())
    joints = planner.named_state("home") + np.linspace(0.0, 0.03, count)[:, None] ** 1.5
    motion = LineMotion(joints, limits, 0.01, 0.0)
    q, v, a, j = motion.evaluate(np.linspace(0.0, motion.duration, 200))
    assert np.abs(q[[0, -1]] - joints[[0, -1]]).max() < 1e-12
    for values, limit in ((v, limits.velocity), (a, limits.acceleration), (j, limits.jerk)):
        assert (np.abs(values) <= 1.001 * limit).all()


def test_a_limit_of_the_tcp_binds_nearly_everywhere(planner: Planner) -> None:
    """A line along which the TCP's speed per joint speed varies: no single joint speed for all of it would do."""
    start = np.array([0.0, 1.2, 0.0, -1.0, 0.0, 2.2, 0.8])
    goal = np.array([0.0, -0.6, 0.0, -2.8, 0.0, 2.2, 0.8])
    options = MotionOptions(max_tcp_speed_m_s=0.25)
    samples = planner.plan_to_joints(PlanningScene(), start, goal, options).sample(1e-3)
    speeds = planner.robot.arm.tcp_speeds(samples.positions, samples.velocities)[:, 0]
    assert speeds.max() <= 0.25
    assert speeds.mean() > 0.85 * 0.25
