"""What searches promise: the same plan for a seed, ways through narrow openings, an upright tool, shorter paths."""

import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import assume, given, reject, settings
from hypothesis import strategies as st

from roboxim_core.errors import ErrorCode, InvalidRequestError, PlannerError, RequestTimeoutError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_planner.collisions.checker import CollisionWorld
from roboxim_planner.pipeline import MotionOptions, Planner, Upright
from roboxim_planner.scene import PlanningScene, box

Down = Callable[..., Pose]


def cage() -> PlanningScene:
    """Bars on three sides of the workspace, and a lid; the arm has to find its way between them."""
    bars = [
        box(f"bar{i}", (0.02, 0.02, 0.7), Pose(position=(x, y, 0.35)))
        for i, (x, y) in enumerate([(x, y) for y in (-0.25, 0.25) for x in (0.3, 0.45, 0.6, 0.75)])
    ]
    front = [box(f"front{i}", (0.02, 0.02, 0.7), Pose(position=(0.8, y, 0.35))) for i, y in enumerate((-0.12, 0.12))]
    lid = [box(f"lid{i}", (0.55, 0.02, 0.02), Pose(position=(0.55, y, 0.7))) for i, y in enumerate((-0.25, 0.0, 0.25))]
    table = box("table", (0.9, 1.4, 0.05), Pose(position=(0.5, 0.0, -0.025)))
    return PlanningScene(bodies=(table, *bars, *front, *lid))


def test_finds_the_way_into_a_cage(tcp_down: Down, planner: Planner) -> None:
    start = np.array([1.4, -0.6, 0.0, -2.2, 0.0, 1.7, 0.8])
    plan = planner.plan_to_pose(cage(), start, [tcp_down(0.5, 0.05, 0.15)], MotionOptions(seed=3))
    assert plan.route == "sampled"
    world = CollisionWorld(planner.robot, cage())
    assert all(world.coal.is_free(q) for q in plan.sample(0.002).positions)


def tilts(planner: Planner, joints: np.ndarray) -> np.ndarray:
    """Return the angle of the hand from straight down at each of some states."""
    return np.arccos(np.clip(-planner.robot.arm.tcp_poses(joints)[:, 2, 2], -1.0, 1.0))


@pytest.mark.parametrize("tolerance", [0.05, 0.3])
def test_tool_stays_upright_around_a_wall(
    tcp_down: Down, planner: Planner, walled: PlanningScene, left: np.ndarray, tolerance: float
) -> None:
    goal = tcp_down(0.5, -0.3, 0.2)
    free = planner.plan_to_pose(walled, left, [goal])
    assert tilts(planner, free.sample(0.001).positions).max() > 0.05
    plan = planner.plan_to_pose(walled, left, [goal], MotionOptions(upright=Upright(tolerance_rad=tolerance)))
    samples = plan.sample(0.001).positions
    assert tilts(planner, samples).max() <= tolerance + 1e-6
    assert CollisionWorld(planner.robot, walled).first_collision(samples) == -1


def test_tilted_start_goal_and_path_are_refused_by_name(tcp_down: Down, planner: Planner) -> None:
    upright, home = MotionOptions(upright=Upright(tolerance_rad=0.2)), planner.named_state("home")
    tilted = planner.ik.any(
        Pose(position=(0.5, 0.0, 0.5), quat_xyzw=(0.0, 0.7071067811865476, 0.0, 0.7071067811865476)), home
    )
    for begin, goal, word in ((tilted, home, "start"), (home, tilted, "goal")):
        with pytest.raises(PlannerError, match=f"tilted by .* at the {word}") as caught:
            planner.plan_to_joints(PlanningScene(), begin, goal, upright)
        assert caught.value.code == ErrorCode.CONSTRAINT_VIOLATED
    for bad in ({"tolerance_rad": 0.0}, {"tolerance_rad": 0.1, "tool_axis": (0.0, 0.0, 0.0)}):
        with pytest.raises(InvalidRequestError):
            Upright(**bad)


def test_improving_gives_no_longer_path_and_the_same_each_time(
    tcp_down: Down, planner: Planner, walled: PlanningScene, left: np.ndarray
) -> None:
    goal = tcp_down(0.5, -0.3, 0.2)

    def length(planner_id: str) -> float:
        options = MotionOptions(planner=planner_id, improve_iterations=400, seed=2)
        path = planner.plan_to_pose(walled, left, [goal], options).waypoints
        return float(np.linalg.norm(np.diff(path, axis=0) / planner.robot.max_velocity, axis=1).sum())

    first = length("RRTConnect")
    assert length("BITstar") <= first
    assert length("BITstar") == length("BITstar")
    with pytest.raises(InvalidRequestError, match="did you mean 'BITstar'"):
        MotionOptions(planner="BITStar")


def test_a_deadline_ends_the_search_under_a_constraint(
    tcp_down: Down, planner: Planner, walled: PlanningScene, left: np.ndarray
) -> None:
    def watch(stage: str, iterations: int) -> None:
        if stage == "search":
            raise RequestTimeoutError("late")

    options = MotionOptions(upright=Upright(tolerance_rad=0.1))
    with pytest.raises(RequestTimeoutError):
        planner.plan_to_pose(walled, left, [tcp_down(0.5, -0.3, 0.2)], options, watch)


@given(seed=st.integers(0, 10**6), velocity=st.floats(0.05, 1.0), acceleration=st.floats(0.05, 1.0))
@settings(max_examples=25, deadline=None)
def test_every_plan_keeps_its_promises(planner: Planner, seed: int, velocity: float, acceleration: float) -> None:
    """Random scenes and ends: start and goal, limits by differences at a kilohertz, nothing touched (coal)."""
    rng = np.random.default_rng(seed)
    places = rng.uniform([0.25, -0.6, 0.1], [0.8, 0.6, 0.6], (5, 3)).tolist()
    bodies = [box(f"b{i}", (0.08, 0.08, 0.2), Pose(position=tuple(place))) for i, place in enumerate(places)]
    scene, robot = PlanningScene(bodies=tuple(bodies)), planner.robot
    world = CollisionWorld(robot, scene)
    ends = world.free_states(rng.uniform(robot.lower, robot.upper, (60, robot.dof)))
    assume(len(ends) >= 2)
    options = MotionOptions(velocity_scaling=velocity, acceleration_scaling=acceleration, seed=seed)
    try:
        plan = planner.plan_to_joints(scene, ends[0], ends[1], options)
    except PlannerError:
        reject()  # shut in by the boxes; were that common, hypothesis would object
    path = plan.motion.evaluate(np.arange(0.0, plan.duration, 1e-3))[0]
    assert path[0] == pytest.approx(ends[0], abs=1e-9)
    assert plan.end == pytest.approx(ends[1], abs=1e-9)
    limits = planner.limits(options)
    for order, limit in ((1, limits.velocity), (2, limits.acceleration), (3, limits.jerk)):
        assert (np.abs(np.diff(path, order, axis=0)) <= limit * 1e-3**order * 1.001 + 1e-12).all()
    assert all(world.coal.is_free(q) for q in path[::10])


PLANS = """
import hashlib, sys
import numpy as np
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_planner.pipeline import MotionOptions, Planner
from roboxim_planner.scene import PlanningScene, box
planner = Planner(ModelLibrary().robot("panda"))
rng = np.random.default_rng(0)
digest = hashlib.sha256()
for seed in range(int(sys.argv[1])):
    places = rng.uniform([0.3, -0.5, 0.1], [0.8, 0.5, 0.3], (6, 3))
    bodies = [box(f"b{i}", (0.08, 0.08, 0.3), Pose(position=tuple(p.tolist()))) for i, p in enumerate(places)]
    goal = Pose(position=tuple(rng.uniform([0.4, -0.4, 0.4], [0.6, 0.4, 0.6]).tolist()), quat_xyzw=(1.0, 0.0, 0.0, 0.0))
    try:
        plan = planner.plan_to_pose(PlanningScene(bodies=tuple(bodies)), planner.named_state("home"), [goal],
                                    MotionOptions(seed=seed))
        digest.update(plan.sample(0.01).positions.tobytes())
    except Exception as error:
        digest.update(str(error).encode())
print(digest.hexdigest())
"""


def _burn(seconds: float) -> None:
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        sum(range(10000))


@pytest.mark.slow
def test_plans_are_the_same_under_four_times_the_load() -> None:
    def digest() -> str:
        done = subprocess.run([sys.executable, "-c", PLANS, "200"], capture_output=True, text=True, check=True)
        return done.stdout

    alone = digest()
    burners = [multiprocessing.Process(target=_burn, args=(60.0,)) for _ in range(4 * (os.cpu_count() or 1))]
    for burner in burners:
        burner.start()
    try:
        assert digest() == alone
    finally:
        for burner in burners:
            burner.terminate()
            burner.join()


@pytest.mark.slow
def test_memory_does_not_grow_with_plans(tcp_down: Down, walled: PlanningScene, left: np.ndarray) -> None:
    """A thousand searches after a warm-up grow the process by less than a tenth of what is allowed for ten thousand."""
    planner = Planner(ModelLibrary().robot("panda"))

    def resident_kib() -> int:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 1024

    def work(count: int) -> None:
        for seed in range(count):
            planner.plan_to_pose(walled, left, [tcp_down(0.5, -0.3, 0.2)], MotionOptions(seed=seed))

    work(500)
    before = resident_kib()
    work(1000)
    assert resident_kib() - before < 1024
