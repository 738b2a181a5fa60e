"""The simulated world: rebuilding, ticking, restoring, grasping."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from roboxim_core.actions import hold_action
from roboxim_core.config import digest, from_json, to_json
from roboxim_core.errors import ConfigError, ErrorCode, InvalidRequestError, RoboximError, SimError
from roboxim_core.kinematics import ArmKinematics, delta_between
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import render_world
from roboxim_core.poses import Pose, distance
from roboxim_core.specs import CameraSpec, EntitySpec, RobotSpec, SceneSpec, WorkspaceSpec
from roboxim_core.state import StateRecord
from roboxim_sim.world import Snapshot, World

LIBRARY = ModelLibrary()
DOWN = Rotation.from_quat([1.0, 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def world() -> Iterator[World]:
    with World(LIBRARY) as made:
        yield made


def cubes(seed: int, count: int = 2) -> SceneSpec:
    rng = np.random.default_rng(seed)
    entities: list[EntitySpec] = []
    while len(entities) < count:
        spot = rng.uniform([0.36, -0.2], [0.6, 0.2])
        if all(np.hypot(*(spot - e.pose.position[:2])) > 0.16 for e in entities):
            pose = Pose.from_arrays([*spot, 0.0225], Rotation.from_euler("z", rng.uniform(-math.pi, math.pi)))
            entities.append(EntitySpec(name=f"cube_{len(entities)}", model="cube", pose=pose))
    return SceneSpec(entities=tuple(entities))


def random_actions(seed: int, count: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    actions = rng.normal(scale=[0.01, 0.01, 0.01, 0.05, 0.05, 0.05, 0.0], size=(count, 7))
    actions[:, 2] -= 0.006
    actions[:, 6] = rng.uniform(0, 1, count)
    return actions.astype(np.float32)


def move_to(world: World, target: Pose, gripper: float) -> StateRecord:
    """Move straight to a pose by deltas of at most 2 cm and 0.1 rad."""
    record = world.record
    for _ in range(200):
        now = record.robot.pose_tcp_commanded
        shift = np.subtract(target.position, now.position)
        turn = (target.rotation * now.rotation.inv()).as_rotvec()
        share = min(1.0, 0.02 / max(np.linalg.norm(shift), 1e-9), 0.1 / max(np.linalg.norm(turn), 1e-9))
        following = Pose.from_arrays(now.position + share * shift, Rotation.from_rotvec(share * turn) * now.rotation)
        record = world.tick(record.seq + 1, delta_between(now, following, gripper))
        if share == 1.0:
            break
    return record


def pick(world: World, name: str, offset_m: float = 0.0, yaw_error_rad: float = 0.0) -> StateRecord:
    cube = world.record.entity(name).pose
    yaw = (cube.rotation.as_euler("xyz")[2] + math.pi / 4) % (math.pi / 2) - math.pi / 4
    rotation = Rotation.from_euler("z", yaw + yaw_error_rad) * DOWN
    grasp = Pose.from_arrays(cube.position + rotation.apply([0.0, offset_m, 0.0]), rotation)
    above = replace(grasp, position=(*grasp.position[:2], 0.15))
    move_to(world, above, 1.0)
    move_to(world, grasp, 1.0)
    for _ in range(6):
        world.tick(world.record.seq + 1, hold_action(0.0))
    move_to(world, above, 0.0)
    for _ in range(5):
        world.tick(world.record.seq + 1, hold_action(0.0))
    return world.record


@pytest.mark.parametrize("robot_id", LIBRARY.robot_ids)
def test_pybullet_and_pinocchio_agree_on_every_robot(world: World, robot_id: str) -> None:
    model = LIBRARY.robot(robot_id)
    arm = ArmKinematics(model)
    rng = np.random.default_rng(0)
    base = Pose.from_arrays([0.1, -0.2, 0.05], Rotation.from_euler("z", 0.3))
    for _ in range(5):
        joints = tuple(rng.uniform(arm.lower, arm.upper).tolist())
        opening = float(rng.uniform(0, 1))
        spec = RobotSpec(model=robot_id, pose=base, joint_positions=joints, gripper_opening=opening)
        world.load(SceneSpec(robot=spec, settle_steps=0))
        body, client = world.physics.robot, world.physics.client  # the comparison needs PyBullet's own numbers
        ours = world.link_poses()
        for number, name in body.link_names.items():
            if number >= 0:
                state = client.getLinkState(body.id, number, computeForwardKinematics=True)
                assert np.subtract(state[4], ours[name].position) == pytest.approx(np.zeros(3), abs=1e-6)
                turn = Rotation.from_quat(state[5]) * ours[name].rotation.inv()
                assert turn.magnitude() < 1e-6
        for number, lower, upper in zip(body.arm, model.limits.lower, model.limits.upper, strict=True):
            info = client.getJointInfo(body.id, number)
            assert info[8:10] == pytest.approx((lower, upper))
        for number, effort, speed in zip(body.arm, model.limits.effort, model.limits.velocity, strict=True):
            info = client.getJointInfo(body.id, number)
            assert info[10:12] == pytest.approx((effort, speed))
        for number in body.fingers:
            info = client.getJointInfo(body.id, number)
            lowest, highest = sorted(map(model.gripper.driven, (0.0, 1.0)))
            assert info[8] <= lowest + 1e-6
            assert info[9] >= highest - 1e-6


def test_tick_0_is_the_settled_scene_and_ticks_are_even(world: World) -> None:
    scene = replace(cubes(0), robot=RobotSpec(gripper_opening=0.5))
    record = world.load(scene, "e")
    assert (record.seq, record.stamp_ns, record.action_executed) == (0, 0, ())
    assert record.robot.gripper_opening == pytest.approx(0.5, abs=0.01)
    assert record.entity("cube_0").pose.position[2] == pytest.approx(0.0225, abs=5e-4)
    (contact,) = record.contacts_between("cube_0", "table")
    assert contact.force_last == pytest.approx(0.08 * 9.81, rel=0.02)
    for seq in (1, 2, 3):
        record = world.tick(seq, hold_action(0.5))
        assert (record.seq, record.stamp_ns) == (seq, seq * 100_000_000)


def test_arm_follows_its_command(world: World) -> None:
    record = world.load(SceneSpec(), "e")
    start = record.robot.pose_tcp_commanded
    for _ in range(12):
        record = world.tick(record.seq + 1, [0.015, 0.01, -0.01, 0.02, 0.0, 0.05, 1.0])
        lag = distance(record.robot.pose_tcp_commanded, record.robot.pose_tcp_measured)
        assert lag[0] < 0.002
        assert lag[1] < 0.01
    moved = np.subtract(record.robot.pose_tcp_commanded.position, start.position)
    assert moved == pytest.approx([0.18, 0.12, -0.12], abs=1e-6)


_REPLAY = """
import json, sys
from roboxim_core.config import from_json
from roboxim_sim.world import Snapshot, World
with World() as world:
    snapshot = from_json(sys.stdin.read(), Snapshot)
    record = world.restore(snapshot)
    print(json.dumps([record.state_hash, record.seq]))
"""


def test_actions_repeat_bit_for_bit_in_another_process(world: World) -> None:
    world.load(cubes(1), "e")
    record = pick(world, "cube_0")  # rich in contacts
    done = subprocess.run(
        [sys.executable, "-c", _REPLAY], input=to_json(world.snapshot()), capture_output=True, text=True, check=True
    )
    assert json.loads(done.stdout.splitlines()[-1]) == [record.state_hash, record.seq]


def test_a_reset_forgets_what_was_before(world: World) -> None:
    def run() -> str:
        record = world.load(cubes(2), "e")
        for action in random_actions(2, 12):
            record = world.tick(record.seq + 1, action)
        return record.state_hash

    first = run()
    world.load(cubes(3, 3), "other")
    world.tick(1, [0.02, 0.0, -0.05, 0.0, 0.0, 0.2, 0.0])
    with World(LIBRARY) as neighbour:
        neighbour.load(cubes(4))
        assert run() == first


def test_restore_names_the_first_tick_that_diverges(world: World) -> None:
    record = world.load(cubes(5), "e")
    for action in random_actions(5, 6):
        record = world.tick(record.seq + 1, action)
    snapshot = from_json(to_json(world.snapshot()), Snapshot)
    assert world.restore(snapshot, "e").state_hash == record.state_hash
    changed = [list(action) for action in snapshot.actions]
    changed[3][0] += 1e-3
    with pytest.raises(SimError, match="diverged at tick 4 of 6") as caught:
        world.restore(replace(snapshot, actions=tuple(map(tuple, changed))))
    assert caught.value.code == ErrorCode.DIVERGED


def test_interference_is_marked_and_restores_only_approximately(world: World) -> None:
    world.load(cubes(6), "e")
    world.tick(1, hold_action(1.0))
    target = Pose(position=(0.5, 0.0, 0.0225))
    record = world.set_entity_state("cube_0", target)
    assert record.disturbed
    assert record.entity("cube_0").pose.position == pytest.approx(target.position)
    record = world.tick(2, [0.02, 0.0, -0.02, 0.0, 0.0, 0.0, 1.0])  # the arm lags behind its command
    assert record.disturbed
    snapshot = world.snapshot()
    with pytest.raises(SimError, match="approximate=True"):
        world.restore(snapshot)
    restored = world.restore(snapshot, approximate=True)
    assert restored.disturbed
    assert (restored.seq, restored.stamp_ns) == (2, record.stamp_ns)
    assert distance(restored.entity("cube_0").pose, record.entity("cube_0").pose)[0] < 1e-4
    assert restored.robot.joint_positions == pytest.approx(record.robot.joint_positions, abs=1e-6)
    assert restored.robot.joint_commands == record.robot.joint_commands
    assert distance(restored.robot.pose_tcp_commanded, record.robot.pose_tcp_commanded)[0] < 1e-6


def test_entities_come_and_go(world: World) -> None:
    world.load(cubes(7), "e")
    world.spawn_entity(
        EntitySpec(name="new", model="cube", modifiers={"color": "blue"}, pose=Pose(position=(0.45, 0.35, 0.03)))
    )
    record = world.tick(1, hold_action(1.0))
    assert [e.name for e in record.entities] == ["cube_0", "cube_1", "new"]
    assert record.contacts_between("new", "table")
    world.delete_entity("cube_0")
    record = world.tick(2, hold_action(1.0))
    assert [e.name for e in record.entities] == ["cube_1", "new"]
    assert {b.key for b in render_world(world.scene, LIBRARY).bodies} >= set(world.body_poses())
    with pytest.raises(InvalidRequestError, match="unique"):
        world.spawn_entity(EntitySpec(name="new", model="cube"))


def _code(call: object) -> ErrorCode:
    with pytest.raises(RoboximError) as caught:
        call()  # type: ignore[operator]
    return caught.value.code


def test_rejected_requests_do_not_change_the_world(world: World) -> None:
    with World(LIBRARY) as empty:
        assert _code(lambda: empty.tick(1, hold_action(1.0))) == ErrorCode.NO_SCENE
    cabinet = EntitySpec(name="c", model="cabinet", pose=Pose(position=(0.6, 0.4, 0.1)))
    scene = cubes(8)
    record = world.load(replace(scene, entities=(*scene.entities, cabinet)), "e")
    assert _code(lambda: world.tick(2, hold_action(1.0))) == ErrorCode.WRONG_SEQ
    assert _code(lambda: world.tick(1, [math.nan] * 7)) == ErrorCode.INVALID_ACTION
    assert _code(lambda: world.tick(1, [0.0] * 6)) == ErrorCode.INVALID_ACTION
    assert _code(lambda: world.tick(1, hold_action(1.0), episode_id="f")) == ErrorCode.LEASE_HELD
    assert _code(lambda: world.step(1)) == ErrorCode.LEASE_HELD
    assert _code(lambda: world.move_gripper(0.0)) == ErrorCode.LEASE_HELD
    assert (
        _code(lambda: world.follow(world.checked_trajectory([1.0], [LIBRARY.robot("panda").home])))
        == ErrorCode.LEASE_HELD
    )
    assert _code(lambda: world.release("f")) == ErrorCode.LEASE_HELD
    assert _code(lambda: world.set_entity_state("cub_0", Pose())) == ErrorCode.UNKNOWN_ENTITY
    assert _code(lambda: world.set_entity_state("cube_0", joint_positions={"slide": 0.1})) == ErrorCode.INVALID_REQUEST
    assert _code(lambda: world.set_entity_state("c", joint_positions={"top": 5.0})) == ErrorCode.INVALID_REQUEST
    assert (
        _code(lambda: world.set_entity_state("cube_0", Pose(), linear_velocity=(math.nan, 0.0, 0.0)))
        == ErrorCode.INVALID_REQUEST
    )
    bad_model = SceneSpec(entities=(EntitySpec(name="a", model="aple"),))
    bad_camera = SceneSpec(cameras=(CameraSpec(name="wrist", parent="hand"),))
    for scene in (bad_model, bad_camera):
        with pytest.raises(ConfigError):
            world.load(scene)
    for name in ("panda_hand", "workspace_optical"):
        with pytest.raises(InvalidRequestError, match=f"'{name}' is reserved"):
            world.load(
                SceneSpec(entities=(EntitySpec(name=name, model="cube"),), cameras=(CameraSpec(name="workspace"),))
            )
    assert (
        _code(lambda: world.load(SceneSpec(robot=RobotSpec(joint_positions=(3.0,) * 7))))
        == ErrorCode.START_OUTSIDE_LIMITS
    )
    assert world.record == record
    assert world.tick(1, hold_action(1.0)).seq == 1


def test_the_record_reports_leaving_the_workspace(world: World) -> None:
    scene = SceneSpec(workspace=WorkspaceSpec(lower=(0.2, -0.5, 0.3), upper=(0.8, 0.5, 0.7)))
    record = world.load(scene, "e")
    for _ in range(3):
        record = world.tick(record.seq + 1, [0.0, 0.0, -0.04, 0.0, 0.0, 0.0, 1.0])
    assert record.left_workspace
    assert record.robot.pose_tcp_commanded.position[2] == pytest.approx(0.3)


def test_trajectory_moves_the_arm_and_time(world: World) -> None:
    world.load(SceneSpec())
    home = np.array(LIBRARY.robot("panda").home)
    goal = home + [0.3, 0.1, -0.2, 0.1, 0.0, 0.2, 0.4]
    states = list(world.follow(world.checked_trajectory([0.5, 1.05], [(home + goal) / 2, goal])))
    assert states[-1].stamp_ns == 1_050_000_000
    assert len(states) == 11
    assert states[-1].robot.joint_positions == pytest.approx(goal, abs=5e-3)
    assert states[-1].disturbed
    halfway = world.follow(world.checked_trajectory([1.0], [home]))
    next(halfway)
    assert _code(lambda: world.step(1)) == ErrorCode.LEASE_HELD
    halfway.close()  # cancelled: the arm stays
    before = world.record.robot.joint_commands
    assert world.step(24).robot.joint_commands == before
    assert np.abs(np.array(before) - home).max() > 0.1


@pytest.mark.parametrize(
    ("times", "positions", "message"),
    [
        ([1.0], [[0.0] * 6], "shape"),
        ([1.0], [[math.nan] * 7], "finite"),
        ([1.0, 1.0], [[0.0, 0.0, 0.0, -2.0, 0.0, 2.0, 0.0]] * 2, "increasing"),
        ([1.0], [[0.0, 0.0, 0.0, 0.5, 0.0, 2.0, 0.0]], "limits"),
        ([0.05], [[1.0, 0.0, 0.0, -2.0, 0.0, 2.0, 0.0]], "faster"),
        ([0.0, 1.0], [[1.0, 0.0, 0.0, -2.0, 0.0, 2.0, 0.0]] * 2, "the arm is at"),
        ([], [], "at least one point"),
    ],
)
def test_bad_trajectory_is_refused(
    world: World, times: list[float], positions: list[list[float]], message: str
) -> None:
    world.load(SceneSpec())
    with pytest.raises(InvalidRequestError, match=message) as caught:
        world.follow(world.checked_trajectory(times, positions))
    assert caught.value.code == ErrorCode.TRAJECTORY_INVALID


@pytest.mark.parametrize("accelerations", [None, np.zeros((2, 7))])
def test_a_spline_that_leaves_the_joint_limits_between_its_points_is_refused(
    world: World, accelerations: np.ndarray | None
) -> None:
    world.load(SceneSpec())
    robot = LIBRARY.robot("panda")
    limit = robot.limits.upper[0]
    points = [[limit - 0.2, *robot.home[1:]], [limit, *robot.home[1:]]]
    velocities = np.zeros((2, 7))
    velocities[0, 0] = 0.1
    world.checked_trajectory([2.0, 4.0], points, velocities, accelerations)  # to the limit itself
    velocities[0, 0] = 2.0
    with pytest.raises(InvalidRequestError, match="leaves the joint limits between its points: 2"):
        world.checked_trajectory([2.0, 4.0], points, velocities, accelerations)


def test_gripper_closes_outside_an_episode(world: World) -> None:
    world.load(SceneSpec())
    states = list(world.move_gripper(0.0))
    assert states[-1].robot.gripper_opening < 0.02
    assert len(states) < 20
    assert list(world.move_gripper(1.0))[-1].robot.gripper_opening > 0.98


def test_motor_efforts_carry_the_arm_and_hold_the_cube(world: World) -> None:
    record = world.load(cubes(0, 1))
    robot = record.robot
    assert len(robot.joint_efforts) == 7
    assert len(robot.finger_efforts) == len(robot.finger_velocities) == 2
    assert 10.0 < abs(robot.joint_efforts[1]) < 87.0, "the shoulder carries the arm's weight, within its motor's torque"
    assert max(map(abs, robot.finger_velocities)) < 1e-3
    closing = next(world.move_gripper(0.0)).robot
    assert max(closing.finger_velocities) < -0.01
    held = pick(world, "cube_0").robot
    assert min(map(abs, held.finger_efforts)) > 1.0
    assert world.record.scene_hash == digest(world.scene) == record.scene_hash


def test_loading_ends_a_motion(world: World) -> None:
    world.load(SceneSpec())
    motion = world.move_gripper(0.0)
    next(motion)
    world.load(SceneSpec(), "e")
    with pytest.raises(SimError, match="replaced"):
        next(motion)
    assert world.tick(1, hold_action(1.0)).seq == 1


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.thorough
def test_simple_waypoints_pick_a_cube_anywhere(world: World, seed: int) -> None:
    before = world.load(cubes(seed, 1 + seed % 3), "e")
    record = pick(world, "cube_0")
    lifted = record.entity("cube_0").pose.position[2] - before.entity("cube_0").pose.position[2]
    assert lifted > 0.12
    touching = record.contacts_between("cube_0", "robot")
    assert {c.link_b for c in touching} == {"panda_leftfinger", "panda_rightfinger"}
    assert all(c.force_last == pytest.approx(20.0, rel=0.1) for c in touching)
    assert not record.contacts_between("cube_0", "table")


@pytest.mark.parametrize(("offset_m", "yaw_error_rad"), [(0.01, 0.0), (0.0, 0.25)])
def test_a_grasp_tolerates_misalignment(world: World, offset_m: float, yaw_error_rad: float) -> None:
    world.load(cubes(3, 1), "e")
    assert pick(world, "cube_0", offset_m, yaw_error_rad).entity("cube_0").pose.position[2] > 0.12


def test_a_held_cube_does_not_slip(world: World) -> None:
    world.load(cubes(4, 1), "e")
    record = pick(world, "cube_0")
    held = record.robot.pose_tcp_measured.inverse() @ record.entity("cube_0").pose
    for _ in range(15):
        record = world.tick(record.seq + 1, [-0.01, 0.01, 0.01, 0.03, 0.02, 0.05, 0.0])
    now = record.robot.pose_tcp_measured.inverse() @ record.entity("cube_0").pose
    slip = distance(held, now)
    assert slip[0] < 0.002
    assert slip[1] < 0.03


def test_the_record_has_fall_speed_and_contact_directions(world: World) -> None:
    scene = cubes(5)
    world.load(scene)
    high = Pose(position=(0.5, 0.0, 0.0225 + 0.2))
    world.set_entity_state("cube_0", pose=high)
    falls = [world.tick(seq, hold_action(1.0)).entity("cube_0").fastest_fall for seq in range(1, 6)]
    assert max(falls) == pytest.approx(math.sqrt(2 * 9.81 * 0.2), rel=0.05)  # within the tick in which it landed
    assert falls[-1] < 0.01
    (contact,) = world.record.contacts_between("table", "cube_0")
    sign = 1.0 if contact.body_b == "cube_0" else -1.0
    assert sign * np.array(contact.force_on_b) == pytest.approx([0.0, 0.0, 0.08 * 9.81], abs=0.05)
    held = pick(world, "cube_1")
    fingers = held.contacts_between("robot", "cube_1")
    forces = [np.array(contact.force_on_b) * (1.0 if contact.body_b == "cube_1" else -1.0) for contact in fingers]
    assert len(forces) == 2
    assert np.dot(*forces) < -0.9 * np.prod([np.linalg.norm(force) for force in forces])


def test_contact_points_turn_with_the_hand(world: World) -> None:
    """Friction anchors keep contact points; after a turn their old normals would hold the fingers closed."""
    knife = LIBRARY.object("knife")
    lying = Pose(position=(0.45, 0.0, knife.rest_height))
    world.load(SceneSpec(entities=(EntitySpec(name="knife", model="knife", pose=lying),)), "e")
    grasp = world.record.entity("knife").pose @ knife.grasps[0].pose
    lifted = replace(grasp, position=(*grasp.position[:2], 0.25))
    move_to(world, lifted, 1.0)
    move_to(world, grasp, 1.0)
    for _ in range(4):
        world.tick(world.record.seq + 1, hold_action(0.0))
    for angle in (0.0, 1.6, -1.6):
        turned = Pose.from_arrays(lifted.position, Rotation.from_euler("z", angle) * lifted.rotation)
        record = move_to(world, turned, 0.0)
    closing = record.robot.pose_tcp_measured.rotation.apply([0.0, 1.0, 0.0])
    ids = world.physics.robot.id, world.physics.objects[0].id  # the record has no normals
    points = world.physics.client.getContactPoints(*ids)
    assert points
    assert min(abs(np.dot(point[7], closing)) for point in points) > 0.95
    for _ in range(3):
        record = world.tick(record.seq + 1, hold_action(1.0))
    assert record.robot.gripper_opening > 0.95
