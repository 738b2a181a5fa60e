import pickle
import re
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest

from roboxim_core.errors import ErrorCode, InvalidRequestError, PlannerError, RequestTimeoutError
from roboxim_core.kinematics.arm import ArmKinematics
from roboxim_core.kinematics.delta import DeltaController, delta_between
from roboxim_core.poses import Pose, distance
from roboxim_planner.collisions.checker import CollisionWorld
from roboxim_planner.collisions.sweep import Sweep
from roboxim_planner.constraint import Upright
from roboxim_planner.motions.cartesian import follow_line
from roboxim_planner.motions.timing import MotionLimits, PolynomialMotion
from roboxim_planner.motions.verify import verify_motion
from roboxim_planner.pipeline import MotionOptions, PathIncompleteError, Planner
from roboxim_planner.scene import AllowedContact, Attached, PlanningScene, box

Down = Callable[..., Pose]


def test_plan_around_a_wall_is_valid(tcp_down: Down, planner: Planner, walled: PlanningScene, left: np.ndarray) -> None:
    goal = tcp_down(0.5, -0.3, 0.2)
    plan = planner.plan_to_pose(walled, left, [goal])
    assert plan.route == "sampled"
    samples = plan.sample(0.001)
    world = CollisionWorld(planner.robot, walled)
    assert world.first_collision(samples.positions) == -1
    assert samples.positions[0] == pytest.approx(left)
    assert distance(planner.robot.fk(plan.end), goal) == pytest.approx((0.0, 0.0), abs=1e-4)
    assert (np.abs(samples.velocities) <= planner.robot.max_velocity * 1.001).all()
    assert (np.abs(samples.accelerations) <= planner.robot.max_acceleration * 1.001).all()


def test_same_seed_same_plan_whatever_came_before(
    tcp_down: Down, planner: Planner, walled: PlanningScene, left: np.ndarray
) -> None:
    goal = tcp_down(0.5, -0.3, 0.2)

    def bits(seed: int) -> bytes:
        plan = planner.plan_to_pose(walled, left, [goal], MotionOptions(seed=seed))
        return plan.sample(0.01).positions.tobytes()

    first = bits(5)
    assert bits(6) != first
    assert bits(5) == first


def test_threads_that_search_at_once_do_not_disturb_each_other(
    tcp_down: Down, planner: Planner, walled: PlanningScene, left: np.ndarray
) -> None:
    goal = tcp_down(0.5, -0.3, 0.2)

    def bits(one: Planner) -> list[bytes]:
        plans = [one.plan_to_pose(walled, left, [goal], MotionOptions(seed=seed)) for seed in range(3)]
        return [plan.sample(0.01).positions.tobytes() for plan in plans]

    alone = bits(planner)
    planners = [Planner(planner.robot.description) for _ in range(3)]
    with ThreadPoolExecutor(3) as pool:
        assert all(result == alone for result in pool.map(bits, planners))


def test_another_process_makes_the_same_plan(
    tcp_down: Down, planner: Planner, walled: PlanningScene, left: np.ndarray
) -> None:
    script = """
import pickle, sys
from roboxim_core.models.library import ModelLibrary
from roboxim_planner.pipeline import Planner
scene, start, goal = pickle.load(sys.stdin.buffer)
plan = Planner(ModelLibrary().robot("panda")).plan_to_pose(scene, start, [goal])
sys.stdout.write(plan.sample(0.01).positions.tobytes().hex())
"""
    goal = tcp_down(0.5, -0.3, 0.2)
    request = pickle.dumps((walled, left, goal))
    other = subprocess.run([sys.executable, "-c", script], input=request, capture_output=True, check=True)
    plan = planner.plan_to_pose(walled, left, [goal])
    assert plan.route == "sampled"
    assert other.stdout.decode() == plan.sample(0.01).positions.tobytes().hex()


def test_planted_obstacle_on_the_path_is_never_crossed(tcp_down: Down, planner: Planner, table: PlanningScene) -> None:
    start = planner.inverse_kinematics(tcp_down(0.45, 0.25, 0.25), planner.named_state("home"))[0]
    goal = planner.inverse_kinematics(tcp_down(0.45, -0.25, 0.25), start)[0]
    direct = planner.plan_to_joints(table, start, goal)
    middle = planner.robot.fk(direct.motion.evaluate(np.array([direct.duration / 2]))[0][0])
    planted = table.with_bodies([box("planted", (0.06, 0.06, 0.06), middle)])
    assert direct.route == "direct"
    for seed in range(3):
        around = planner.plan_to_joints(planted, start, goal, MotionOptions(seed=seed))
        hits = CollisionWorld(planner.robot, planted).first_collision(around.sample(0.001).positions)
        assert (around.route, hits) == ("sampled", -1)


def test_verifier_catches_a_collision_a_limit_and_a_missed_goal(
    tcp_down: Down, planner: Planner, walled: PlanningScene
) -> None:
    """Hand it bad motions: a motion that slipped past the search must not slip past it."""
    a = planner.inverse_kinematics(tcp_down(0.5, 0.3, 0.2), planner.named_state("home"), scene=walled)[0]
    b = a.copy()
    b[0] = -a[0]
    slow = PolynomialMotion(np.array([0.0, 10.0]), _smooth(a, b, 10.0))
    fast = PolynomialMotion(np.array([0.0, 0.1]), _smooth(a, b, 0.1))
    limits = planner.limits(MotionOptions())
    found = verify_motion(Sweep(planner.robot, walled), planner.robot, slow, limits, b)
    assert "wall" in str(found)
    assert 1.0 < found.time_s < 9.0
    assert "velocity of panda_joint1" in str(verify_motion(None, planner.robot, fast, limits, b))
    assert "from its goal" in str(verify_motion(None, planner.robot, slow, limits, b + 0.01))
    tight = MotionLimits(velocity=limits.velocity, acceleration=limits.acceleration, jerk=limits.jerk, tcp_speed=0.01)
    assert "speed of the TCP" in str(verify_motion(None, planner.robot, slow, tight, b))


def _smooth(a: np.ndarray, b: np.ndarray, time: float) -> np.ndarray:
    return np.stack([-2 * (b - a) / time**3, 3 * (b - a) / time**2, 0 * a, a])[:, None, :]


@pytest.mark.parametrize("fault", ["kernel says free", "searches in an empty scene", "no blend is checked"])
def test_a_planted_bug_never_leaves_the_planner(
    tcp_down: Down,
    planner: Planner,
    walled: PlanningScene,
    left: np.ndarray,
    monkeypatch: pytest.MonkeyPatch,
    fault: str,
) -> None:
    """Whatever part lies about collisions, the answer is an error or a motion that coal finds free everywhere."""
    faulty = Planner(planner.robot.description)
    asked = []

    def lie(name: str, answer: Callable[..., object]) -> None:
        monkeypatch.setattr(CollisionWorld, name, lambda *given: asked.append(name) or answer(*given))

    if fault == "kernel says free":
        lie("free_edge", lambda *_: 0)
        lie("is_proven", lambda *_: True)
    elif fault == "searches in an empty scene":
        empty = CollisionWorld(planner.robot, PlanningScene())
        lie("eased", lambda *_: empty)
    else:
        lie("blends", _largest_blends)
    goal = left * [-1, 1, -1, 1, -1, 1, -1]
    with suppress(PlannerError):
        samples = faulty.plan_to_joints(walled, left, goal).sample(0.002).positions
        coal = CollisionWorld(planner.robot, walled).coal
        assert all(coal.is_free(q) for q in samples)
    assert asked


def _largest_blends(world: CollisionWorld, path: np.ndarray, largest: float, *_: float) -> np.ndarray:
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    return np.minimum(largest, 0.499 * np.minimum(lengths[:-1], lengths[1:]))


def test_a_motion_that_would_take_hours_is_refused_before_it_is_sampled(planner: Planner, left: np.ndarray) -> None:
    down = planner.robot.fk(left)
    line = replace(down, position=(down.position[0], down.position[1], down.position[2] - 0.05))
    for limit in ({"velocity_scaling": 1e-6}, {"max_tcp_speed_m_s": 1e-6}, {"acceleration_scaling": 1e-15}):
        options = MotionOptions(**limit)
        with pytest.raises(PlannerError, match="may take 600 s; allow more speed"):
            planner.plan_to_joints(PlanningScene(), left, left + 0.1, options)
        with pytest.raises(PlannerError, match="may take 600 s; allow more speed"):
            planner.plan_cartesian(PlanningScene(), left, [line], options)


def test_checks_of_trajectories_end_when_the_watch_says_so(planner: Planner, left: np.ndarray) -> None:
    path = np.linspace(left, left + 0.1, 1_000)
    looked: list[int] = []

    def watch(_: str, place: int) -> None:
        looked.append(place)
        if place > 500:
            raise RequestTimeoutError("over")

    with pytest.raises(RequestTimeoutError):
        planner.check_trajectory(PlanningScene(), path, watch=watch)
    assert looked == [0, 200, 400, 600]
    wall = PlanningScene(bodies=(box("wall", (0.02, 2.0, 2.0), Pose(position=(-0.3, 0.0, 0.5))),))
    there = path.copy()
    there[:, 0] = np.linspace(0.0, 2.8, 1_000)
    apart = planner.check_trajectory(wall, there)
    place = CollisionWorld(planner.robot, wall).first_hit(there)
    assert place > 200
    assert apart.index == int(place)


def test_goal_list_reaches_the_reachable_one(tcp_down: Down, planner: Planner, table: PlanningScene) -> None:
    goals = [Pose(position=(2.0, 0.0, 0.3)), tcp_down(0.5, 0.1, 0.3)]
    plan = planner.plan_to_pose(table, planner.named_state("home"), goals)
    assert plan.goal_index == 1


def test_goal_at_the_start_is_still(planner: Planner, table: PlanningScene) -> None:
    home = planner.named_state("home")
    assert planner.plan_to_joints(table, home, home).route == "still"
    start = np.array([0.0, -0.2, 0.0, -2.2, 0.0, 2.0, 0.785])
    assert planner.plan_to_joints(table, start, start + 1e-9 * np.eye(7)[0]).duration <= 1e-3


@pytest.mark.parametrize(
    ("height", "reach", "code", "words"),
    [
        (0.3, 1.4, "GOAL_UNREACHABLE", r"within \d+.* mm"),
        (-0.02, 0.5, "GOAL_IN_COLLISION", "no collision-free goal among .* table"),
    ],
)
def test_pose_failures_say_why(
    tcp_down: Down, planner: Planner, table: PlanningScene, height: float, reach: float, code: str, words: str
) -> None:
    with pytest.raises(PlannerError, match=words) as caught:
        planner.plan_to_pose(table, planner.named_state("home"), [tcp_down(reach, 0.0, height)])
    assert caught.value.code == ErrorCode[code]


def test_joint_failures_say_why(tcp_down: Down, planner: Planner, table: PlanningScene) -> None:
    home, beyond = planner.named_state("home"), planner.robot.upper + 0.1
    low = planner.ik.nearest(tcp_down(0.5, 0.0, -0.02), home)
    for start, goal, code, words in (
        (low, home, "START_IN_COLLISION", "table.* overlap by"),
        (beyond, home, "START_OUTSIDE_LIMITS", "panda_joint1"),
        (home, beyond, "GOAL_UNREACHABLE", "outside"),
        (home, low, "GOAL_IN_COLLISION", "table"),
    ):
        with pytest.raises(PlannerError, match=words) as caught:
            planner.plan_to_joints(table, start, goal)
        assert caught.value.code == ErrorCode[code]


@pytest.mark.parametrize("joints", [[0.0] * 6, [0.0] * 6 + [float("nan")], [[0.0] * 7]])
def test_malformed_joints_are_refused(planner: Planner, table: PlanningScene, joints: list[float]) -> None:
    with pytest.raises(InvalidRequestError, match="start"):
        planner.plan_to_joints(table, joints, planner.named_state("home"))


@pytest.mark.parametrize("bad", [{"velocity_scaling": 0.0}, {"velocity_scaling": float("nan")},
                                 {"max_tcp_speed_m_s": -1.0}, {"padding_m": 1.0}, {"seed": -1}])  # fmt: skip
def test_malformed_options_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(InvalidRequestError):
        MotionOptions(**bad)


def test_no_way_to_the_goal_ends_in_planning_failed(planner: Planner) -> None:
    """A wall that leaves a gap for the arm's foot alone divides left from right."""
    parts = [
        box("front", (2.0, 0.02, 3.0), Pose(position=(1.2, 0.0, 1.0))),
        box("back", (2.0, 0.02, 3.0), Pose(position=(-1.2, 0.0, 1.0))),
        box("above", (0.5, 0.02, 2.0), Pose(position=(0.0, 0.0, 1.55))),
    ]
    start = np.array([1.2, 0.9, 0.0, -2.2, 0.0, 2.6, 0.8])
    goal = start * [-1, 1, 1, 1, 1, 1, 1]
    config = replace(planner.config, attempts=2, search=replace(planner.config.search, planners=(("RRTConnect", 30),)))
    hurried = Planner(planner.robot.description, config)
    with pytest.raises(PlannerError, match="no path found") as caught:
        hurried.plan_to_joints(PlanningScene(bodies=tuple(parts)), start, goal)
    assert caught.value.code == ErrorCode.PLANNING_FAILED


@pytest.mark.parametrize("stage", ["goals", "direct", "search", "timing", "verify"])
def test_a_deadline_ends_any_stage(
    tcp_down: Down, planner: Planner, walled: PlanningScene, left: np.ndarray, stage: str
) -> None:
    def watch(at: str, iterations: int) -> None:
        if at == stage:
            raise RequestTimeoutError(f"late in {at}")

    with pytest.raises(RequestTimeoutError, match=stage):
        planner.plan_to_pose(walled, left, [tcp_down(0.5, -0.3, 0.2)], watch=watch)


def test_cartesian_lift_with_a_held_cube(tcp_down: Down, planner: Planner, table: PlanningScene) -> None:
    start = planner.inverse_kinematics(tcp_down(0.5, 0.1, 0.0225), planner.named_state("home"))[0]
    cube = box("cube", (0.045, 0.045, 0.045), Pose(position=(0.5, 0.1, 0.0224)))
    scene = table.with_bodies([cube]).with_opening(0.5625)
    held = scene.attach("cube", tcp_down(0.5, 0.1, 0.0225)).with_contacts(
        [AllowedContact(body_a="cube", body_b="table")]
    )
    plan = planner.plan_cartesian(held, start, [tcp_down(0.5, 0.1, 0.15)], MotionOptions(max_tcp_speed_m_s=0.2))
    assert (plan.route, plan.fraction) == ("cartesian", 1.0)
    assert plan.duration > 0.1275 / 0.2
    with pytest.raises(PlannerError, match="cube and table|table and cube"):
        planner.plan_cartesian(scene.attach("cube", tcp_down(0.5, 0.1, 0.0225)), start, [tcp_down(0.5, 0.1, 0.15)])


def test_cartesian_stops_before_an_obstacle_with_the_part_that_is_free(
    tcp_down: Down, planner: Planner, table: PlanningScene
) -> None:
    start = planner.inverse_kinematics(tcp_down(0.5, 0.0, 0.3), planner.named_state("home"))[0]
    scene = table.with_bodies([box("block", (0.2, 0.2, 0.1), Pose(position=(0.5, 0.0, 0.05)))])
    with pytest.raises(PathIncompleteError, match="block") as caught:
        planner.plan_cartesian(scene, start, [tcp_down(0.5, 0.0, 0.05)])
    partial = caught.value.partial
    assert 0.6 < partial.fraction < 0.85
    assert planner.robot.fk(partial.end).position[2] == pytest.approx(0.3 - 0.25 * partial.fraction, abs=1e-3)
    through = planner.plan_cartesian(scene, start, [tcp_down(0.5, 0.0, 0.05)], ignore_collisions=True)
    assert through.fraction == 1.0
    assert planner.plan_cartesian(scene, start, [tcp_down(0.5, 0.0, 0.05)], min_fraction=0.5).fraction < 1.0


def test_line_swings_the_elbow_where_it_must(planner: Planner, tcp_down: Down) -> None:
    """From here the plain way of following a lift ends at a singularity; with the elbow swung it goes on."""
    goal = tcp_down(0.4, 0.0, 0.3, 0.6)
    begins = planner.ik.solve(tcp_down(0.4, 0.0, 0.05, 0.6), planner.named_state("home"), seed=4, thorough=True)
    start = next(q for q in begins if follow_line(planner.robot, q, goal).fraction < 1.0)
    plan = planner.plan_cartesian(PlanningScene(), start, [goal])
    poses = planner.robot.arm.tcp_poses(plan.sample(0.002).positions)
    assert np.abs(poses[:, :2, 3] - [0.4, 0.0]).max() < 5e-4
    assert poses[-1] == pytest.approx(goal.matrix, abs=1e-5)


def test_cartesian_out_of_reach_says_where(tcp_down: Down, planner: Planner) -> None:
    with pytest.raises(PathIncompleteError, match="of the line"):
        planner.plan_cartesian(PlanningScene(), planner.named_state("home"), [tcp_down(1.2, 0.0, 0.4)])


def test_check_trajectory_finds_an_elbow_between_its_points(planner: Planner) -> None:
    """Two free points whose straight joint line sweeps the elbow through a post."""
    middle = np.array([0.0, 1.0, 0.0, -2.2, 0.0, 3.0, 0.8])
    a, b = middle.copy(), middle.copy()
    a[0], b[0] = -0.6, 0.6
    elbow = planner.robot.fk(middle, "panda_link4").position
    post = PlanningScene(bodies=(box("post", (0.03, 0.03, 0.1), Pose(position=elbow)),))
    assert planner.check_state(post, a).valid
    assert planner.check_state(post, b).valid
    finding = planner.check_trajectory(post, [a, b, b + 0.01])
    assert "post" in (finding.contacts[0].body_a, finding.contacts[0].body_b)
    assert finding.index == 0
    assert planner.check_trajectory(PlanningScene(), [a, b]).valid
    halfway = planner.check_trajectory(post, [a, b], [0.0, 10.0])
    assert halfway.index == 0
    assert 1.0 < halfway.time_s < 7.0


def test_check_trajectory_keeps_its_padding_and_its_path_constraint(planner: Planner, tcp_down: Down) -> None:
    low = planner.inverse_kinematics(tcp_down(0.5, 0.0, 0.3), planner.named_state("home"))[0]
    path = [low, low + 1e-3]
    below = PlanningScene(bodies=(box("block", (0.1, 0.1, 0.1), Pose(position=(0.5, 0.0, 0.23))),))
    assert planner.check_trajectory(below, path).valid
    finding = planner.check_trajectory(below, path, options=MotionOptions(padding_m=0.05))
    assert re.search(r"finger and block are \d+\.\d mm apart, 50\.0 mm needed", str(finding))
    leaning = low + [0.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0]
    upright = MotionOptions(upright=Upright(tolerance_rad=0.2))
    for options in (upright, replace(upright, padding_m=0.01)):
        assert "tilted" in str(planner.check_trajectory(PlanningScene(), [low, leaning], options=options))


def test_a_line_keeps_its_path_constraint_also_where_it_ignores_collisions(planner: Planner, tcp_down: Down) -> None:
    begin = planner.inverse_kinematics(tcp_down(0.5, 0.0, 0.3), planner.named_state("home"))[0]
    leaning = planner.robot.fk(begin) @ Pose(quat_xyzw=(np.sin(0.4), 0.0, 0.0, np.cos(0.4)))
    options = MotionOptions(upright=Upright(tolerance_rad=0.2))
    table = PlanningScene(bodies=(box("table", (1.0, 1.0, 1.0), Pose(position=(0.5, 0.0, 0.0))),))
    with pytest.raises(PathIncompleteError, match=r"only 25\.. % .* tilted by 0\.200 rad"):
        planner.plan_cartesian(table, begin, [leaning], options, ignore_collisions=True, wide=False)
    with pytest.raises(PlannerError, match="no upright goal among .* at the nearest the tool is tilted") as caught:
        planner.plan_to_pose(PlanningScene(), begin, [tcp_down(2.0, 0.0, 0.0), leaning], options)
    assert caught.value.code == ErrorCode.CONSTRAINT_VIOLATED


def test_a_body_that_a_motion_could_not_leave_is_named_at_the_start(planner: Planner, tcp_down: Down) -> None:
    """Verification refuses every motion from a start nearer than it can tell from a contact."""
    start = planner.inverse_kinematics(tcp_down(0.5, 0.0, 0.3), planner.named_state("home"))[0]
    cube = Attached(body=box("cube", (0.04, 0.04, 0.04)))
    low = planner.robot.fk(start).position[2] - 0.02
    for gap, refused in ((2e-6, True), (2e-5, False)):
        block = box("block", (0.2, 0.2, 0.1), Pose(position=(0.5, 0.0, low - gap - 0.05)))
        scene = PlanningScene(bodies=(block,), attached=(cube,), gripper_opening=0.5)
        lift = tcp_down(0.5, 0.0, 0.4)
        if not refused:
            assert planner.plan_to_pose(scene, start, [lift]).route == "direct"
            continue
        for plan in (planner.plan_to_pose, planner.plan_cartesian):
            with pytest.raises(PlannerError, match="start in collision: block and cube touch") as caught:
                plan(scene, start, [lift])
            assert caught.value.code == ErrorCode.START_IN_COLLISION


def test_a_line_whose_curve_leaves_a_limit_is_done_up_to_there(planner: Planner) -> None:
    """The spline between configurations that keep joint 2's limit passes it by a milliradian near the end."""
    start = np.array([0.59, -0.39, -0.78, -3.07, -0.22, 2.4, 1.63])
    begin = planner.robot.fk(start)
    end = replace(begin, position=tuple(np.add(begin.position, (0.16, -0.12, -0.12)).tolist()))
    with pytest.raises(PathIncompleteError, match="panda_joint2 reaches") as caught:
        planner.plan_cartesian(PlanningScene(), start, [end], ignore_collisions=True, wide=False)
    assert 0.7 < caught.value.partial.fraction < 1.0
    assert not planner.robot.limit_violations(caught.value.partial.end)


def test_an_elbow_that_only_the_rollout_moves_is_found(planner: Planner, tcp_down: Down) -> None:
    """Rolled out as deltas, the hand is where the plan has it but the elbow is not: a post there is found in time."""
    start = planner.named_state("home")
    goals = planner.ik.solve(tcp_down(0.45, 0.35, 0.3), start, seed=0, thorough=True)
    controller = DeltaController(ArmKinematics(planner.robot.description))

    def elbows(path: np.ndarray) -> np.ndarray:
        return np.array([planner.robot.fk(q, "panda_link4").position for q in path])

    for goal in goals[::-1]:  # the farther the goal, the farther apart the two elbows
        plan = planner.plan_to_joints(PlanningScene(), start, goal)
        poses = planner.robot.tcp_poses(plan.sample(0.1).positions)
        deltas = [delta_between(a, b, 1.0) for a, b in zip(poses, poses[1:], strict=False)]
        states = [controller.start(start)]
        for delta in deltas:
            states.append(controller.step(states[-1], delta).state)
        rolled = np.array([state.joints for state in states])
        planned = elbows(plan.sample(0.01).positions)
        apart = [float(np.linalg.norm(planned - elbow, axis=1).min()) for elbow in elbows(rolled)]
        if max(apart) > 0.15:
            break
    far = int(np.argmax(apart))
    post = box("post", (0.02, 0.02, 0.02), Pose(position=tuple(elbows(rolled)[far].tolist())))
    scene = PlanningScene(bodies=(post,))
    assert planner.check_trajectory(scene, plan.sample(0.002).positions).valid
    finding = planner.check_trajectory(scene, rolled)
    assert "post" in (finding.contacts[0].body_a, finding.contacts[0].body_b)
    assert 0 <= finding.index <= far


def test_check_trajectory_finds_limits(planner: Planner, table: PlanningScene) -> None:
    home = planner.named_state("home")
    path = np.stack([home, home + 0.1])
    assert planner.check_trajectory(table, path, times=[0.0, 1.0]).valid
    assert "velocity" in str(planner.check_trajectory(table, path, times=[0.0, 0.01]))
    assert "TCP" in str(
        planner.check_trajectory(table, path, [0.0, 1.0], options=MotionOptions(max_tcp_speed_m_s=0.01))
    )
    beyond = np.stack([home, home, planner.robot.upper + 0.1])
    finding = planner.check_trajectory(PlanningScene(), beyond)
    assert "panda_joint1 reaches" in str(finding)
    assert finding.index == 2
    jump = home + np.outer([0.0, 0.01, 0.02, 1.02, 1.03], [1, 0, 0, 0, 0, 0, 0])
    assert planner.check_trajectory(table, jump, np.arange(5) * 0.1).index == 2, "the jump begins at point 2"
    fast = np.outer([0, 0, 0, 9, 0], np.ones(7))
    assert planner.check_trajectory(table, jump[[0] * 5], np.arange(5), fast).index == 3
    for bad in ({"times": [0.0, 0.0]}, {"times": [0.0]}, {"velocities": [[0.0] * 7]}):
        with pytest.raises(InvalidRequestError):
            planner.check_trajectory(table, path, **bad)


def test_a_trajectory_that_never_ends_is_refused(planner: Planner, table: PlanningScene) -> None:
    home = planner.named_state("home")
    for last in (np.inf, np.nan, 0.0):
        with pytest.raises(InvalidRequestError, match="times of a trajectory must be finite"):
            planner.check_trajectory(table, np.stack([home, home + 0.1]), [0.0, last])
