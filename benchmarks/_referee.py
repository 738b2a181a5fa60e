"""Judges motions of the Panda without any of the planner's code: the original collision meshes, at a kilohertz.

Meshes come from the ``example-robot-data`` wheel, not from this tree; collisions are coal's on the triangles.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cmeel
import coal
import numpy as np
import numpy.typing as npt
import pinocchio as pin

Array = npt.NDArray[np.float64]
SOURCE = Path(cmeel.__path__[0]).parent / "cmeel.prefix/share/example-robot-data/robots/panda_description"
LOWER = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
UPPER = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
VELOCITY = np.array([2.175] * 4 + [2.61] * 3)
ACCELERATION = np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0])
JERK = 500.0 * ACCELERATION
HAND = ("panda_hand_0", "panda_leftfinger", "panda_rightfinger")


@dataclass(frozen=True)
class Box:
    """A box with its pose in the world, or in the tcp frame when held."""

    size: tuple[float, float, float]
    position: tuple[float, float, float]
    yaw: float = 0.0

    @property
    def placement(self) -> pin.SE3:
        """Its pose."""
        return pin.SE3(pin.utils.rotate("z", self.yaw), np.array(self.position))


class Referee:
    """The robot among boxes. The fingers are fully open."""

    def __init__(self, boxes: list[Box], held: Box | None = None) -> None:
        """Build the scene."""
        self._model, geometry, self._tcp = _robot()
        self._geometry = geometry.copy()
        own = len(geometry.geometryObjects)
        for i, box in enumerate(boxes):
            self._add(f"box{i}", 0, box.placement, box, range(1, own))
        if held is not None:
            frame = self._model.frames[self._tcp]
            free = [i for i in range(own) if not geometry.geometryObjects[i].name.startswith(HAND)]
            placement = frame.placement * held.placement
            self._add("held", frame.parentJoint, placement, held, [*free, *range(own, own + len(boxes))])
        self._data = self._model.createData()
        self._geometry_data = self._geometry.createData()
        self._broad = pin.BroadPhaseManager_DynamicAABBTreeCollisionManager(
            self._model, self._geometry, self._geometry_data
        )

    def _add(self, name: str, joint: int, placement: pin.SE3, box: Box, others: range | list[int]) -> None:
        shape = coal.Box(*box.size)
        shape.computeLocalAABB()
        index = self._geometry.addGeometryObject(pin.GeometryObject(name, joint, 0, placement, shape))
        for other in others:
            self._geometry.addCollisionPair(pin.CollisionPair(other, index))

    def collides(self, joints: Array) -> bool:
        """Tell whether an arm configuration of shape (7,) touches anything."""
        q = np.concatenate([joints, [0.04, 0.04]])
        return bool(pin.computeCollisions(self._model, self._data, self._broad, q, True))

    def edge_collides(self, start: Array, end: Array, step: float = 0.02) -> bool:
        """Tell whether the straight joint line touches anything."""
        count = max(2, int(np.abs(end - start).max() / step) + 1)
        return any(self.collides(start + s * (end - start)) for s in np.linspace(0.0, 1.0, count))

    def tcp(self, joints: Array) -> pin.SE3:
        """Return the tcp in the world."""
        pin.forwardKinematics(self._model, self._data, np.concatenate([joints, [0.04, 0.04]]))
        return pin.updateFramePlacement(self._model, self._data, self._tcp).copy()

    def faults(self, times: Array, positions: Array, start: Array, goal: pin.SE3) -> list[str]:
        """Return what is wrong with a trajectory sampled at a kilohertz; derivatives are taken from the positions."""
        found = []
        if np.abs(positions[0] - start).max() > 1e-4:
            found.append("start")
        off = self.tcp(positions[-1])
        if np.linalg.norm(off.translation - goal.translation) > 1e-3:
            found.append("goal position")
        if np.linalg.norm(pin.log3(off.rotation.T @ goal.rotation)) > 1e-2:
            found.append("goal rotation")
        if (positions < LOWER - 1e-6).any() or (positions > UPPER + 1e-6).any():
            found.append("joint limit")
        step = times[1] - times[0]
        rate = positions[:-1]  # the last sample may be nearer than a period
        for name, limit, slack in (
            ("velocity", VELOCITY, 1.01),
            ("acceleration", ACCELERATION, 1.02),
            ("jerk", JERK, 1.05),
        ):
            rate = np.diff(rate, axis=0) / step
            if len(rate) and (np.abs(rate) > slack * limit).any():
                found.append(f"{name} x{(np.abs(rate) / limit).max():.2f}")
        if any(self.collides(q) for q in positions):
            found.append("collision")
        return found


_CACHE: list[tuple[pin.Model, pin.GeometryModel, int]] = []


def _robot() -> tuple[pin.Model, pin.GeometryModel, int]:
    if not _CACHE:
        urdf = SOURCE / "urdf/panda.urdf"
        model = pin.buildModelFromUrdf(str(urdf))
        geometry = pin.buildGeomFromUrdf(
            model, str(urdf), pin.GeometryType.COLLISION, package_dirs=[str(SOURCE.parents[2])]
        )
        geometry.addAllCollisionPairs()
        pin.removeCollisionPairs(model, geometry, str(SOURCE / "srdf/panda.srdf"))
        _CACHE.append((model, geometry, model.getFrameId("panda_hand_tcp")))
    return _CACHE[0]
