"""Referee for timed motions: checks the original collision meshes at a kilohertz, without planner code.

Meshes, allowed pairs and limits come from ``_machines.py``, not from this repository's robots. Coal checks collisions
of the triangles. Triangles alone miss a finger that is completely inside a link, so it also checks the convex hulls
where links fill them (Panda); other arms cannot get there without crossing triangles, at most 3 mm a sample.

The referee skips only samples that cannot collide, so it is fast and exact: if the convex hulls of the meshes keep a
distance d, every later sample is free as long as no point of the arm has moved by d.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import coal
import numpy as np
import numpy.typing as npt
import pinocchio as pin
from benchmarks.planner._machines import FINGERS_M, HAND, PACKAGES, Machine, geometry_of, machine, model_of

Array = npt.NDArray[np.float64]
PERIOD_S = 0.001
GOAL_M, GOAL_RAD, GOAL_JOINT_RAD = 1e-3, 1e-2, 1e-3
START_RAD = 1e-4
SLACK = 1.001
"""Finite differences of a motion never exceed the maximum of its derivative, so the tolerance covers rounding only."""
MARGINS_M = (0.03, 0.01, 0.003)


@dataclass(frozen=True, kw_only=True)
class Solid:
    """A primitive with its pose in the robot's base, or in the tcp frame when held."""

    kind: str
    """``box``, ``cylinder`` or ``sphere``."""
    size: tuple[float, ...]
    """Box: x, y, z; cylinder: radius, length (along z); sphere: radius [m]."""
    position: tuple[float, float, float]
    """[m]."""
    quat_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    """Orientation."""

    @property
    def placement(self) -> pin.SE3:
        """Its pose."""
        return pin.XYZQUATToSE3(np.array([*self.position, *self.quat_xyzw]))

    def shape(self) -> coal.ShapeBase:
        """Return the solid as a coal shape.

        Raises:
            ValueError: On an unknown kind.
        """
        makers = {"box": coal.Box, "cylinder": coal.Cylinder, "sphere": coal.Sphere}
        if self.kind not in makers:
            raise ValueError(f"a solid is one of {', '.join(makers)}, got '{self.kind}'")
        shape = makers[self.kind](*self.size)
        shape.computeLocalAABB()
        return shape


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The referee's findings about a motion."""

    faults: tuple[str, ...] = ()
    """Reasons why it is invalid: a collision, a wrong start or goal, a joint out of range, no rest at the ends."""
    violations: tuple[str, ...] = ()
    """Violated limits of velocity, acceleration or jerk, with the ratio to the limit."""

    @property
    def clean(self) -> bool:
        """Whether the motion has neither problems nor violations."""
        return not self.faults and not self.violations

    def __str__(self) -> str:
        """Return the findings as one line."""
        return "; ".join((*self.faults, *self.violations)) or "valid"


class Referee:
    """Referee for the robot among solids. The fingers are fully open."""

    def __init__(
        self, solids: tuple[Solid, ...] | list[Solid], held: Solid | None = None, robot: str = "panda"
    ) -> None:
        """Build the scene."""
        self.solids, self.held, self.machine = tuple(solids), held, machine(robot)
        self._model, meshes, hulls, self._tcp = _robot(robot)
        self._data = self._model.createData()
        self._exact = _Checker(self.machine, self._populate(meshes.copy()), 0.0)
        self._hulls = self._populate(hulls.copy())
        self._guards: dict[float, _Checker] = {}
        self._reach = _reach(self.machine, self._hulls)

    def _populate(self, geometry: pin.GeometryModel) -> pin.GeometryModel:
        own = len(geometry.geometryObjects)
        names = [item.name for item in geometry.geometryObjects]
        base = [i for i, item in enumerate(geometry.geometryObjects) if item.parentJoint == 0]
        for i, solid in enumerate(self.solids):
            index = geometry.addGeometryObject(pin.GeometryObject(f"#{i}", 0, 0, solid.placement, solid.shape()))
            for other in set(range(own)) - set(base):
                geometry.addCollisionPair(pin.CollisionPair(other, index))
        if self.held is not None:
            frame = self._model.frames[self._tcp]
            placement = frame.placement * self.held.placement
            item = pin.GeometryObject("held", frame.parentJoint, 0, placement, self.held.shape())
            index = geometry.addGeometryObject(item)
            for other in (*range(own), *range(own, own + len(self.solids))):
                if other >= own or not names[other].startswith(HAND):
                    geometry.addCollisionPair(pin.CollisionPair(other, index))
        return geometry

    def collides(self, joints: Array) -> bool:
        """Return whether an arm configuration of shape (dof,) collides, on the original meshes."""
        return self._exact.hit(joints) or (self.machine.convex and not self.keeps(joints, 0.0))

    def folds(self, joints: Array) -> bool:
        """Return whether the visual meshes of hand and forearm come within 5 mm; Panda's SRDF disables that pair."""
        return self.machine.name == "panda" and _folding().hit(joints)

    def keeps(self, joints: Array, distance: float) -> bool:
        """Return whether the hulls of all checked pairs are farther apart than a distance [m]; no false positives."""
        if distance not in self._guards:
            self._guards[distance] = _Checker(self.machine, self._hulls, distance)
        return not self._guards[distance].hit(joints)

    def first_collision(self, path: Array) -> int:
        """Return the index of the first colliding configuration of a path of shape (N, dof), or -1."""
        i, level = 0, 0
        while i < len(path):
            while level < len(MARGINS_M) and not self.keeps(path[i], MARGINS_M[level]):
                level += 1
            if level < len(MARGINS_M):
                moved = np.abs(path[i + 1 : i + 400] - path[i]) @ self._reach
                beyond = np.flatnonzero(moved > 0.98 * MARGINS_M[level])
                i += 1 + (int(beyond[0]) if len(beyond) else len(moved))
            elif self.collides(path[i]):
                return i
            else:
                i += 1
            level = max(0, level - 1)
        return -1

    def edge_collides(self, start: Array, end: Array) -> bool:
        """Return whether the straight joint line collides, checked every 2 mm of the arm's motion."""
        count = max(2, int(np.abs(end - start) @ self._reach / 0.002) + 1)
        path = start + np.linspace(0.0, 1.0, count)[:, None] * (end - start)
        return any(self.collides(q) for q in path[:: max(1, count // 16)]) or self.first_collision(path) >= 0

    def tcp(self, joints: Array) -> pin.SE3:
        """Return the tcp's pose in the frame of the base."""
        pin.forwardKinematics(self._model, self._data, self.machine.full(joints))
        return pin.updateFramePlacement(self._model, self._data, self._tcp).copy()

    def judge(self, positions: Array, duration_s: float, start: Array, goal: pin.SE3 | Array) -> Verdict:
        """Judge a motion.

        Args:
            positions: Samples at 0, 1, 2, ... ms and at the end, shape (N, dof) [rad].
            duration_s: Time of the last sample [s].
            start: Required start configuration [rad].
            goal: Required tcp pose, or arm configuration [rad], at the end.
        """
        if positions.ndim != 2 or positions.shape[1] != self.machine.dof or not np.isfinite(positions).all():
            return Verdict(faults=(f"positions of shape {positions.shape} or not finite",))
        expected = int(np.ceil(duration_s / PERIOD_S - 1e-6)) + 1
        if abs(len(positions) - expected) > 1:
            return Verdict(faults=(f"{len(positions)} samples in {duration_s:.4f} s, not one per millisecond",))
        faults = list(self._ends(positions, start, goal))
        lower, upper = self.machine.lower, self.machine.upper
        if (positions < lower - 1e-6).any() or (positions > upper + 1e-6).any():
            beyond = max(float((lower - positions).max()), float((positions - upper).max()))
            faults.append(f"joint range left by {beyond:.2g} rad")
        hit = self.first_collision(positions)
        if hit >= 0:
            pairs = ", ".join(self._exact.pairs(positions[hit]))
            faults.append(f"collision at {hit * PERIOD_S:.3f} s ({pairs})")
        return Verdict(faults=tuple(faults), violations=_broken_limits(self.machine, positions))

    def _ends(self, positions: Array, start: Array, goal: pin.SE3 | Array) -> list[str]:
        found = []
        if np.abs(positions[0] - start).max() > START_RAD:
            found.append(f"start off by {np.abs(positions[0] - start).max():.2g} rad")
        if isinstance(goal, pin.SE3):
            end = self.tcp(positions[-1])
            off_m = float(np.linalg.norm(end.translation - goal.translation))
            off_rad = float(np.linalg.norm(pin.log3(end.rotation.T @ goal.rotation)))
            if off_m > GOAL_M or off_rad > GOAL_RAD:
                found.append(f"goal off by {1e3 * off_m:.2g} mm, {off_rad:.2g} rad")
        elif np.abs(positions[-1] - goal).max() > GOAL_JOINT_RAD:
            found.append(f"goal off by {np.abs(positions[-1] - goal).max():.2g} rad")
        for where, step in (("start", positions[1:2] - positions[:1]), ("end", positions[-1:] - positions[-2:-1])):
            if (np.abs(step) > 1.1 * self.machine.acceleration * PERIOD_S**2).any():
                found.append(f"no rest at the {where}")
        return found


def _broken_limits(arm: Machine, positions: Array) -> tuple[str, ...]:
    """Return the violated limits; rest is assumed before and after the motion."""
    rest = np.concatenate([np.repeat(positions[:1], 3, axis=0), positions[:-1]])
    found = []
    rate = rest
    limits = {"velocity": arm.velocity, "acceleration": arm.acceleration, "jerk": arm.jerk}
    for order, (name, limit) in enumerate(limits.items(), 1):
        rate = np.diff(rate, axis=0) / PERIOD_S
        noise = 2.0**order * 4e-16 * np.pi / PERIOD_S**order
        ratio = (np.abs(rate) - noise) / limit
        if len(rate) and ratio.max() > SLACK:
            joint = int(ratio.max(axis=0).argmax()) + 1
            found.append(f"{name} of joint {joint} x{ratio.max():.3f}")
    return tuple(found)


class _Checker:
    """Collision checks of one geometry with one margin."""

    def __init__(self, arm: Machine, geometry: pin.GeometryModel, margin: float) -> None:
        self._machine, self._model, self._geometry = arm, model_of(arm.name), geometry
        model = self._model
        self._data, self._geometry_data = model.createData(), geometry.createData()
        for request in self._geometry_data.collisionRequests:
            request.security_margin = margin
        self._broad = pin.BroadPhaseManager_DynamicAABBTreeCollisionManager(model, geometry, self._geometry_data)

    def hit(self, joints: Array) -> bool:
        return bool(pin.computeCollisions(self._model, self._data, self._broad, self._machine.full(joints), True))

    def pairs(self, joints: Array) -> list[str]:
        full = self._machine.full(joints)
        pin.computeCollisions(self._model, self._data, self._geometry, self._geometry_data, full, False)
        names = [item.name.removesuffix("_0") for item in self._geometry.geometryObjects]
        touching = zip(self._geometry.collisionPairs, self._geometry_data.collisionResults, strict=True)
        return [f"{names[p.first]}-{names[p.second]}" for p, result in touching if result.isCollision()]


@cache
def _robot(name: str) -> tuple[pin.Model, pin.GeometryModel, pin.GeometryModel, int]:
    """Return the model, its collision meshes, their convex hulls, and the frame of the tcp."""
    model, meshes, hulls = model_of(name), geometry_of(name), geometry_of(name)
    for item in hulls.geometryObjects:
        if isinstance(item.geometry, coal.BVHModelBase):
            item.geometry.buildConvexHull(True, "Qt")
            item.geometry = item.geometry.convex
            item.meshScale = np.ones(3)
        item.geometry.computeLocalAABB()
    return model, meshes, hulls, model.getFrameId("panda_hand_tcp")


@cache
def _folding() -> _Checker:
    """Return a checker of the visual meshes of hand and forearm."""
    arm = machine("panda")
    drawn = pin.buildGeomFromUrdf(model_of("panda"), str(arm.urdf), pin.GeometryType.VISUAL, package_dirs=PACKAGES)
    pair = (drawn.getGeometryId(name) for name in ("panda_link5_0", "panda_hand_0"))
    drawn.addCollisionPair(pin.CollisionPair(*pair))
    return _Checker(arm, drawn, 0.005)


def _reach(arm: Machine, geometry: pin.GeometryModel) -> Array:
    """Bound the distance of the arm's and the held solids' points from each joint's axis, shape (dof,) [m]."""
    model = model_of(arm.name)
    reach = np.zeros(model.njoints)
    for item in geometry.geometryObjects:
        center = item.placement.act(item.geometry.aabb_center)
        far = float(np.linalg.norm(center)) + item.geometry.aabb_radius
        reach[item.parentJoint] = max(reach[item.parentJoint], far)
    for i in range(model.njoints - 1, 0, -1):
        travel = FINGERS_M if i > arm.dof else 0.0
        offset = float(np.linalg.norm(model.jointPlacements[i].translation)) + travel
        reach[model.parents[i]] = max(reach[model.parents[i]], reach[i] + offset)
    return np.asarray(reach[1 : arm.dof + 1])
