"""Proofs that a robot's files fit together and that the robot can work: `roboxim robot check`."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from roboxim_core.errors import PlannerError, RoboximError
from roboxim_core.kinematics.arm import ArmKinematics
from roboxim_core.models.description import RobotModel
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose, Vec3, distance
from roboxim_core.rotation.quaternions import Quat
from roboxim_core.specs import EntitySpec, RobotSpec, SceneSpec
from roboxim_core.state import StateRecord
from roboxim_planner.collisions.checker import CollisionWorld
from roboxim_planner.ik import IkSolver
from roboxim_planner.robot import PlannerRobot
from roboxim_planner.scene import PlanningScene
from roboxim_runs.robots.gripper_derivation import jaw_gap
from roboxim_runs.robots.home import TOOL_DOWN
from roboxim_sim.bullet import bullet_client
from roboxim_sim.robot_body import RobotBody
from roboxim_sim.world import World
from roboxim_tasks.motion import JAW_CLEARANCE_M

Array = npt.NDArray[np.float64]
STATES = 200
"""Joint positions at which the engines' forward kinematics are compared."""
SAME_M, SAME_RAD = 1e-6, 1e-6
"""Largest differences between the engines."""
STEP_M = 0.05
"""Distance between the places of the reach map [m]."""
HEIGHT_M = 0.15
"""Height of the TCP above the table in the reach map [m]."""
EPISODES = 5
CUBE, TICK_M, ROCKS, HELD_M = "cube", 0.02, 8, 0.006
"""The object to hold, the way of a tick [m], turns of 0.36 rad, and how far it may move in the fingers [m]. They are
about x, along which the fingers hold least; an arm whose tool does not turn so turns about y."""


@dataclass(frozen=True, kw_only=True)
class Proof:
    """Outcome of one check."""

    name: str
    holds: bool
    detail: str
    """What was measured, or why it failed and what to do."""


def prove(robot: str, *, episodes: int = EPISODES) -> Iterator[Proof]:
    """Check a robot; yield each outcome as soon as it is there.

    Args:
        robot: Id of the robot.
        episodes: Demonstrations of picking up a cube.

    Raises:
        ConfigError: When its files are missing or invalid.
    """
    library = ModelLibrary()
    model = library.robot(robot)
    checks: tuple[tuple[str, Callable[[RobotModel], tuple[bool, str]]], ...] = (
        ("limits", _limits),
        ("kinematics", _kinematics),
        ("home", _home),
        ("self-collision", _self_collision),
        ("gripper", _gripper),
        ("holds a cube", partial(_holds, library=library)),
        ("reach", _reach),
        ("picks up a cube", partial(_skill, episodes=episodes)),
    )
    for name, check in checks:
        try:
            holds, detail = check(model)
        except RoboximError as error:
            holds, detail = False, str(error)
        yield Proof(name=name, holds=holds, detail=detail)


def _limits(model: RobotModel) -> tuple[bool, str]:
    limits = model.limits
    wrong = [
        name
        for k, name in enumerate(model.joint_names)
        if not (limits.lower[k] < limits.upper[k] and limits.velocity[k] > 0 < limits.acceleration[k])
    ]
    if wrong:
        return False, f"joint {', '.join(wrong)}: expected lower < upper and positive speed and acceleration"
    return True, f"{len(model.joint_names)} joints, {min(limits.velocity):.2f} to {max(limits.velocity):.2f} rad/s"


def _states(model: RobotModel, count: int) -> Array:
    rng = np.random.default_rng(0)
    return rng.uniform(model.limits.lower, model.limits.upper, (count, len(model.joint_names)))


def _kinematics(model: RobotModel) -> tuple[bool, str]:
    """Compare PyBullet's TCP with Pinocchio's."""
    kinematics, metres, radians = ArmKinematics(model), 0.0, 0.0
    with bullet_client() as client:
        body = RobotBody(client, model, RobotSpec(model=model.id), model.home)
        tcp = {link: number for number, link in body.link_names.items()}[model.tcp_link]
        for joints in _states(model, STATES):
            for number, position in zip(body.arm, joints, strict=True):
                client.resetJointState(body.id, number, position)
            place, turn = client.getLinkState(body.id, tcp, computeForwardKinematics=True)[4:6]
            expected = kinematics.fk(joints)
            metres = max(metres, float(np.linalg.norm(np.subtract(place, expected.position))))
            radians = max(radians, float((Rotation.from_quat(turn).inv() * expected.rotation).magnitude()))
    detail = f"PyBullet and Pinocchio differ by at most {metres:.1e} m and {radians:.1e} rad in {STATES} states"
    return metres <= SAME_M and radians <= SAME_RAD, detail


def _home(model: RobotModel) -> tuple[bool, str]:
    kinematics = ArmKinematics(model)
    if not kinematics.within_limits(model.home):
        return False, f"home {model.home} is outside of the joint limits"
    tcp = kinematics.fk(model.home)
    x, y, z = tcp.position
    return z > 0.05, f"TCP at ({x:.2f}, {y:.2f}, {z:.2f}) m in the base" + (
        "" if z > 0.05 else "; it must be above 0.05"
    )


def _self_collision(model: RobotModel) -> tuple[bool, str]:
    world = CollisionWorld(PlannerRobot(model), PlanningScene())
    if not world.is_free(np.array(model.home)):
        return False, "the arm collides with itself at home; check the SRDF and the collision meshes"
    free = float(np.mean([world.is_free(joints) for joints in _states(model, 1000)]))
    return free > 0.3, f"free of self-collision in {100 * free:.0f} % of 1,000 random states" + (
        "" if free > 0.3 else ": convex parts that overlap although the links do not touch"
    )


def _gripper(model: RobotModel) -> tuple[bool, str]:
    tool = model.gripper
    if tool.one_jaw:
        apart = [jaw_gap(model, opening) for opening in (0.0, 1.0)]
    else:
        kinematics, apart = ArmKinematics(model), []
        for opening in (0.0, 1.0):
            poses = kinematics.link_poses(model.home, [tool.driven(opening)] * len(tool.joint_names))
            left, right = (poses[link].position for link in tool.links[1:3])
            apart.append(float(np.linalg.norm(np.subtract(left, right))))
    moved, stated = apart[1] - apart[0], tool.max_opening_m - (tool.opening_map[0][0] if tool.opening_map else 0.0)
    return abs(moved - stated) < 1e-3, (
        f"finger tips open by {1000 * moved:.1f} mm, the stated opening is {1000 * stated:.1f} mm"
    )


def _holds(model: RobotModel, *, library: ModelLibrary) -> tuple[bool, str]:
    """Close on a cube below the tool, lift it, rock it, and measure how far it moves in the gripper."""
    tcp = ArmKinematics(model).fk(model.home)
    z = tcp.position[2]
    solid = library.object(CUBE)
    height, beside = solid.rest_height, solid.size[1] / 2 + JAW_CLEARANCE_M if model.gripper.one_jaw else 0.0
    x, y, _ = tcp.apply((0.0, beside, 0.0)).tolist()
    cube = EntitySpec(name=CUBE, model=CUBE, pose=Pose(position=(x, y, height)))
    rock = "roll" if model.rotations == 3 else "pitch"
    up = 10 if model.rotations == 3 else math.floor((z - height) / TICK_M)
    with World(library) as world:
        world.load(SceneSpec(robot=RobotSpec(model=model.id), entities=(cube,)))
        down = math.ceil((z - height) / TICK_M)
        for _ in range(down):
            _tick(world, dz=(height - z) / down, opening=1.0)
        missed = _catch_up(world, (tcp.position[0], tcp.position[1], height), ticks=2 * down)
        if missed > TICK_M:
            return False, (
                f"from home straight down, the tool stops {1000 * missed:.0f} mm from the cube: look at the arm by "
                "`roboxim robot sheet`; another --home, or links in the way (--without)?"
            )
        for _ in range(15):
            _tick(world)
        before = _in_tool(world.record)
        for _ in range(up):
            _tick(world, dz=TICK_M)
        for k in range(ROCKS):
            for _ in range(3):
                _tick(world, **{rock: 0.12 if k % 2 else -0.12})
        record = world.record
    off, turned = distance(before, _in_tool(record))
    touching = any(contact.force_last > 1.0 for contact in record.contacts if CUBE in (contact.body_a, contact.body_b))
    held = touching and off < HELD_M
    return (
        held,
        f"lifted and rocked ({rock}), a cube moves by {1000 * off:.1f} mm and {turned:.2f} rad in the fingers"
        + ("" if held else f"; expected less than {1000 * HELD_M:.0f} mm: check force, finger tips and their shapes"),
    )


def _catch_up(world: World, place: Vec3, *, ticks: int) -> float:
    """Move the tool of an arm that is too slow for its commands on to a place; return its distance from there [m]."""
    for _ in range(ticks):
        left = np.subtract(place, world.record.robot.pose_tcp_commanded.position)
        if np.linalg.norm(left) < 0.1 * TICK_M:
            break
        dx, dy, dz = np.clip(left, -TICK_M, TICK_M).tolist()
        _tick(world, dx=dx, dy=dy, dz=dz, opening=1.0)
    return float(np.linalg.norm(np.subtract(place, world.record.robot.pose_tcp_measured.position)))


def _tick(
    world: World, *, dx: float = 0.0, dy: float = 0.0, dz: float = 0.0, roll: float = 0.0, pitch: float = 0.0,
    opening: float = 0.0,
) -> None:  # fmt: skip
    world.tick(world.record.seq + 1, np.array([dx, dy, dz, roll, pitch, 0.0, opening], np.float32))


def _in_tool(record: StateRecord) -> Pose:
    return record.robot.pose_tcp_measured.inverse() @ record.entities[0].pose


def reach_map(model: RobotModel) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
    """Return where the arm can point its tool down, free of self-collision.

    Returns:
        x and y of the places in the base, shapes (N,) and (M,) [m]; whether each is reached, shape (N, M).
    """
    robot = PlannerRobot(model)
    solver, world = IkSolver(robot), CollisionWorld(robot, PlanningScene())
    home = np.array(model.home)
    xs, ys = np.arange(0.1, 0.951, STEP_M), np.arange(-0.6, 0.601, STEP_M)
    reached = np.zeros((len(xs), len(ys)), bool)
    for i, x in enumerate(xs):
        for j, y in enumerate(ys):
            reached[i, j] = any(
                _reaches(solver, world, home, (float(x), float(y), HEIGHT_M), turn) for turn in TOOL_DOWN
            )
    return xs, ys, reached


def _reaches(solver: IkSolver, world: CollisionWorld, near: Array, place: Vec3, turn: Quat) -> bool:
    try:
        found = solver.solve(Pose(position=place, quat_xyzw=turn), near, seed=0)
    except PlannerError:
        return False
    return any(world.is_free(joints) for joints in found)


def _reach(model: RobotModel) -> tuple[bool, str]:
    xs, ys, reached = reach_map(model)
    near, wide = (xs >= 0.3) & (xs <= 0.6), np.abs(ys) <= 0.25
    share = float(reached[np.ix_(near, wide)].mean())
    return share > 0.5, (
        f"tool down at {100 * share:.0f} % of the table's middle (x 0.3 to 0.6 m, y up to 0.25 m), "
        f"{100 * float(reached.mean()):.0f} % of the table"
    )


def _skill(model: RobotModel, *, episodes: int) -> tuple[bool, str]:
    from roboxim_runs.episodes.generation import GenerationConfig, generate

    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        result = generate(GenerationConfig(out=out, episodes=episodes, robot=model.id, size=64, workers=1))
    first = sum(kept.attempt == 0 for kept in result.kept)
    reasons = sorted({tried.reason for tried in result.results if tried.reason})
    return first == episodes, f"{first} of {episodes} at the first try" + (
        f" ({', '.join(reasons)})" if reasons else ""
    )
