"""Collision checks of states, edges and paths in the native kernel, on the exact convex shapes, also between states.

The kernel agrees with coal (a test compares them). coal is slower from Python; it reports the touching pairs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from functools import cache, lru_cache, partial
from typing import NamedTuple, TypeVar

import coal
import numpy as np
import numpy.typing as npt

from roboxim_core.errors import InvalidRequestError
from roboxim_core.poses import Vec3
from roboxim_planner.collisions.contacts import ContactModel, ContactPair, ContactRules, held_shape
from roboxim_planner.collisions.geometry import make_shape, placed_shapes
from roboxim_planner.constraint import Upright
from roboxim_planner.native import native
from roboxim_planner.robot import PlannerRobot, native_shape, pose_matrix
from roboxim_planner.scene import Body, BodyShape, PlanningScene, PointHull, TriangleMesh

__all__ = ["CollisionWorld", "ContactPair"]
Array = npt.NDArray[np.float64]
P = TypeVar("P")
SEARCH_RESOLUTION_M = 0.01
EXACT_RESOLUTION_M = 2.5e-4
SELF_MARGIN_M = 2e-3  # distance that a search keeps between parts of the arm, where start and goals allow it
_HALVINGS = 5  # number of times that a colliding blend is halved
TOUCH_M = 5e-6  # the native kernel and coal differ by less in exact distances of hulls
_PLAIN = ("box", "sphere", "cylinder", "capsule")


class CollisionWorld:
    """The robot among the bodies of one scene. Not thread-safe."""

    def __init__(
        self, robot: PlannerRobot, scene: PlanningScene, *, padding: float = 0.0, upright: Upright | None = None
    ) -> None:
        """Build the geometry of a scene.

        Args:
            robot: The robot.
            scene: The bodies around it.
            padding: Distance from obstacles at or below which the arm counts as touching them [m].
            upright: Path constraint on the tool that a free state must satisfy; none: unconstrained.

        Raises:
            InvalidRequestError: On a hull without volume or an unknown name in an allowed contact.
        """
        self.robot = robot
        self.scene = scene
        self.padding = padding
        self._rules = ContactRules(robot, scene)
        self._placed = placed_shapes(scene)
        self._coal = cache(lambda: ContactModel(robot, scene, self._rules))
        self._margins: dict[float, native.Margins] = {}
        self._eased: Array | None = None
        self.upright = upright
        self.native = self._build()
        if upright is not None:
            direction = scene.robot_pose.rotation.inv().apply(_unit(upright.world_axis))
            self.native.set_upright(_unit(upright.tool_axis), direction, upright.tolerance_rad)

    def padded(self, padding: float) -> CollisionWorld:
        """Return the same world with another padding; it shares the geometry."""
        other = object.__new__(CollisionWorld)
        other.__dict__.update(self.__dict__)
        other.padding, other._eased, other._margins = padding, None, {}
        return other

    def eased(self, padding: float, states: Array) -> CollisionWorld:
        """Return the same world with a padding that the given states satisfy: smaller for pairs that are near in one.

        A free path in the eased world touches nothing, because a pair's margin is also its resolution: the motion below
        which a free state stands for its surroundings. Exceptions are pairs with a smaller margin than the resolution
        that a check asks for.

        Args:
            padding: Distance from obstacles at or below which the arm counts as touching, if the states allow it [m].
            states: Arm configurations that touch nothing, shape (N, dof) [rad].
        """
        world = self.padded(padding)
        margins = 0.5 * self.native.clearances(states, 2.0 * padding)
        margins[: self._item_pairs] = np.minimum(margins[: self._item_pairs], SELF_MARGIN_M)
        world._eased = margins
        return world

    def margins(self, resolution: float) -> native.Margins:
        """Return the margins of a check at a resolution [m]."""
        known = self._margins.get(resolution)
        if known is None:
            if self._eased is None:
                known = native.Margins(self.padding, 0.0, resolution)
            else:
                known = native.Margins(self._eased, resolution)
            self._margins[resolution] = known
        return known

    def _build(self) -> native.World:
        robot, scene = self.robot, self.scene
        shapes = robot.link_shapes(scene.gripper_opening)
        items = [shape.item for shape in shapes]
        item_names = [shape.link for shape in shapes]
        moving = [shape.joint >= 0 and not shape.close for shape in shapes]
        own = len(items)
        makers = [make for body in scene.bodies for make in _made(_parts, body)]
        obstacles = [make(part.pose) for make, part in zip(makers, self._placed, strict=True)]
        joint, tcp_pose = robot.kinematics.tcp_attachment
        for held in scene.attached:
            placed = tcp_pose @ pose_matrix(held.body.pose)
            for part, pose in zip(_made(_held_parts, held.body), placed @ _part_poses(held.body.shapes), strict=True):
                spheres = part.spheres.copy()
                spheres[:, :3] = spheres[:, :3] @ pose[:3, :3].T + pose[:3, 3]
                items.append(native.Item(joint, part.kind, part.size, pose, spheres))
                item_names.append(held.body.name)
                moving.append(True)
        checks = self._rules.checks
        item_pairs = [
            pair for pair in robot.self_pairs if not scene.allowed or checks(item_names[pair[0]], item_names[pair[1]])
        ]
        for i, links in self._partners(item_names[own:], item_names[: robot.whole_shapes]):
            item_pairs += [(k, own + i) for k in links]
        obstacle_pairs = [
            (i, k)
            for i, others in self._partners(item_names, [part.body for part in self._placed])
            if moving[i]
            for k in others
        ]
        self._item_pairs = len(item_pairs)
        return native.World(robot.arm, items, obstacles, _flat(item_pairs), _flat(obstacle_pairs))

    def _partners(self, names: list[str], others: list[str]) -> Iterator[tuple[int, list[int]]]:
        """Yield the index of each name with the indices of the others that it must not touch."""
        found: dict[str, list[int]] = {}
        for i, name in enumerate(names):
            if name not in found:
                found[name] = [k for k, other in enumerate(others) if self._rules.checks(name, other)]
            yield i, found[name]

    @property
    def coal(self) -> ContactModel:
        """The same scene in coal; built on first use and shared by all paddings."""
        return self._coal()

    def contacts(self, joints: npt.ArrayLike, within: float = 1e-9) -> tuple[ContactPair, ...]:
        """Return the pairs that touch at an arm configuration, deepest first, one per pair of names.

        Args:
            joints: Arm configuration, shape (dof,) [rad].
            within: Distance, beyond the padding, up to which a pair counts as touching [m].
        """
        return self.coal.contacts(np.asarray(joints, dtype=float), self.padding, within)

    def is_free(self, joints: npt.ArrayLike) -> bool:
        """Return whether an arm configuration touches nothing, by the measure of a motion's proof (`TOUCH_M`)."""
        return self.native.path_is_free(joints, self._of_states)

    @property
    def _of_states(self) -> native.Margins:
        if self._eased is not None:
            return self.margins(SEARCH_RESOLUTION_M)
        return native.Margins(self.padding + TOUCH_M, TOUCH_M, SEARCH_RESOLUTION_M)

    def edge_is_free(self, start: npt.ArrayLike, end: npt.ArrayLike, resolution: float = SEARCH_RESOLUTION_M) -> bool:
        """Return whether the straight joint-space edge is free, both ends included.

        Args:
            start: Arm configuration, shape (dof,) [rad].
            end: Arm configuration.
            resolution: Motion below which a free state stands for its surroundings [m].
        """
        return self.native.path_is_free(np.array([start, end]), self.margins(resolution))

    def free_edge(self, start: Array, ends: Array, resolution: float = SEARCH_RESOLUTION_M) -> int:
        """Return the first of some configurations (N, dof) to which the straight edge is free, or -1."""
        return self.native.free_edge(start, ends, self.margins(resolution))

    def path_is_free(self, path: npt.ArrayLike, resolution: float = SEARCH_RESOLUTION_M) -> bool:
        """Return whether a polyline of arm configurations (N, dof) is free, also between its points."""
        return self.native.path_is_free(path, self.margins(resolution))

    def blends(self, path: npt.ArrayLike, largest: float, resolution: float = SEARCH_RESOLUTION_M) -> Array:
        """Return the distance from each inner waypoint at which its blend may begin; see `timing.blend_points`.

        Args:
            path: Waypoints, shape (N, dof) [rad].
            largest: Largest distance from a waypoint at which a blend may begin [rad].
            resolution: Motion below which a free state stands for its surroundings [m].

        Returns:
            Distances, shape (N - 2,) [rad]; 0 where no blend is free.
        """
        return self.native.blends(path, largest, _HALVINGS, self.margins(resolution))

    def first_hit(self, path: npt.ArrayLike, resolution: float = EXACT_RESOLUTION_M) -> float:
        """Return where a polyline first collides; 1.5 is midway between points 1 and 2; negative: no collision."""
        return self.native.first_hit(path, self.margins(resolution))

    def is_proven(self, path: npt.ArrayLike) -> bool:
        """Return whether a dense path of shape (N, dof) touches nothing, in the sense of `first_collision`."""
        return any(self.native.path_is_free(path, margins) for margins in self._proofs())

    def _proofs(self) -> Iterator[native.Margins]:
        for margin in (EXACT_RESOLUTION_M, TOUCH_M):
            yield native.Margins(self.padding + margin, margin, margin)

    def first_collision(self, path: npt.ArrayLike) -> int:
        """Return the index of the first point of a dense path of shape (N, dof) at or after a collision, or -1.

        A path that keeps a distance of the resolution or more is free, also between the checked places. Any other path
        is checked again at the resolution at which distances are exact (`TOUCH_M`).
        """
        points = np.asarray(path, dtype=float)
        hit = -1.0
        for margins in self._proofs():
            hit = self.native.first_hit(points, margins)
            if hit < 0.0:
                return -1
        return math.ceil(hit - 1e-9)

    def tilt(self, joints: npt.ArrayLike) -> float:
        """Return the tilt of the tool at a state [rad]; 0 without a constraint."""
        return 0.0 if self.upright is None else self.native.tilt(np.asarray(joints, dtype=float))

    def clearance(self, joints: npt.ArrayLike, cap: float = 10.0) -> float:
        """Return the smallest distance of any checked pair at a state [m], at most ``cap``; 0: they touch."""
        return self.native.clearance(np.asarray(joints, dtype=float), cap)

    def free_states(self, states: Iterable[Array]) -> list[Array]:
        """Return the arm configurations that are free; see `is_free`."""
        candidates = np.array(list(states))
        if not len(candidates):
            return []
        return list(candidates[self.native.free_states(candidates, self._of_states)])


def _made(make: Callable[[tuple[BodyShape, ...]], tuple[P, ...]], body: Body) -> tuple[P, ...]:
    """Return what a function makes of a body's parts; its errors name the body."""
    try:
        return make(body.shapes)
    except InvalidRequestError as error:
        raise InvalidRequestError(f"body '{body.name}': {error}") from None


def _flat(pairs: list[tuple[int, int]]) -> list[int]:
    return [index for pair in pairs for index in pair]


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
    """Return the poses of a body's parts in the body's frame, shape (N, 4, 4)."""
    return np.array([pose_matrix(part.pose) for part in shapes])


@lru_cache(maxsize=256)
def _parts(shapes: tuple[BodyShape, ...]) -> tuple[Callable[[Array], native.Obstacle], ...]:
    """Return, for each part of a body, a function that turns the part's pose into an obstacle."""
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
    """Return a body's parts in the kernel's format for held bodies."""
    return tuple(_HeldPart(*native_shape(held_shape(part))) for part in shapes)
