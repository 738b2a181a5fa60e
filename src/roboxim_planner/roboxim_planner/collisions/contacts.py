"""Contacts and their penetration by coal, for error messages and as a check independent of the native kernel."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import coal
import numpy as np
import numpy.typing as npt
import pinocchio as pin

from roboxim_core.errors import InvalidRequestError, one_of
from roboxim_core.poses import Vec3
from roboxim_planner.collisions.geometry import convex_hull, make_shape
from roboxim_planner.robot import PlannerRobot, se3
from roboxim_planner.scene import GRIPPER, ROBOT, AllowedContact, Body, BodyShape, PlanningScene, TriangleMesh

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
    """Penetration, positive [m]; with padding, the missing distance."""
    apart_m: float
    """Distance between the two [m]; 0: they touch."""
    position: Vec3
    """A point of the contact in the world [m]."""

    def __str__(self) -> str:
        """Format the pair for an error message."""
        if self.apart_m >= 5e-5:
            needed = self.apart_m + self.depth
            apart = f"{1000.0 * self.apart_m:.1f} mm apart, {1000.0 * needed:.1f} mm needed"
            return f"{self.body_a} and {self.body_b} are {apart}"
        if self.depth < 5e-5:
            return f"{self.body_a} and {self.body_b} touch"
        return f"{self.body_a} and {self.body_b} overlap by {1000.0 * self.depth:.1f} mm"


class ContactRules:
    """Rules for which named bodies of a scene are checked against each other."""

    def __init__(self, robot: PlannerRobot, scene: PlanningScene) -> None:
        """Read the scene's rules.

        Args:
            robot: The robot.
            scene: The scene, for its names, held bodies and allowed contacts.

        Raises:
            InvalidRequestError: On a body with a link's name, or an unknown name in an allowed contact or touch link.
        """
        links = set(robot.links)
        for name in set(scene.names) & links:
            raise InvalidRequestError(f"body '{name}' has the name of a robot link; give it another")
        gripper = set(robot.description.gripper.links)
        self._touch = {held.body.name: set(held.touch_links or gripper) for held in scene.attached}
        for name, touched in self._touch.items():
            for link in touched - links:
                raise InvalidRequestError(f"attached '{name}': no touch link '{link}'; {one_of(robot.links, link)}")
        self._known: dict[tuple[str, str], bool] = {}
        self._allowed = list(_expand(scene.allowed, links, gripper, set(scene.names)))

    def checks(self, a: str, b: str) -> bool:
        """Return whether two bodies are checked; pairs of robot links also follow the SRDF."""
        if not self._touch and not self._allowed:
            return True
        known = self._known.get((a, b))
        if known is None:
            known = self._known[a, b] = self._decide(a, b)
        return known

    def _decide(self, a: str, b: str) -> bool:
        if a in self._touch and (b in self._touch or b in self._touch[a]):
            return False
        if b in self._touch and a in self._touch[b]:
            return False
        return not any((a in x and b in y) or (b in x and a in y) for x, y in self._allowed)


class ContactModel:
    """The robot among the bodies of one scene in coal: a geometry model with explicit pairs. Not thread-safe."""

    def __init__(self, robot: PlannerRobot, scene: PlanningScene, rules: ContactRules) -> None:
        """Build the geometry of a scene.

        Args:
            robot: The robot.
            scene: The bodies around it.
            rules: Which pairs are checked.

        Raises:
            InvalidRequestError: On a hull without volume.
        """
        self._robot = robot
        self._scene = scene
        self._base = se3(scene.robot_pose)
        self._names = list(robot.item_links)
        self._model = robot.geometry.copy()
        own = len(self._names)
        to_base = self._base.inverse()
        for body in scene.bodies:
            self._add(body, _WORLD_JOINT, to_base * se3(body.pose), make_shape)
        tcp = robot.model.frames[robot.tcp_frame]
        for held in scene.attached:
            self._add(held.body, tcp.parentJoint, tcp.placement * se3(held.body.pose), held_shape)
        fixed = [item.parentJoint == _WORLD_JOINT for item in self._model.geometryObjects]
        for i in range(own, len(self._names)):
            for j in (*range(robot.whole_shapes), *range(own, i)):
                if not (fixed[i] and fixed[j]) and rules.checks(self._names[j], self._names[i]):
                    self._model.addCollisionPair(pin.CollisionPair(j, i))
        for pair in list(robot.geometry.collisionPairs) if scene.allowed else ():
            if not rules.checks(self._names[pair.first], self._names[pair.second]):
                self._model.removeCollisionPair(pair)
        flat = {i for i, item in enumerate(self._model.geometryObjects) if _is_flat_mesh(item.geometry)}
        self._flat = [k for k, p in enumerate(self._model.collisionPairs) if {p.first, p.second} & flat]
        """Pairs with a flat mesh: coal's `collide` misses their contacts, its `distance` does not."""
        self._data = self._model.createData()

    def _add(
        self, body: Body, joint: int, placement: pin.SE3, make: Callable[[BodyShape], coal.CollisionGeometry]
    ) -> None:
        for i, shape in enumerate(body.shapes):
            item = pin.GeometryObject(f"{body.name}#{i}", joint, 0, placement * se3(shape.pose), make(shape))
            self._names.append(body.name)
            self._model.addGeometryObject(item)

    def _distance(self, pair: int) -> float:
        pin.computeDistance(self._model, self._data, pair)
        return float(self._data.distanceResults[pair].min_distance)

    def is_free(self, joints: Array) -> bool:
        """Return whether an arm configuration of shape (dof,) touches nothing."""
        q = self._robot.full(joints, self._scene.gripper_opening)
        if pin.computeCollisions(self._robot.model, self._robot.scratch, self._model, self._data, q, True):
            return False
        return all(self._distance(pair) > 0.0 for pair in self._flat)

    def contacts(self, joints: Array, padding: float, within: float) -> tuple[ContactPair, ...]:
        """Return every pair that touches at an arm configuration, deepest first, one per pair of names.

        Args:
            joints: Arm configuration, shape (dof,) [rad].
            padding: Distance from obstacles below which they count as touching [m].
            within: Distance, beyond the padding, up to which a pair counts as touching [m].
        """
        q = self._robot.full(joints, self._scene.gripper_opening)
        pin.updateGeometryPlacements(self._robot.model, self._robot.scratch, self._model, self._data, q)
        deepest: dict[tuple[str, str], ContactPair] = {}
        own = len(self._robot.geometry.geometryObjects)
        for k, pair in enumerate(self._model.collisionPairs):
            allowed = padding if max(pair.first, pair.second) >= own else 0.0
            if self._distance(k) > allowed + within:
                continue
            result = self._data.distanceResults[k]
            names = self._names[pair.first], self._names[pair.second]
            x, y, z = self._base.act(0.5 * (result.getNearestPoint1() + result.getNearestPoint2()))
            found = ContactPair(
                body_a=names[0], body_b=names[1], depth=max(0.0, allowed - result.min_distance),
                apart_m=max(0.0, result.min_distance), position=(float(x), float(y), float(z)),
            )  # fmt: skip
            if names not in deepest or found.depth > deepest[names].depth:
                deepest[names] = found
        return tuple(sorted(deepest.values(), key=lambda c: (-c.depth, c.body_a, c.body_b)))


def _is_flat_mesh(shape: coal.CollisionGeometry) -> bool:
    if not isinstance(shape, coal.BVHModelBase):
        return False
    box = shape.aabb_local
    return float(min(box.width(), box.height(), box.depth())) < 1e-6


def held_shape(shape: BodyShape) -> coal.CollisionGeometry:
    """Return the collision shape of a held shape: a mesh becomes its convex hull."""
    if not isinstance(shape, TriangleMesh):
        return make_shape(shape)
    made = coal.Convex(convex_hull(shape.vertices))
    made.computeLocalAABB()
    return made


def _expand(
    pairs: Iterable[AllowedContact], links: set[str], gripper: set[str], bodies: set[str]
) -> Iterator[tuple[set[str], set[str]]]:
    groups: dict[str, set[str]] = {ROBOT: links, GRIPPER: gripper, "": links | bodies}

    def members(name: str) -> set[str]:
        if name not in groups and name not in groups[""]:
            names = one_of((*groups[""], ROBOT, GRIPPER), name)
            raise InvalidRequestError(f"allowed contact of an unknown body '{name}'; {names}")
        return groups.get(name, {name})

    for pair in pairs:
        yield members(pair.body_a), members(pair.body_b)
