"""Placing objects on the table: footprints, gaps, bounds."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from roboxim_core.errors import ConfigError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Array, Pose
from roboxim_core.specs import EntitySpec, PhysicalObject, SceneSpec
from roboxim_tasks.choices import Choice, VectorChoice
from roboxim_tasks.rejection import RejectedError

if TYPE_CHECKING:
    from roboxim_tasks.components.base import ResetContext

TRIES_PER_OBJECT = 50


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
            ConfigError: On an area that is not of x and y, or a negative gap.
        """
        self.area.require_size(2, "area")
        if self.gap_m < 0:
            raise ConfigError(f"gap_m must be >= 0, got {self.gap_m:g}")


def place(
    scene: SceneSpec, thing: PhysicalObject, config: PlacementConfig, context: ResetContext, component: str
) -> SceneSpec:
    """Return the scene with one more object, apart from all others and wholly on the table.

    Raises:
        RejectedError: When none of a number of draws has room; names what refused most of them.
    """
    rng, index = context.rng(component), context.index
    model = context.library.object(thing.model, thing.modifiers)
    refused: dict[str, int] = {}
    for _ in range(TRIES_PER_OBJECT):
        x, y = config.area.draw(rng, index)
        yaw = config.yaw_rad.draw_number(rng, index)
        pose = scene.robot.pose @ Pose.from_arrays((x, y, 0.0), Rotation.from_euler("z", yaw))
        height = scene.table.center[2] + model.rest_height
        entity = EntitySpec(
            name=thing.entity,
            model=thing.model,
            modifiers=thing.modifiers,
            pose=Pose(position=(*pose.position[:2], height), quat_xyzw=pose.quat_xyzw),
            fixed=bool(model.joints),
        )
        reason = refusal(scene, entity, config.gap_m, context.library)
        if not reason:
            return with_entity(scene, entity)
        refused[reason] = refused.get(reason, 0) + 1
    raise RejectedError(f"{thing.entity}_{max(refused, key=lambda key: refused[key])}")


def with_entity(scene: SceneSpec, entity: EntitySpec) -> SceneSpec:
    """Return the scene with one more entity at its end."""
    return replace(scene, entities=(*scene.entities, entity))


def refusal(scene: SceneSpec, entity: EntitySpec, gap_m: float, library: ModelLibrary) -> str:
    """Return why an entity cannot be where it is: ``off_table``, ``overlaps``, or nothing."""
    corners = footprint(entity, library)
    half = np.array(scene.table.size[:2]) / 2
    if np.any(np.abs(corners - np.array(scene.table.center[:2])) > half):
        return "off_table"
    grown = footprint(entity, library, grow_m=gap_m)
    if any(overlap(grown, footprint(other, library)) for other in scene.entities):
        return "overlaps"
    return ""


def footprint(entity: EntitySpec, library: ModelLibrary, grow_m: float = 0.0) -> Array:
    """Return the corners of an object's bounding rectangle on the table in the world, in order, shape (4, 2) [m].

    Args:
        entity: The object; it stands upright or lies toppled, at any yaw.
        library: Where its size comes from.
        grow_m: Margin on every side [m].
    """
    model = library.entity_model(entity)
    width, depth, height = model.size
    sides = ((-width / 2, width / 2), (-depth / 2, depth / 2), (-model.rest_height, height - model.rest_height))
    corners = entity.pose.apply(list(itertools.product(*sides)))[:, :2]
    axes = entity.pose.rotation.as_matrix().T
    along = next(axis[:2] / np.linalg.norm(axis[:2]) for axis in axes if abs(axis[2]) < 0.8)
    frame = np.array([along, [-along[1], along[0]]])
    (a, b), (c, d) = (corners @ frame.T).min(axis=0) - grow_m, (corners @ frame.T).max(axis=0) + grow_m
    return np.asarray(np.array([(c, d), (a, d), (a, b), (c, b)]) @ frame, dtype=float)


def overlap(first: Array, second: Array) -> bool:
    """Tell whether two rectangles of shape (4, 2) overlap, by the separating axis theorem."""
    for axis in (first[1] - first[0], first[2] - first[1], second[1] - second[0], second[2] - second[1]):
        a, b = first @ axis, second @ axis
        if a.max() <= b.min() or b.max() <= a.min():
            return False
    return True
