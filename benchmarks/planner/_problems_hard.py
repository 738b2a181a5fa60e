"""Hard planning problems in the style of MotionBenchMaker: shelves, a crate, a cage, a table with clutter.

The scenes follow the published families at the Panda's scale: a small, a tall and a thin bookshelf, a box with a lid, a
cage, picking from a cluttered table from above and from under it. Dimensions, the scene's pose, its objects and the
grasp are drawn per seed. The arm starts outside, and the goal is a grasp's tcp pose inside.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pinocchio as pin
from benchmarks.planner._problems import Problem, free_configuration, problem
from benchmarks.planner._referee import Referee, Solid

Array = npt.NDArray[np.float64]
Scene = tuple[list[Solid], Callable[[np.random.Generator], pin.SE3], Callable[[np.random.Generator], pin.SE3]]
"""Solids, and functions that draw a tcp pose at the start and at the goal."""
WALL = 0.02
READY = np.array([0.0, -0.7854, 0.0, -2.3562, 0.0, 1.5708, 0.7854])


def hard(family: str, seed: int, salt: int = 0) -> Problem:
    """Draw a problem of a family.

    Args:
        family: One of `FAMILIES`.
        seed: Number of the problem.
        salt: Selects a set of problems.
    """
    rng = np.random.default_rng([20261, salt, list(FAMILIES).index(family), seed])
    for _ in range(200):
        solids, start_pose, goal_pose = FAMILIES[family](rng)
        referee = Referee(solids)
        start = free_configuration(rng, referee, start_pose, 20)
        if start is None:
            continue
        end = free_configuration(rng, referee, goal_pose, 60)
        if end is not None:
            return problem(f"{family}-{seed}", referee, start, end)
    raise RuntimeError(f"no {family} problem from seed {seed}")


def _shelf(
    rng: np.random.Generator, *, levels: int, pitch: float, width: float, depth: float, floor: float, divider: bool
) -> Scene:
    """Return an open-fronted shelf that faces the robot, with cans in it; its front is the plane x = 0 of its frame."""
    height = levels * pitch
    parts = [_box((depth, width, WALL), (depth / 2, 0.0, level * pitch)) for level in range(levels + 1)]
    sides = [-width / 2, width / 2] + ([0.0] if divider else [])
    parts += [_box((depth, WALL, height + WALL), (depth / 2, y, height / 2)) for y in sides]
    cans = []
    for level in range(levels):
        for _ in range(3 if not divider else 2):
            y = rng.uniform(-width / 2 + 0.08, width / 2 - 0.08)
            if divider and abs(y) < 0.08:
                y = np.copysign(0.1, y)
            place = (rng.uniform(0.08, min(depth, 0.4) - 0.06), y, level * pitch + WALL / 2 + 0.0705)
            cans.append(Solid(kind="cylinder", size=(0.03, 0.14), position=place))
    pose = _facing(rng.uniform(0.42, 0.56), rng.uniform(-0.7, 0.7), floor)

    def goal(rng: np.random.Generator) -> pin.SE3:
        can = cans[rng.integers(len(cans))]
        ahead = rng.uniform(0.045, 0.13)
        grasp = _forward_grasp(rng, pitch=rng.uniform(-0.15, 0.25), yaw=rng.uniform(-0.4, 0.4))
        return pose * pin.SE3(grasp, np.array(can.position) + [-ahead, 0.0, rng.uniform(-0.01, 0.04)])

    return [_moved(pose, solid) for solid in (*parts, *cans)], _outside, goal


def _bookshelf_small(rng: np.random.Generator) -> Scene:
    return _shelf(rng, levels=1, pitch=0.28, width=0.8, depth=0.5, floor=rng.uniform(0.05, 0.5), divider=False)


def _bookshelf_tall(rng: np.random.Generator) -> Scene:
    return _shelf(rng, levels=3, pitch=0.3, width=0.9, depth=0.5, floor=rng.uniform(-0.1, 0.1), divider=False)


def _bookshelf_thin(rng: np.random.Generator) -> Scene:
    return _shelf(rng, levels=4, pitch=0.25, width=0.9, depth=0.35, floor=rng.uniform(-0.15, 0.1), divider=True)


def _crate(rng: np.random.Generator) -> Scene:
    """Return an open crate with its lid tilted up at the back; the goal is a can at its bottom, from above."""
    width, height, front = rng.uniform(0.4, 0.5), rng.uniform(0.4, 0.5), rng.uniform(0.3, 0.4)
    pose = _facing(rng.uniform(0.28, 0.36), rng.uniform(-0.9, 0.9), rng.uniform(-0.1, 0.1))
    half = width / 2
    lid = pin.SE3(pin.rpy.rpyToMatrix(0.0, rng.uniform(0.6, 0.9), 0.0), np.array([width * 0.95, 0.0, height + 0.22]))
    parts = [
        _box((width, width, WALL), (half, 0.0, 0.0)),
        _box((width, WALL, height), (half, -half, height / 2)),
        _box((width, WALL, height), (half, half, height / 2)),
        _box((WALL, width, front), (0.0, 0.0, front / 2)),
        _box((WALL, width, height), (width, 0.0, height / 2)),
        _moved(lid, _box((width * 0.8, width, WALL), (0.0, 0.0, 0.0))),
    ]
    place = (rng.uniform(0.15, width - 0.15), rng.uniform(-half + 0.12, half - 0.12), WALL / 2 + 0.0705)
    can = Solid(kind="cylinder", size=(0.03, 0.14), position=place)

    def goal(rng: np.random.Generator) -> pin.SE3:
        above = np.array(place) + [0.0, 0.0, rng.uniform(0.075, 0.14)]
        return pose * pin.SE3(_downward_grasp(rng, 0.35), above)

    return [_moved(pose, solid) for solid in (*parts, can)], _outside, goal


def _cage(rng: np.random.Generator) -> Scene:
    """Return a cage with walls, a roof and two bars in front; the goal is above a cube, reached between the bars."""
    width, gap = rng.uniform(0.55, 0.7), rng.uniform(0.24, 0.3)
    height = 0.12 + 2.0 * gap
    pose = _facing(rng.uniform(0.3, 0.4), rng.uniform(-0.5, 0.5), rng.uniform(-0.05, 0.1))
    half = width / 2
    parts = [
        _box((width, width, WALL), (half, 0.0, 0.0)),
        _box((width, WALL, height), (half, -half, height / 2)),
        _box((width, WALL, height), (half, half, height / 2)),
        _box((WALL, width, height), (width, 0.0, height / 2)),
        _box((width * 0.93, width, WALL), (width * 0.535, 0.0, height)),
        _box((WALL, width, WALL), (0.0, 0.0, 0.12)),
        _box((WALL, width, WALL), (0.0, 0.0, 0.12 + gap)),
    ]
    place = (rng.uniform(0.15, 0.35), rng.uniform(-half + 0.15, half - 0.15), WALL / 2 + 0.0355)
    cube = _box((0.07, 0.07, 0.07), place)

    def goal(rng: np.random.Generator) -> pin.SE3:
        grasp = _forward_grasp(rng, pitch=rng.uniform(0.2, 1.4), yaw=rng.uniform(-0.3, 0.3))
        return pose * pin.SE3(grasp, np.array(place) + [-0.03, 0.0, rng.uniform(0.06, 0.15)])

    return [_moved(pose, solid) for solid in (*parts, cube)], _outside, goal


def _table(rng: np.random.Generator, *, under: bool) -> Scene:
    """Return a table on four legs with clutter and a can behind it; the arm starts above it, or under it."""
    top = rng.uniform(0.15, 0.3)
    front, depth, width = rng.uniform(0.33, 0.42), 0.7, 1.2
    pose = _facing(front, rng.uniform(-0.3, 0.3), 0.0)
    legs = [(x, y) for x in (0.05, depth - 0.05) for y in (-width / 2 + 0.05, width / 2 - 0.05)]
    parts = [_box((depth, width, 0.04), (depth / 2, 0.0, top - 0.02))]
    parts += [_box((0.05, 0.05, 0.7), (x, y, top - 0.04 - 0.351)) for x, y in legs]
    clutter = []
    for _ in range(rng.integers(4, 7)):
        tall = rng.uniform(0.15, 0.35)
        size = (rng.uniform(0.02, 0.12), rng.uniform(0.02, 0.2), tall)
        clutter.append(_box(size, (rng.uniform(0.03, 0.45), rng.uniform(-0.4, 0.4), top + tall / 2 + 0.001)))
    place = (rng.uniform(0.1, 0.3), rng.uniform(-0.25, 0.25), top + 0.061)
    can = Solid(kind="cylinder", size=(0.03, 0.12), position=place)

    def goal(rng: np.random.Generator) -> pin.SE3:
        if rng.random() < 0.5:
            grasp, off = _downward_grasp(rng, 0.3), np.array([0.0, 0.0, rng.uniform(0.065, 0.1)])
        else:
            grasp = _forward_grasp(rng, pitch=rng.uniform(0.0, 0.6), yaw=rng.uniform(-0.8, 0.8))
            off = -grasp[:, 2] * rng.uniform(0.05, 0.1)
        return pose * pin.SE3(grasp, np.array(place) + off)

    def below(rng: np.random.Generator) -> pin.SE3:
        grasp = _forward_grasp(rng, pitch=rng.uniform(-0.2, 0.9), yaw=rng.uniform(-0.5, 0.5))
        return pose * pin.SE3(grasp, rng.uniform([0.05, -0.25, top - 0.35], [0.25, 0.25, top - 0.12]))

    return [_moved(pose, solid) for solid in (*parts, *clutter, can)], below if under else _outside, goal


def _outside(rng: np.random.Generator) -> pin.SE3:
    """Draw a tcp pose near the ready state, clear of the obstacles in front of the arm."""
    tilt = pin.rpy.rpyToMatrix(*rng.uniform(-0.3, 0.3, 2), rng.uniform(-1.5, 1.5))
    return pin.SE3(tilt @ np.diag([1.0, -1.0, -1.0]), rng.uniform([0.15, -0.4, 0.3], [0.35, 0.4, 0.65]))


def _forward_grasp(rng: np.random.Generator, *, pitch: float, yaw: float) -> Array:
    """Return a tcp orientation that approaches (z) along +x, pitched down and yawed; fingers level, either way up."""
    rotation = pin.rpy.rpyToMatrix(0.0, 0.0, yaw) @ pin.rpy.rpyToMatrix(0.0, np.pi / 2 + pitch, 0.0)
    return np.asarray(rotation @ pin.utils.rotate("z", np.pi * rng.integers(2)))


def _downward_grasp(rng: np.random.Generator, tilt: float) -> Array:
    turn = pin.rpy.rpyToMatrix(*rng.uniform(-tilt, tilt, 2), rng.uniform(-np.pi, np.pi))
    return np.asarray(turn @ np.diag([1.0, -1.0, -1.0]))


def _facing(distance: float, azimuth: float, height: float) -> pin.SE3:
    """Return a frame at a distance from the base's axis whose +x points away from it."""
    turn = pin.utils.rotate("z", azimuth)
    return pin.SE3(turn, turn @ np.array([distance, 0.0, 0.0]) + [0.0, 0.0, height])


def _box(size: tuple[float, float, float], position: tuple[float, float, float]) -> Solid:
    return Solid(kind="box", size=size, position=position)


def _moved(pose: pin.SE3, solid: Solid) -> Solid:
    x, y, z, *quat = pin.SE3ToXYZQUAT(pose * solid.placement).tolist()
    return replace(solid, position=(x, y, z), quat_xyzw=tuple(quat))


FAMILIES: dict[str, Callable[[np.random.Generator], Scene]] = {
    "bookshelf_small": _bookshelf_small,
    "bookshelf_tall": _bookshelf_tall,
    "bookshelf_thin": _bookshelf_thin,
    "box": _crate,
    "cage": _cage,
    "table_pick": lambda rng: _table(rng, under=False),
    "table_under_pick": lambda rng: _table(rng, under=True),
}
