from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from roboxim_core.errors import ErrorCode, InvalidRequestError, PlannerError, RequestTimeoutError
from roboxim_core.poses import Pose
from roboxim_planner.motions.retime import retime, simplified
from roboxim_planner.pipeline import MotionOptions, Planner
from roboxim_planner.scene import AllowedContact, Attached, PlanningScene, box
from roboxim_planner.sequence import SequenceConfig, Stage, StageGoal, plan_sequence

Down = Callable[..., Pose]
FEW = SequenceConfig(configurations=12)


def shift(z: float, name: str, **kwargs: object) -> Stage:
    """Return a straight line along the world's z."""
    return Stage(
        kind="cartesian", name=name, goals=(StageGoal(pose=Pose(position=(0.0, 0.0, z)), relative=True),), **kwargs
    )  # type: ignore[arg-type]


def test_goal_is_chosen_by_what_follows(planner: Planner, table: PlanningScene, tcp_down: Down) -> None:
    """The nearest of two goals leads into a dead end: below it a block is in the way of the line."""
    block = box("block", (0.12, 0.12, 0.1), Pose(position=(0.5, 0.0, 0.05)))
    goals = (StageGoal(pose=tcp_down(0.5, 0.0, 0.25)), StageGoal(pose=tcp_down(0.5, -0.35, 0.25)))
    start = planner.named_state("home")
    stages = (Stage(kind="pose", name="approach", goals=goals), shift(-0.2, "down"))
    found = plan_sequence(planner, table.with_bodies([block]), start, stages, config=FEW)
    assert found.goal_indices == (1, -1)
    assert plan_sequence(planner, table, start, stages).goal_indices[0] == 0
    assert np.abs(found.plans[0].end - found.plans[1].sample(0.01).positions[0]).max() < 1e-9


def test_frames_of_goals() -> None:
    tcp = Pose(position=(0.5, 0.1, 0.3), quat_xyzw=(1.0, 0.0, 0.0, 0.0))
    step = Pose(position=(0.0, 0.02, 0.1))
    assert StageGoal(pose=step, frame="tcp").resolve(tcp).position == pytest.approx((0.5, 0.08, 0.2))
    assert StageGoal(pose=step, relative=True).resolve(tcp).position == pytest.approx((0.5, 0.12, 0.4))
    assert StageGoal(pose=step).resolve(tcp) == step
    quarter = Pose(quat_xyzw=(0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)))
    turned = StageGoal(pose=quarter, relative=True).resolve(tcp)
    assert turned.position == pytest.approx(tcp.position)
    assert turned.rotation.apply([1.0, 0.0, 0.0]) == pytest.approx([0.0, 1.0, 0.0], abs=1e-6)


def test_what_a_stage_takes_along_and_leaves(tcp_down: Down) -> None:
    scene = PlanningScene(bodies=(box("cube", (0.04,) * 3, Pose(position=(0.5, 0.0, 0.3))),))
    tcp = tcp_down(0.5, 0.0, 0.3)
    take = Stage(
        kind="joints", joints=(0.0,), attach=("cube",), gripper_opening=0.4, allowed=(AllowedContact(body_a="cube"),)
    )
    here, left = take.enter(scene, tcp)
    assert [held.body.name for held in left.attached] == ["cube"]
    assert (left.bodies, left.gripper_opening) == ((), 0.4)
    assert (len(here.allowed), left.allowed) == (1, ())
    moved = tcp_down(0.2, 0.3, 0.5)
    put = Stage(kind="joints", joints=(0.0,), detach=("cube",))
    _, left = put.enter(left, moved)
    assert left.attached == ()
    assert left.bodies[0].pose.position == pytest.approx((0.2, 0.3, 0.5))
    with pytest.raises(InvalidRequestError, match="does not hold 'cube'"):
        put.enter(left, moved)


def test_failure_names_the_stage_and_a_deadline_ends_it(planner: Planner, table: PlanningScene, tcp_down: Down) -> None:
    start = planner.named_state("home")
    stages = (Stage(kind="pose", name="over", goals=(StageGoal(pose=tcp_down(0.5, 0.2, 0.2)),)), shift(-0.4, "dig"))
    with pytest.raises(PlannerError, match=r"stage 'dig' \(2 of 2\).*table.*of stage 'over' tried") as caught:
        plan_sequence(planner, table, start, stages, config=FEW)
    assert caught.value.code == ErrorCode.PATH_INCOMPLETE

    blocked = table.with_bodies([box("block", (0.2, 0.2, 0.2), Pose(position=planner.robot.fk(start).position))])
    with pytest.raises(PlannerError, match=r"stage 'over' \(1 of 2\): start in collision") as caught:
        plan_sequence(planner, blocked, start, (stages[0], shift(-0.05, "dig")))
    assert caught.value.code == ErrorCode.START_IN_COLLISION

    beyond = tuple((planner.robot.upper + 0.1).tolist())
    ready = Stage(kind="joints", name="ready", joints=beyond)
    with pytest.raises(PlannerError, match=r"stage 'ready' \(1 of 2\): goal unreachable") as caught:
        plan_sequence(planner, table, start, (ready, shift(-0.05, "dig")))
    assert caught.value.code == ErrorCode.GOAL_UNREACHABLE

    def late(stage: str, iterations: int) -> None:
        raise RequestTimeoutError("late")

    with pytest.raises(RequestTimeoutError):
        plan_sequence(planner, table, start, stages, watch=late)
    for kind, words in (("pose", "at least one goal"), ("jump", "unknown kind"), ("joints", "joint positions")):
        with pytest.raises(InvalidRequestError, match=words):
            Stage(kind=kind)


def test_retimed_path_is_near_and_within_limits(planner: Planner) -> None:
    turn = np.linspace(0.0, np.pi, 120)
    path = planner.named_state("home") + np.outer(np.sin(turn), [0.5, 0.2, 0, 0, 0, 0, 0])
    path = path + np.outer(turn / np.pi, [0, 0, 0, 0.6, 0, 0, 0.4])
    options = MotionOptions(velocity_scaling=0.8, max_tcp_speed_m_s=0.6)
    for tolerance in (0.2, 0.05):
        plan = retime(planner, path, options, tolerance_rad=tolerance)
        samples = plan.sample(1e-3).positions
        assert max(np.abs(samples - point).max(axis=1).min() for point in path) <= tolerance
        assert np.abs(samples[[0, -1]] - path[[0, -1]]).max() < 1e-6
        limits = planner.limits(options)
        _, v, a, j = plan.motion.evaluate(np.arange(0.0, plan.duration, 1e-3))
        for values, limit in ((v, limits.velocity), (a, limits.acceleration), (j, limits.jerk)):
            assert (np.abs(values) <= 1.001 * limit).all()
    loop = path[[0, 3, 0]]
    assert np.ptp(retime(planner, loop).sample(1e-3).positions[:, 0]) > 0.5 * np.ptp(loop[:, 0])
    exact = retime(planner, path[::30], stop_at_points=True)
    samples = exact.sample(1e-3).positions
    assert max(np.abs(samples - point).max(axis=1).min() for point in path[::30]) < 2e-3
    beyond = path.copy()
    beyond[7, 3] = 0.5
    with pytest.raises(PlannerError, match="point 7 of the path: panda_joint4"):
        retime(planner, beyond)


def test_retiming_shrinks_blends_that_would_collide(planner: Planner) -> None:
    home = planner.named_state("home")
    corner = home + [0.8, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    path = np.array([home, corner, corner + [0.0, 0.6, 0.0, 0.0, 0.0, 0.0, 0.0]])
    wide = retime(planner, path, tolerance_rad=0.8)
    samples = wide.sample(0.01).positions
    cut = samples[np.argmin(np.abs(samples - corner).max(axis=1))]
    assert np.abs(cut - corner).max() > 0.05
    tip = planner.robot.fk(cut).apply([0.0, 0.0, 0.3])
    post = box("post", (0.01, 0.01, 0.01), Pose(position=tuple(tip.tolist())))
    stick = Attached(body=box("stick", (0.01, 0.01, 0.3), Pose(position=(0.0, 0.0, 0.15))))
    scene = PlanningScene(bodies=(post,), attached=(stick,))
    assert not planner.check_trajectory(scene, samples).valid
    close = retime(planner, path, tolerance_rad=0.8, scene=scene)
    assert planner.check_trajectory(scene, close.sample(0.002).positions).valid
    assert close.duration > wide.duration


def test_simplified_path_stays_within_its_tolerance() -> None:
    rng = np.random.default_rng(0)
    path = np.cumsum(rng.normal(0.0, 0.02, (200, 3)), axis=0)
    few = simplified(path, 0.05)
    assert 2 <= len(few) < 60
    dense = np.concatenate([np.linspace(a, b, 50) for a, b in zip(few, few[1:], strict=False)])
    assert max(np.abs(dense - point).max(axis=1).min() for point in path) < 0.06
