"""Bounding boxes of collision shapes."""

from __future__ import annotations

import numpy as np

from roboxim_core.models.articulation import link_poses
from roboxim_core.models.description import JointModel, LinkModel, Shape
from roboxim_core.models.hulls import hull_vertices
from roboxim_core.poses import IDENTITY, Array, Pose


def shape_bounds(shape: Shape, pose: Pose = IDENTITY) -> Array:
    """Return the lowest and highest corner of a convex shape, shape (2, 3) [m].

    Args:
        shape: Any but a ring.
        pose: Pose of its link in the frame of the result.

    Raises:
        ConfigError: When a hull's mesh cannot be read.
    """
    placed = pose @ shape.pose
    if shape.kind == "hull":
        points = placed.apply(hull_vertices(shape.mesh) * shape.scale)
        return np.stack([points.min(axis=0), points.max(axis=0)])
    axes = placed.rotation.as_matrix()
    if shape.kind == "box":
        reach = np.abs(axes) @ (np.asarray(shape.size) / 2)
    elif shape.kind == "sphere":
        reach = np.full(3, shape.size[0])
    else:
        radius, length = shape.size
        along = np.abs(axes[:, 2])
        round_part = np.ones(3) if shape.kind == "capsule" else np.sqrt(np.maximum(1.0 - along**2, 0.0))
        reach = along * length / 2 + radius * round_part
    return np.asarray(np.asarray(placed.position) + np.stack([-reach, reach]))


def links_bounds(links: tuple[LinkModel, ...], joints: tuple[JointModel, ...]) -> Array:
    """Return the lowest and highest corner of all links in the base's frame with all joints at 0, shape (2, 3) [m].

    Raises:
        ValueError: When no link has a collision shape.
        ConfigError: When a hull's mesh cannot be read.
    """
    poses = link_poses(links[0].name, joints, {})
    corners = np.array([shape_bounds(shape, poses[link.name]) for link in links for shape in link.collision])
    if not len(corners):
        raise ValueError("no link has a collision shape")
    return np.stack([corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)])
