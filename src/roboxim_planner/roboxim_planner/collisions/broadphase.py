"""Coal's broad phases: moving shapes by link, built once per robot, and resting bodies, built once per scene.

Pinocchio's own broad phase needs one geometry model with every pair; creating its data takes longer than planning.
Here the moving and the resting shapes have separate trees of boxes, and a check tests one tree against another. A
`LinkGroup` owns its geometry model, data and tree together: adding geometry to the model would invalidate the others.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import coal
import numpy as np
import numpy.typing as npt
import pinocchio as pin

Array = npt.NDArray[np.float64]
Placed = tuple[coal.CollisionGeometry, Array]
"""A shape and its pose in the robot's base, shape (4, 4)."""


class LinkGroup:
    """Shapes that move with the joints of a robot, and the pairs among them that are checked."""

    def __init__(
        self, model: pin.Model, items: Iterable[pin.GeometryObject], pairs: Iterable[tuple[int, int]] = ()
    ) -> None:
        """Build the tree.

        Args:
            model: The robot.
            items: The shapes.
            pairs: Pairs of shapes that may not touch, by index.
        """
        self._model = model
        self._geometry = pin.GeometryModel()
        for item in items:
            self._geometry.addGeometryObject(item)
        for a, b in pairs:
            self._geometry.addCollisionPair(pin.CollisionPair(a, b))
        self._data = self._geometry.createData()
        self._broad = pin.BroadPhaseManager_DynamicAABBTreeCollisionManager(model, self._geometry, self._data)
        self._tree = self._broad.getManager()
        self._callback = coal.CollisionCallBackDefault()

    def place(self, data: pin.Data) -> None:
        """Move the shapes to where the joints of ``data`` are."""
        pin.updateGeometryPlacements(self._model, data, self._geometry, self._data)
        self._broad.update(False)

    def is_apart_at(self, data: pin.Data, configuration: Array) -> bool:
        """Tell whether no pair of the group touches at a full configuration; leaves the joints' poses in ``data``."""
        return not pin.computeCollisions(self._model, data, self._broad, configuration, True)

    def is_apart_from(self, other: LinkGroup | BodyGroup) -> bool:
        """Tell whether the group touches no shape of another group, both where they were last placed."""
        self._callback.init()
        self._tree.collide(other.tree, self._callback)
        if self._callback.data.result.isCollision():
            return False
        flat = other.flat_tree
        if flat is None:
            return True
        nearest = coal.DistanceCallBackDefault()
        self._tree.distance(flat, nearest)
        return float(nearest.data.result.min_distance) > 0.0

    @property
    def tree(self) -> coal.DynamicAABBTreeCollisionManager:
        """Tree of the group's shapes."""
        return self._tree

    @property
    def flat_tree(self) -> None:
        """Always None: links have no flat meshes; see `BodyGroup.flat_tree`."""
        return None


class BodyGroup:
    """Resting shapes."""

    def __init__(self, placed: Sequence[Placed]) -> None:
        """Build the trees.

        Args:
            placed: The shapes with their poses in the robot's base.
        """
        self._objects = [
            coal.CollisionObject(shape, coal.Transform3s(pose[:3, :3], pose[:3, 3])) for shape, pose in placed
        ]
        flat = [item for item, (shape, _) in zip(self._objects, placed, strict=True) if _is_flat_mesh(shape)]
        self.tree = _tree([item for item in self._objects if item not in flat] if flat else self._objects)
        self.flat_tree = _tree(flat) if flat else None
        """Tree of the flat meshes: coal's `collide` misses them, its `distance` does not. None: there are none."""


def _tree(items: list[coal.CollisionObject]) -> coal.DynamicAABBTreeCollisionManager:
    tree = coal.DynamicAABBTreeCollisionManager()
    for item in items:
        tree.registerObject(item)
    tree.setup()
    return tree


def _is_flat_mesh(shape: coal.CollisionGeometry) -> bool:
    if not isinstance(shape, coal.BVHModelBase):
        return False
    box = shape.aabb_local
    return float(min(box.width(), box.height(), box.depth())) < 1e-6
