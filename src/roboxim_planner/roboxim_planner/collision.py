"""Collision checks of states and edges: coal's convex shapes under a broad phase, about 15 us a state.

A `CollisionWorld` owns its geometry model, data and broad phase together, because Pinocchio's are only valid as long as
nobody adds geometry to one of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from roboxim_core.errors import InvalidRequestError, one_of
from roboxim_core.poses import Vec3
from roboxim_planner.geometry import make_shape
from roboxim_planner.robot import PlannerRobot, se3
from roboxim_planner.scene import GRIPPER, ROBOT, AllowedContact, Body, PlanningScene

Array = npt.NDArray[np.float64]
_WORLD_JOINT = 0


@dataclass(frozen=True, kw_only=True)
class ContactPair:
    """Two bodies that touch."""

    body_a: str
    """Robot link or body."""
    body_b: str
    """Robot link or body."""
    depth: float
    """Penetration [m], positive; with padding, by how much they are too near."""
    position: Vec3
    """A point of the contact in the world [m]."""

    def __str__(self) -> str:
        """Say it for an error message."""
        return f"{self.body_a} and {self.body_b} overlap by {1000.0 * self.depth:.1f} mm"


class CollisionWorld:
    """The robot among the bodies of one scene. Serves one thread."""

    def __init__(self, robot: PlannerRobot, scene: PlanningScene, *, padding: float = 0.0) -> None:
        """Build the geometry of a scene.

        Args:
            robot: The robot.
            scene: What is around it.
            padding: Distance below which two bodies count as touching [m].

        Raises:
            InvalidRequestError: On a hull without volume or an allowed contact of an unknown name.
        """
        self.robot = robot
        self.scene = scene
        self.padding = padding
        self._base = se3(scene.robot_pose)
        self._names = {item.name: robot.model.frames[item.parentFrame].name for item in robot.geometry.geometryObjects}
        self._model = robot.geometry.copy()
        to_base = self._base.inverse()
        for body in scene.bodies:
            self._add(body, _WORLD_JOINT, to_base * se3(body.pose))
        tcp = robot.model.frames[robot.tcp_frame]
        for held in scene.attached:
            self._add(held.body, tcp.parentJoint, tcp.placement * se3(held.body.pose))
        self._add_pairs(scene)
        self.reach = robot.reach + self._overhang(tcp.parentJoint)
        """Bound on how far any point of arm or held body can be from each joint's axis, shape (dof,) [m]."""
        self._data = self._model.createData()
        if padding:
            for request in self._data.collisionRequests:
                request.security_margin = padding
        self._scratch = robot.model.createData()
        self._broad = pin.BroadPhaseManager_DynamicAABBTreeCollisionManager(robot.model, self._model, self._data)

    def _add(self, body: Body, joint: int, placement: pin.SE3) -> None:
        for i, shape in enumerate(body.shapes):
            item = pin.GeometryObject(f"{body.name}#{i}", joint, 0, placement * se3(shape.pose), make_shape(shape))
            self._names[item.name] = body.name
            self._model.addGeometryObject(item)

    def _overhang(self, joint: int) -> float:
        """Return by how much held bodies stick out beyond the arm's own tip [m]."""
        items = list(self._model.geometryObjects)
        own = len(self.robot.geometry.geometryObjects)
        far = [0.0]
        for item in items[own:]:
            if item.parentJoint == joint:
                center = item.placement.act(item.geometry.aabb_center)
                far.append(float(np.linalg.norm(center)) + item.geometry.aabb_radius)
        return max(0.0, max(far) - float(self.robot.reach[-1]))

    def _add_pairs(self, scene: PlanningScene) -> None:
        """Add the pairs of robot, obstacles and held bodies; the robot's own pairs follow its SRDF."""
        robot = self.robot.description
        for name in set(scene.names) & set(self.robot.links):
            raise InvalidRequestError(f"body '{name}' has the name of a robot link; give it another")
        gripper = set(robot.gripper.links)
        allowed = _Allowed(scene.allowed, set(self.robot.links), gripper, set(scene.names))
        touch = {held.body.name: set(held.touch_links or gripper) for held in scene.attached}
        for name, links in touch.items():
            for link in links - set(self.robot.links):
                raise InvalidRequestError(
                    f"attached '{name}': no touch link '{link}'; {one_of(self.robot.links, link)}"
                )
        items = list(self._model.geometryObjects)
        names = [self._names[item.name] for item in items]
        fixed = [item.parentJoint == _WORLD_JOINT for item in items]
        for i in range(len(self.robot.geometry.geometryObjects), len(items)):
            spared = touch.get(names[i], set()) | set(touch) if names[i] in touch else set()
            for j in range(i):
                if not (fixed[i] and fixed[j]) and names[j] not in spared and not allowed(names[i], names[j]):
                    self._model.addCollisionPair(pin.CollisionPair(j, i))
        for pair in list(self.robot.geometry.collisionPairs) if scene.allowed else ():
            if allowed(names[pair.first], names[pair.second]):
                self._model.removeCollisionPair(pair)

    def is_free(self, joints: npt.ArrayLike) -> bool:
        """Tell whether an arm configuration touches nothing."""
        return self._free(self.robot.full(joints, self.scene.gripper_opening))

    def _free(self, q: Array) -> bool:
        return not pin.computeCollisions(self.robot.model, self._scratch, self._broad, q, True)

    def contacts(self, joints: npt.ArrayLike) -> tuple[ContactPair, ...]:
        """Return every pair that touches at an arm configuration, deepest first, one per pair of names."""
        q = self.robot.full(joints, self.scene.gripper_opening)
        pin.computeCollisions(self.robot.model, self._scratch, self._model, self._data, q, False)
        deepest: dict[tuple[str, str], ContactPair] = {}
        for k, pair in enumerate(self._model.collisionPairs):
            if not self._data.collisionResults[k].isCollision():
                continue
            pin.computeDistance(self._model, self._data, k)
            result = self._data.distanceResults[k]
            names = tuple(self._names[self._model.geometryObjects[i].name] for i in (pair.first, pair.second))
            x, y, z = self._base.act(0.5 * (result.getNearestPoint1() + result.getNearestPoint2()))
            found = ContactPair(
                body_a=names[0], body_b=names[1], depth=max(0.0, self.padding - result.min_distance),
                position=(float(x), float(y), float(z)),
            )  # fmt: skip
            if names not in deepest or found.depth > deepest[names].depth:
                deepest[names] = found
        return tuple(sorted(deepest.values(), key=lambda c: (-c.depth, c.body_a, c.body_b)))

    def first_collision(self, path: Array) -> int:
        """Return the index of the first colliding configuration of a dense path of shape (N, dof), or -1."""
        for i, q in enumerate(self.robot.full(path, self.scene.gripper_opening)):
            if not self._free(q):
                return i
        return -1

    def path_is_free(self, path: Array) -> bool:
        """Tell whether a dense path of shape (N, dof) is free; looks at far-apart states first."""
        q = self.robot.full(path, self.scene.gripper_opening)
        return all(self._free(q[i]) for i in _spread_order(len(q)))

    def edge_is_free(self, start: Array, end: Array, step: float) -> bool:
        """Tell whether the straight joint-space edge is free, excluding its start.

        Args:
            start: Arm configuration, known to be free.
            end: Arm configuration.
            step: Largest motion of any point of the arm between two checks [m].
        """
        return self.path_is_free(self.densify(np.stack([start, end]), step)[0][1:])

    def densify(self, path: Array, step: float) -> tuple[Array, npt.NDArray[np.intp]]:
        """Fill a path so that no point of the arm moves by more than ``step`` [m] between neighbours.

        Args:
            path: Arm configurations, shape (N, dof).
            step: Bound on the motion of the arm's points [m].

        Returns:
            Arm configurations, shape (M, dof), and for each the index of the last point of ``path`` up to it.
        """
        deltas = np.diff(path, axis=0)
        parts = np.maximum(1, np.ceil(np.abs(deltas) @ self.reach / step)).astype(int)
        owner = np.repeat(np.arange(len(parts)), parts)
        within = np.arange(len(owner)) - np.repeat(np.cumsum(parts) - parts, parts)
        filled = path[owner] + deltas[owner] * (within / parts[owner])[:, None]
        return np.concatenate([filled, path[-1:]]), np.append(owner, len(path) - 1)


class _Allowed:
    """Answers whether two named bodies may touch."""

    def __init__(self, pairs: Iterable[AllowedContact], links: set[str], gripper: set[str], bodies: set[str]) -> None:
        groups: dict[str, set[str]] = {ROBOT: links, GRIPPER: gripper, "": links | bodies}

        def expand(name: str) -> set[str]:
            if name not in groups and name not in groups[""]:
                names = one_of((*groups[""], ROBOT, GRIPPER), name)
                raise InvalidRequestError(f"allowed contact of an unknown body '{name}'; {names}")
            return groups.get(name, {name})

        self._pairs = [(expand(pair.body_a), expand(pair.body_b)) for pair in pairs]

    def __call__(self, a: str, b: str) -> bool:
        return any((a in x and b in y) or (b in x and a in y) for x, y in self._pairs)


def _spread_order(count: int) -> Sequence[int]:
    """Order 0..count-1 so that any prefix is spread evenly: the last, the middle, the quarters, ..."""
    order = _ORDERS.get(count)
    if order is None:
        bits = max(1, (count - 1).bit_length())
        reverse = (int(f"{i:0{bits}b}"[::-1], 2) for i in range(1 << bits))
        order = [count - 1 - i for i in reverse if i < count]
        if len(_ORDERS) < 4096:
            _ORDERS[count] = order
    return order


_ORDERS: dict[int, Sequence[int]] = {}
