"""The planning scene: an immutable snapshot of the obstacles of a motion; it belongs to one request.

It consists of robot-neutral plain values, built from a simulated scene and its state, from inline primitives, or from
both. Attached objects and allowed contacts are part of it, so the planner keeps no state between requests.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from roboxim_core.errors import InvalidRequestError, one_of
from roboxim_core.models.articulation import object_link_poses
from roboxim_core.models.description import ObjectModel, Shape
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import IDENTITY, Pose, Vec3
from roboxim_core.specs import SceneSpec
from roboxim_core.state import StateRecord
from roboxim_core.surroundings import Surroundings

TABLE = "table"
ROBOT = "robot"
GRIPPER = "gripper"
_SIZES = {"box": 3, "sphere": 1, "cylinder": 2, "capsule": 2, "hull": 0}


@dataclass(frozen=True, kw_only=True)
class PointHull:
    """The convex hull of points, for geometry that comes in a request instead of a file."""

    points: tuple[Vec3, ...]
    """At least 4 points that span a volume [m]."""
    pose: Pose = IDENTITY
    """Pose in the object."""


@dataclass(frozen=True, kw_only=True)
class TriangleMesh:
    """A surface of triangles, convex or not, open or closed. A shape wholly inside a closed one does not touch it."""

    vertices: tuple[Vec3, ...]
    """Vertices, at least 3 [m]."""
    triangles: tuple[tuple[int, int, int], ...]
    """Indices of each triangle's vertices."""
    pose: Pose = IDENTITY
    """Pose in the object."""

    def __post_init__(self) -> None:
        """Check numbers and indices.

        Raises:
            InvalidRequestError: On a vertex that is not finite or a triangle of vertices that do not exist.
        """
        if not self.triangles or not all(0 <= k < len(self.vertices) for corner in self.triangles for k in corner):
            raise InvalidRequestError(
                f"a mesh needs triangles of its own vertices 0..{len(self.vertices) - 1}, got {len(self.triangles)}"
            )
        if not all(math.isfinite(value) for vertex in self.vertices for value in vertex):
            raise InvalidRequestError("a mesh's vertices must be finite")


BodyShape = Shape | PointHull | TriangleMesh
"""Any part of a body."""


@dataclass(frozen=True, kw_only=True)
class Body:
    """A rigid body made of parts."""

    name: str
    """Unique name in the scene."""
    shapes: tuple[BodyShape, ...]
    """Its parts."""
    pose: Pose = IDENTITY
    """Pose in the world, or in the TCP frame when attached."""

    def __post_init__(self) -> None:
        """Check name and sizes.

        Raises:
            InvalidRequestError: On a bad name, no shape, or a bad size; the message names the body.
        """
        if not self.name or self.name in (ROBOT, GRIPPER, "world"):
            raise InvalidRequestError(f"a body needs a name other than robot, gripper and world, got '{self.name}'")
        if not self.shapes:
            raise InvalidRequestError(f"body '{self.name}' has no shape")
        for shape in self.shapes:
            if not isinstance(shape, Shape):
                continue
            if shape.kind not in _SIZES:
                raise InvalidRequestError(f"body '{self.name}': unknown shape; {one_of(_SIZES, shape.kind)}")
            if len(shape.size) != _SIZES[shape.kind] or not all(0.0 < value < 100.0 for value in shape.size):
                raise InvalidRequestError(
                    f"body '{self.name}': a {shape.kind} has {_SIZES[shape.kind]} sizes between 0 and 100 m, "
                    f"got {shape.size}"
                )


@dataclass(frozen=True, kw_only=True)
class Attached:
    """A body that the gripper holds."""

    body: Body
    """The body; its pose is in the TCP frame."""
    touch_links: tuple[str, ...] = ()
    """Robot links that may touch it; empty: the gripper's links."""


@dataclass(frozen=True, kw_only=True)
class AllowedContact:
    """A pair that may touch. Each side is a link or body by name, ``robot`` or ``gripper``."""

    body_a: str
    """First of the pair."""
    body_b: str = ""
    """Second of the pair; empty: any."""

    def __post_init__(self) -> None:
        """Check the names.

        Raises:
            InvalidRequestError: If the first is empty, which would switch every check off.
        """
        if not self.body_a:
            raise InvalidRequestError(
                f"an allowed contact needs body_a, a link, a body, {ROBOT} or {GRIPPER}; only body_b may be empty"
            )


@dataclass(frozen=True, kw_only=True)
class PlanningScene:
    """An immutable snapshot of the bodies around a robot."""

    robot: str = ""
    """Model id of the simulated robot; empty if the scene is not a simulated one."""
    robot_pose: Pose = IDENTITY
    """Pose of the robot's base in the world."""
    gripper_opening: float = 1.0
    """Opening of the gripper, 1 = open, 0 = closed."""
    bodies: tuple[Body, ...] = ()
    """Obstacles, poses in the world."""
    attached: tuple[Attached, ...] = ()
    """Bodies that the gripper holds."""
    allowed: tuple[AllowedContact, ...] = ()
    """Pairs that may touch."""
    joint_command: tuple[float, ...] = ()
    """Joint command of the controller in this revision [rad]; empty if the scene is not a simulated one."""
    pose_tcp: Pose | None = None
    """Measured TCP in the world in this revision; none if the scene is not a simulated one."""

    def __post_init__(self) -> None:
        """Check names and the opening.

        Raises:
            InvalidRequestError: On a duplicate name, an opening outside 0..1, or a contact of unknown bodies.
        """
        names = [body.name for body in self.bodies] + [held.body.name for held in self.attached]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise InvalidRequestError(f"names of bodies must be unique, got {', '.join(twice)} more than once")
        if not 0.0 <= self.gripper_opening <= 1.0:
            raise InvalidRequestError(f"gripper_opening must be 0..1, got {self.gripper_opening}")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all bodies, attached ones last."""
        return tuple(body.name for body in self.bodies) + tuple(held.body.name for held in self.attached)

    def with_bodies(self, bodies: Iterable[Body]) -> PlanningScene:
        """Return the scene with further bodies."""
        return replace(self, bodies=(*self.bodies, *bodies))

    def without(self, names: Iterable[str]) -> PlanningScene:
        """Return the scene without some bodies.

        Raises:
            InvalidRequestError: If there is no body with such a name.
        """
        gone = set(names)
        for name in gone - {body.name for body in self.bodies}:
            raise InvalidRequestError(f"no body '{name}' in the scene; {one_of(self.names, name)}")
        return replace(self, bodies=tuple(body for body in self.bodies if body.name not in gone))

    def attach(self, name: str, pose_tcp: Pose, touch_links: Sequence[str] = ()) -> PlanningScene:
        """Return the scene with a body attached to the gripper at its present pose.

        Args:
            name: Name of the body.
            pose_tcp: The TCP in the world now.
            touch_links: Robot links that may touch it; empty: the gripper's.

        Raises:
            InvalidRequestError: When there is no such body.
        """
        rest = self.without([name])
        body = next(body for body in self.bodies if body.name == name)
        held = replace(body, pose=pose_tcp.inverse() @ body.pose)
        return replace(rest, attached=(*self.attached, Attached(body=held, touch_links=tuple(touch_links))))

    def holding(self, held: Attached) -> PlanningScene:
        """Return the scene with one more body held by the gripper."""
        return replace(self, attached=(*self.attached, held))

    def release(self, name: str, pose_tcp: Pose) -> PlanningScene:
        """Return the scene with a held body released at its present pose; the inverse of `attach`.

        Args:
            name: Name of the body.
            pose_tcp: The TCP in the world now.

        Raises:
            InvalidRequestError: If the gripper holds no such body.
        """
        names = [held.body.name for held in self.attached]
        if name not in names:
            raise InvalidRequestError(f"the gripper does not hold '{name}'; {one_of(names, name)}")
        body = self.attached[names.index(name)].body
        freed = replace(body, pose=pose_tcp @ body.pose)
        rest = tuple(held for held in self.attached if held.body.name != name)
        return replace(self, bodies=(*self.bodies, freed), attached=rest)

    def with_contacts(self, allowed: Iterable[AllowedContact]) -> PlanningScene:
        """Return the scene with more pairs that may touch."""
        return replace(self, allowed=(*self.allowed, *allowed))

    def with_opening(self, gripper_opening: float) -> PlanningScene:
        """Return the scene with another opening of the gripper, 1 = open."""
        return replace(self, gripper_opening=gripper_opening)

    @staticmethod
    def from_state(spec: SceneSpec, state: StateRecord, library: ModelLibrary) -> PlanningScene:
        """Build the snapshot of a simulated scene at one tick.

        Args:
            spec: The scene.
            state: The state of the tick, which has all poses.
            library: Source of the geometry.

        Raises:
            ConfigError: If an entity names a model that the library does not have.
        """
        bodies = [table_body(spec)]
        for entity in spec.entities:
            model = library.entity_model(entity)
            placed = state.entity(entity.name)
            joints = dict(zip(placed.joint_names, placed.joint_positions, strict=True))
            shapes = model_shapes(model, joints)
            if shapes:
                bodies.append(Body(name=entity.name, shapes=shapes, pose=placed.pose))
        return PlanningScene(
            robot=spec.robot.model,
            robot_pose=spec.robot.pose,
            gripper_opening=min(1.0, max(0.0, state.robot.gripper_opening)),
            bodies=tuple(bodies),
            joint_command=state.robot.joint_commands,
            pose_tcp=state.robot.pose_tcp_measured,
        )


class SceneMaker:
    """Makes the scenes of motions. Many motions have the same surroundings, so the last snapshot is kept."""

    def __init__(self, library: ModelLibrary) -> None:
        """Take the geometry of a library."""
        self._library = library
        self._last: tuple[tuple[object, ...], PlanningScene] | None = None

    def scene(self, around: Surroundings) -> PlanningScene:
        """Return the robot's surroundings, with the held body in the gripper.

        Raises:
            ConfigError: If an entity names a model that the library does not have.
        """
        scene = self._snapshot(around)
        if around.held:
            body = next(body for body in scene.bodies if body.name == around.held)
            scene = scene.without([around.held]).holding(Attached(body=replace(body, pose=around.held_in_tcp)))
        allowed = tuple(AllowedContact(body_a=a, body_b=b) for a, b in around.touching)
        return replace(scene, gripper_opening=around.opening, allowed=allowed)

    def _snapshot(self, around: Surroundings) -> PlanningScene:
        key = (around.scene, around.state, around.moved)
        if self._last is None or any(before is not now for before, now in zip(self._last[0], key, strict=True)):
            self._last = key, PlanningScene.from_state(around.scene, around.state_then, self._library)
        return self._last[1]


def table_body(spec: SceneSpec) -> Body:
    """Return the table of a scene, its top at ``center``."""
    x, y, z = spec.table.center
    size = spec.table.size
    return Body(name=TABLE, shapes=(Shape(kind="box", size=size),), pose=Pose(position=(x, y, z - size[2] / 2.0)))


def box(name: str, size: Vec3, pose: Pose = IDENTITY) -> Body:
    """Return a box-shaped body with extents ``size`` [m]."""
    return Body(name=name, shapes=(Shape(kind="box", size=size),), pose=pose)


def model_shapes(model: ObjectModel, positions: dict[str, float]) -> tuple[Shape, ...]:
    """Return the collision shapes of all links of a model in the frame of its base.

    Args:
        model: The object.
        positions: Joint name to position [m or rad]; missing joints are at 0.
    """
    return tuple(
        replace(shape, pose=pose @ shape.pose)
        for name, pose in object_link_poses(model, positions).items()
        for link in model.links
        if link.name == name
        for shape in link.collision
    )
