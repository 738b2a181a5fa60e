"""Collision checks of states, edges and paths in the native kernel, on the exact convex shapes, also between states.

The kernel's answers are those of coal (a test compares them); coal itself, slower from Python, says what touches.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache, partial
from typing import NamedTuple

import coal
import numpy as np
import numpy.typing as npt

from roboxim_core.poses import Vec3
from roboxim_planner import native
from roboxim_planner.constraint import Upright
from roboxim_planner.contacts import ContactModel, ContactPair, ContactRules, held_shape
from roboxim_planner.geometry import make_shape
from roboxim_planner.robot import PlannerRobot, native_shape, pose_matrix
from roboxim_planner.scene import BodyShape, PlanningScene, PointHull, TriangleMesh

__all__ = ["CollisionWorld", "ContactPair"]
Array = npt.NDArray[np.float64]
SEARCH_RESOLUTION_M = 0.01
EXACT_RESOLUTION_M = 2.5e-4
TOUCH_M = 5e-6  # exact distances of hulls differ by less between the native kernel and coal
_PLAIN = ("box", "sphere", "cylinder", "capsule")


class CollisionWorld:
    """The robot among the bodies of one scene. Serves one thread."""

    def __init__(
        self, robot: PlannerRobot, scene: PlanningScene, *, padding: float = 0.0, upright: Upright | None = None
    ) -> None:
        """Build the geometry of a scene.

        Args:
            robot: The robot.
            scene: What is around it.
            padding: Distance from obstacles at or below which the arm counts as touching them [m].
            upright: What the tool must keep to for a state to count as free; none: nothing.

        Raises:
            InvalidRequestError: On a hull without volume or an allowed contact of an unknown name.
        """
        self.robot = robot
        self.scene = scene
        self.padding = padding
        self._rules = ContactRules(robot, scene)
        self._coal: list[ContactModel] = []
        self.upright = upright
        self.native = self._build()
        if upright is not None:
            direction = scene.robot_pose.rotation.inv().apply(_unit(upright.world_axis))
            self.native.set_upright(_unit(upright.tool_axis), direction, upright.tolerance_rad)

    def padded(self, padding: float) -> CollisionWorld:
        """Return the same world with another padding; it shares the geometry."""
        other = object.__new__(CollisionWorld)
        other.__dict__.update(self.__dict__)
        other.padding = padding
        return other

    def _build(self) -> native.World:
        robot, scene = self.robot, self.scene
        shapes = robot.link_shapes(scene.gripper_opening)
        items = [shape.item for shape in shapes]
        item_names = [shape.link for shape in shapes]
        moving = [shape.joint >= 0 and not shape.close for shape in shapes]
        own = len(items)
        obstacles, obstacle_names = self._obstacles()
        joint, tcp_pose = robot.tcp_attachment
        for held in scene.attached:
            placed = tcp_pose @ pose_matrix(held.body.pose)
            for part, pose in zip(_held_parts(held.body.shapes), placed @ _part_poses(held.body.shapes), strict=True):
                spheres = part.spheres.copy()
                spheres[:, :3] = spheres[:, :3] @ pose[:3, :3].T + pose[:3, 3]
                items.append(native.Item(joint, part.kind, part.size, pose, spheres))
                item_names.append(held.body.name)
                moving.append(True)
        checks = self._rules.checks
        item_pairs = [
            index
            for pair in robot.geometry.collisionPairs
            if not scene.allowed or checks(item_names[pair.first], item_names[pair.second])
            for index in (pair.first, pair.second)
        ]
        for i, links in self._partners(item_names[own:], item_names[: robot.whole_shapes]):
            item_pairs += [index for k in links for index in (k, own + i)]
        obstacle_pairs = [
            index
            for i, others in self._partners(item_names, obstacle_names)
            if moving[i]
            for k in others
            for index in (i, k)
        ]
        return native.World(robot.arm, items, obstacles, item_pairs, obstacle_pairs)

    def _partners(self, names: list[str], others: list[str]) -> Iterator[tuple[int, list[int]]]:
        """Yield the index of each name with the indices of the others that it may not touch."""
        found: dict[str, list[int]] = {}
        for i, name in enumerate(names):
            if name not in found:
                found[name] = [k for k, other in enumerate(others) if self._rules.checks(name, other)]
            yield i, found[name]

    def _obstacles(self) -> tuple[list[native.Obstacle], list[str]]:
        """Return the scene's shapes in the base's frame, and the body that each belongs to."""
        to_base = np.linalg.inv(pose_matrix(self.scene.robot_pose))
        made, names = [], []
        for body in self.scene.bodies:
            poses = to_base @ pose_matrix(body.pose) @ _part_poses(body.shapes)
            made += [make(pose) for make, pose in zip(_parts(body.shapes), poses, strict=True)]
            names += [body.name] * len(body.shapes)
        return made, names

    @property
    def coal(self) -> ContactModel:
        """The same scene in coal; built when first needed."""
        if not self._coal:
            self._coal.append(ContactModel(self.robot, self.scene, self._rules))
        return self._coal[0]

    def contacts(self, joints: npt.ArrayLike) -> tuple[ContactPair, ...]:
        """Return every pair that touches at an arm configuration, deepest first, one per pair of names."""
        return self.coal.contacts(np.asarray(joints, dtype=float), self.padding)

    def is_free(self, joints: npt.ArrayLike) -> bool:
        """Tell whether an arm configuration touches nothing."""
        return self.native.path_is_free(np.asarray(joints, dtype=float), self.padding, 0.0, 1.0)

    def edge_is_free(self, start: npt.ArrayLike, end: npt.ArrayLike, resolution: float = SEARCH_RESOLUTION_M) -> bool:
        """Tell whether the straight joint-space edge is free, both ends included.

        Args:
            start: Arm configuration, shape (dof,) [rad].
            end: Arm configuration.
            resolution: Motion below which a free state stands for what is around it [m].
        """
        return self.native.path_is_free(np.array([start, end]), self.padding, 0.0, resolution)

    def path_is_free(self, path: npt.ArrayLike, resolution: float = SEARCH_RESOLUTION_M) -> bool:
        """Tell whether a polyline of arm configurations (N, dof) is free, also between its points."""
        return self.native.path_is_free(np.asarray(path, dtype=float), self.padding, 0.0, resolution)

    def first_hit(self, path: npt.ArrayLike, resolution: float = EXACT_RESOLUTION_M) -> float:
        """Return where a polyline first collides, in units of its points, e.g. 1.5; negative: nowhere."""
        return self.native.first_hit(np.asarray(path, dtype=float), self.padding, 0.0, resolution)

    def first_collision(self, path: npt.ArrayLike) -> int:
        """Return the index of the first point of a dense path of shape (N, dof) at or after a collision, or -1.

        Keeping the resolution's distance proves a path, also between the places looked at. Where a path does not keep
        it, it is looked at again, as finely as distances are exact.
        """
        points = np.asarray(path, dtype=float)
        for margin in (EXACT_RESOLUTION_M, TOUCH_M):
            hit = self.native.first_hit(points, self.padding + margin, margin, margin)
            if hit < 0.0:
                return -1
        return math.ceil(hit - 1e-9)

    def tilt(self, joints: npt.ArrayLike) -> float:
        """Return by how much the tool is tilted at a state [rad]; 0 where it need not be upright."""
        return 0.0 if self.upright is None else self.native.tilt(np.asarray(joints, dtype=float))

    def clearance(self, joints: npt.ArrayLike, cap: float = 10.0) -> float:
        """Return the smallest distance of any checked pair at a state [m], at most ``cap``; 0: they touch."""
        return self.native.clearance(np.asarray(joints, dtype=float), cap)

    def free_states(self, states: Iterable[Array]) -> list[Array]:
        """Return those of some arm configurations that touch nothing."""
        return [q for q in states if self.is_free(q)]


def _unit(axis: Vec3) -> Array:
    return np.asarray(np.array(axis) / np.linalg.norm(axis))


def _solid(part: BodyShape) -> tuple[str, Array]:
    if not isinstance(part, PointHull | TriangleMesh) and part.kind in _PLAIN:
        return part.kind, np.array(part.size)
    made = make_shape(part)
    assert isinstance(made, coal.ConvexBase)
    return "hull", np.array(made.points())


@lru_cache(maxsize=256)
def _part_poses(shapes: tuple[BodyShape, ...]) -> Array:
    """Return where a body's parts are in the body, shape (N, 4, 4)."""
    return np.array([pose_matrix(part.pose) for part in shapes])


@lru_cache(maxsize=256)
def _parts(shapes: tuple[BodyShape, ...]) -> tuple[Callable[[Array], native.Obstacle], ...]:
    """Return what makes obstacles of a body's parts from their poses."""
    return tuple(
        partial(native.Obstacle, native.Mesh(np.array(part.vertices)[np.array(part.triangles)]))
        if isinstance(part, TriangleMesh)
        else partial(native.Obstacle, *_solid(part))
        for part in shapes
    )


class _HeldPart(NamedTuple):
    kind: str
    size: Array
    spheres: Array


@lru_cache(maxsize=256)
def _held_parts(shapes: tuple[BodyShape, ...]) -> tuple[_HeldPart, ...]:
    """Return a body's parts as the kernel takes what the robot carries."""
    return tuple(_HeldPart(*native_shape(held_shape(part))) for part in shapes)
