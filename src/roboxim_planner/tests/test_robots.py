"""Every robot of the library plans: nothing in the planner is about one arm."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from roboxim_core.errors import PlannerError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose, distance
from roboxim_planner.pipeline import MotionOptions, Planner
from roboxim_planner.scene import PlanningScene, box
from roboxim_planner.sequence import Stage, StageGoal, plan_sequence

LIBRARY = ModelLibrary()


@pytest.fixture(scope="module", params=LIBRARY.robot_ids)
def any_planner(request: pytest.FixtureRequest) -> Planner:
    return Planner(LIBRARY.robot(request.param))


def test_fk_of_ik_is_the_pose(any_planner: Planner) -> None:
    robot = any_planner.robot
    rng = np.random.default_rng(4)
    home = any_planner.named_state("home")
    for joints in rng.uniform(robot.lower, robot.upper, (30, robot.dof)):
        pose = robot.fk(joints)
        for solution in any_planner.inverse_kinematics(pose, home, count=3):
            off, turned = distance(robot.fk(solution), pose)
            assert (off, turned) < (1e-5, 1e-4)
            assert robot.limit_violations(solution) == ()


def test_named_states_are_free_and_within_limits(any_planner: Planner) -> None:
    for name in ("home", *any_planner.robot.description.named_states):
        finding = any_planner.check_state(PlanningScene(), any_planner.named_state(name))
        assert finding.valid, f"{name}: {finding}"


def test_picks_from_one_side_of_a_wall_and_places_on_the_other(any_planner: Planner, tcp_down) -> None:
    """A wall stands between the two sides, so the direct joint edge of the carried cube collides."""
    if any_planner.robot.description.rotations < 3:
        pytest.skip("an arm of five joints is too small for this table")
    cube = box("cube", (0.04, 0.04, 0.04), Pose(position=(0.5, 0.3, 0.021)))
    wall = box("wall", (0.3, 0.02, 0.3), Pose(position=(0.55, 0.0, 0.15)))
    table = box("table", (0.9, 1.4, 0.05), Pose(position=(0.6, 0.0, -0.03)))
    scene = PlanningScene(bodies=(table, wall, cube))
    down, up = (Pose(position=(0.0, 0.0, z)) for z in (-0.08, 0.08))
    stages = (
        Stage(kind="pose", name="approach", goals=(StageGoal(pose=tcp_down(0.5, 0.3, 0.1)),)),
        Stage(kind="cartesian", name="grasp", goals=(StageGoal(pose=down, relative=True),)),
        Stage(
            kind="cartesian", name="lift", goals=(StageGoal(pose=up, relative=True),), attach=("cube",),
            gripper_opening=0.5,
        ),
        Stage(kind="pose", name="carry", goals=(StageGoal(pose=tcp_down(0.5, -0.3, 0.2)),)),
    )  # fmt: skip
    start = any_planner.inverse_kinematics(tcp_down(0.45, 0.35, 0.3), any_planner.named_state("home"), scene=scene)[0]
    found = plan_sequence(any_planner, scene, start, stages)
    last = found.plans[-1]
    carried = scene.attach("cube", tcp_down(0.5, 0.3, 0.02)).with_opening(0.5)
    samples = last.sample(0.005)
    assert any_planner.check_trajectory(carried, samples.positions, samples.times, samples.velocities).valid
    off, _ = distance(any_planner.robot.fk(last.end), tcp_down(0.5, -0.3, 0.2))
    assert off < 1e-4
    limits = any_planner.limits(MotionOptions())
    for plan in found.plans:
        _, v, a, j = plan.motion.evaluate(np.arange(0.0, plan.duration, 1e-3))
        for values, limit in ((v, limits.velocity), (a, limits.acceleration), (j, limits.jerk)):
            assert (np.abs(values) <= 1.001 * limit).all()


def test_an_arm_of_five_joints_says_which_rotations_it_lacks(tcp_down) -> None:
    planner = Planner(LIBRARY.robot("so101"))
    home = planner.named_state("home")
    down = tcp_down(0.45, 0.1, 0.1)
    assert len(planner.inverse_kinematics(down, home))
    sideways = down @ Pose.from_arrays((0.0, 0.0, 0.0), Rotation.from_euler("x", 0.4))
    with pytest.raises(PlannerError, match="its 5 joints turn the tool in 2 directions, so ask for a tool that points"):
        planner.inverse_kinematics(sideways, home)
