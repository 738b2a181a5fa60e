"""Placement of objects on the table: footprints, gaps, bounds."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from roboxim_core.errors import ConfigError
from roboxim_core.models.articulation import object_link_poses
from roboxim_core.models.bounds import shape_bounds
from roboxim_core.models.description import ObjectModel
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Array, Pose
from roboxim_core.specs import EntitySpec, PhysicalObject, Scalar, SceneSpec
from roboxim_tasks.choices import Choice, VectorChoice
from roboxim_tasks.sampling.rejection import RejectedError

if TYPE_CHECKING:
    from roboxim_tasks.components.base import ResetContext

TRIES_PER_OBJECT = 50
TRIES_PER_POSITION = 10
"""Draws after which an ordered list of positions advances, because another object occupies the position at any yaw."""


@dataclass(frozen=True, kw_only=True)
class PlacementConfig:
    """Where objects lie."""

    area: VectorChoice = VectorChoice(lower=(0.40, -0.15), upper=(0.60, 0.15))
    """Position of the object's base on the table, in the robot's base frame [m]."""
    yaw_rad: Choice = Choice(lower=-np.pi, upper=np.pi)
    """Rotation about the vertical [rad]."""
    gap_m: float = 0.04
    """Free space between objects, so that a finger fits in between [m]."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: When the area is not given by x and y, the yaw is no number, or the gap is negative.
        """
        self.area.require_size(2, "area")
        self.yaw_rad.require_numbers("yaw_rad")
        if self.gap_m < 0:
            raise ConfigError(f"gap_m must be >= 0, got {self.gap_m:g}")


@dataclass(frozen=True, kw_only=True)
class Demand:
    """Requirements of an object's place in addition to the distance from other objects."""

    name: str = ""
    """Name for messages, e.g. ``beside_target``."""
    holds: Callable[[EntitySpec], bool] = lambda entity: True
    """Return whether an object at its pose meets the demand."""
    position: Callable[[np.random.Generator], Array] | None = None
    """Draw a position on the table in the robot's base frame, shape (2,) [m]; none: from the whole area."""
    leaves: Callable[[SceneSpec], str] = lambda scene: ""
    """Return the first constraint for which a scene with the object leaves no room, or an empty text; called last."""
    gaps: Mapping[str, float] = field(default_factory=dict)
    """Entity to the free space between it and the object, where it differs from the usual one [m]."""


def place(
    scene: SceneSpec,
    thing: PhysicalObject,
    config: PlacementConfig,
    context: ResetContext,
    component: str,
    demand: Demand | None = None,
) -> SceneSpec:
    """Return the scene with one more object, apart from all others and wholly on the table.

    Raises:
        RejectedError: When none of several draws has room; names the constraint that refused most of them.
    """
    rng, index = context.rng(component), context.index
    model = context.library.object(thing.model, thing.modifiers)
    room = Room.of(scene, context.library, config.gap_m, demand.gaps if demand else {})
    refused: dict[str, int] = {}
    for attempt in range(TRIES_PER_OBJECT * (2 if demand else 1)):
        step = attempt // TRIES_PER_POSITION
        x, y = demand.position(rng) if demand and demand.position else config.area.draw(rng, index + step)
        yaw = config.yaw_rad.draw_number(rng, index)
        pose = scene.robot.pose @ turned((x, y, 0.0), yaw)
        height = scene.table.center[2] + model.rest_height
        entity = EntitySpec(
            name=thing.entity,
            model=thing.model,
            modifiers=thing.modifiers,
            pose=Pose(position=(*pose.position[:2], height), quat_xyzw=pose.quat_xyzw),
            fixed=bool(model.joints),
        )
        unmet = demand.name if demand and not demand.holds(entity) else ""
        reason = unmet or room.refusal(entity)
        there = with_entity(scene, entity)
        if not reason and demand:
            reason = demand.leaves(there)
        if not reason:
            context.record(f"{thing.entity}.position", config.area, (x, y))
            return there
        refused[reason] = refused.get(reason, 0) + 1
    raise RejectedError(f"{thing.entity}_{max(refused, key=lambda key: refused[key])}")


def turned(position: tuple[float, float, float], yaw_rad: float) -> Pose:
    """Return a pose that is turned about the vertical."""
    return Pose(position=position, quat_xyzw=(0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2)))


def with_entity(scene: SceneSpec, entity: EntitySpec) -> SceneSpec:
    """Return the scene with one more entity at its end."""
    return replace(scene, entities=(*scene.entities, entity))


@dataclass(frozen=True, kw_only=True)
class Room:
    """Free space on the table of a scene."""

    library: ModelLibrary
    """Library of the objects' sizes."""
    table: tuple[Array, Array]
    """Middle and half extent of the table's top, each of shape (2,) [m]."""
    others: tuple[tuple[Array, float], ...]
    """Footprint of each present object, and of the arm's stand, with the gap that it requires [m]."""

    @staticmethod
    def of(scene: SceneSpec, library: ModelLibrary, gap_m: float, gaps: Mapping[str, float] | None = None) -> Room:
        """Return the free space that a scene leaves.

        Args:
            scene: The scene.
            library: Library of the objects' sizes.
            gap_m: Free space around the new object [m].
            gaps: Entity to the free space between it and the new object, where it differs from ``gap_m`` [m].
        """
        others = [(footprint(e, library), (gaps or {}).get(e.name, gap_m)) for e in scene.entities]
        if stand := library.robot(scene.robot.model).stand:
            x, y, far, left = stand
            corners = scene.robot.pose.apply([(far, left, 0.0), (x, left, 0.0), (x, y, 0.0), (far, y, 0.0)])
            others.append((corners[:, :2], gap_m))
        return Room(
            library=library,
            table=(np.array(scene.table.center[:2]), np.array(scene.table.size[:2]) / 2),
            others=tuple(others),
        )

    def refusal(self, entity: EntitySpec) -> str:
        """Return why an entity's pose is invalid: ``off_table``, ``overlaps``, or an empty text if it is valid."""
        corners = footprint(entity, self.library)
        middle, half = self.table
        if np.any(np.abs(corners - middle) > half):
            return "off_table"
        if any(overlap(grown(corners, gap_m), other) for other, gap_m in self.others):
            return "overlaps"
        return ""


def refusal(scene: SceneSpec, entity: EntitySpec, gap_m: float, library: ModelLibrary) -> str:
    """Return why an entity's pose in a scene is invalid; use `Room` to check many poses in one scene."""
    return Room.of(scene, library, gap_m).refusal(entity)


def centre(entity: EntitySpec, library: ModelLibrary) -> Array:
    """Return the middle of an object's box in the world, shape (3,) [m]."""
    model = library.entity_model(entity)
    return entity.pose.apply((0.0, 0.0, model.size[2] / 2 - model.rest_height))


def nearest_distance(entity: EntitySpec, point: Array, library: ModelLibrary) -> float:
    """Return the distance from a point of the world to the nearest point of an object's collision shapes [m]."""
    modifiers, joints = tuple(sorted(entity.modifiers.items())), tuple(sorted(entity.joint_positions.items()))
    return _surface(library, entity.model, modifiers, joints).distance(entity.pose.inverse().apply(point))


class _Surface:
    """The collision shapes of an object, evaluated at once. A hull counts as the box around it."""

    def __init__(self, model: ObjectModel, joint_positions: dict[str, float]) -> None:
        links = object_link_poses(model, joint_positions)
        shapes = [(links[link.name] @ shape.pose, shape) for link in model.links for shape in link.collision]
        self._rotations = np.stack([pose.quaternion.matrix() for pose, _ in shapes])
        self._origins = np.array([pose.position for pose, _ in shapes])
        kinds = np.array([shape.kind for _, shape in shapes])
        self._boxed, self._flat = np.isin(kinds, ("box", "hull")), kinds == "cylinder"
        bounds = [shape_bounds(replace(shape, pose=Pose())) for _, shape in shapes]
        self._low, self._high = np.stack(bounds, axis=1)
        self._radius = np.array(
            [0.0 if boxed else s.size[0] for boxed, (_, s) in zip(self._boxed, shapes, strict=True)]
        )
        self._half = np.array([shape.size[-1] / 2 if len(shape.size) > 1 else 0.0 for _, shape in shapes])

    def distance(self, point: Array) -> float:
        """Return the distance from a point of shape (3,) in the object's frame [m]; 0 inside."""
        local = np.einsum("nji,nj->ni", self._rotations, point - self._origins)
        outside = np.maximum(np.maximum(self._low - local, local - self._high), 0.0)
        across, along = np.hypot(local[:, 0], local[:, 1]), np.maximum(np.abs(local[:, 2]) - self._half, 0.0)
        flat = np.hypot(np.maximum(across - self._radius, 0.0), along)
        round_ = np.maximum(np.hypot(across, along) - self._radius, 0.0)
        distances = np.where(self._boxed, np.linalg.norm(outside, axis=1), np.where(self._flat, flat, round_))
        return float(distances.min())


@lru_cache(maxsize=256)
def _surface(
    library: ModelLibrary, model: str, modifiers: tuple[tuple[str, Scalar], ...], joints: tuple[tuple[str, float], ...]
) -> _Surface:
    return _Surface(library.object(model, dict(modifiers)), dict(joints))


def footprint(entity: EntitySpec, library: ModelLibrary) -> Array:
    """Return the corners of an object's bounding rectangle on the table in the world, in order, shape (4, 2) [m].

    Args:
        entity: The object, upright or toppled, at any yaw.
        library: Library of the objects' sizes.
    """
    model = library.entity_model(entity)
    width, depth, height = model.size
    sides = ((-width / 2, width / 2), (-depth / 2, depth / 2), (-model.rest_height, height - model.rest_height))
    corners = entity.pose.apply(list(itertools.product(*sides)))[:, :2]
    axes = entity.pose.quaternion.matrix().T
    along = next(axis[:2] / math.hypot(*axis[:2]) for axis in axes if abs(axis[2]) < 0.8)
    frame = np.array([along, [-along[1], along[0]]])
    (a, b), (c, d) = (corners @ frame.T).min(axis=0), (corners @ frame.T).max(axis=0)
    return np.asarray(np.array([(c, d), (a, d), (a, b), (c, b)]) @ frame, dtype=float)


def grown(rectangle: Array, margin_m: float) -> Array:
    """Return a rectangle of shape (4, 2), as `footprint` orders it, with a margin on every side [m]."""
    along, across = rectangle[0] - rectangle[1], rectangle[1] - rectangle[2]
    a, b = margin_m * along / math.hypot(*along), margin_m * across / math.hypot(*across)
    return np.asarray(rectangle + np.array([a + b, b - a, -a - b, a - b]))


def overlap(first: Array, second: Array) -> bool:
    """Return whether two rectangles of shape (4, 2) overlap, by the separating axis theorem."""
    for axis in (first[1] - first[0], first[2] - first[1], second[1] - second[0], second[2] - second[1]):
        a, b = first @ axis, second @ axis
        if a.max() <= b.min() or b.max() <= a.min():
            return False
    return True
