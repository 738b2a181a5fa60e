"""Grasps of a solid for a parallel gripper: antipodal pairs of points, each proven by a floating hand.

A pair of surface points is antipodal if the line between them lies in both friction cones (Nguyen, "Constructing
force-closure grasps", IJRR 1988).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from roboxim_core.models.description import GraspAnnotation, ObjectModel
from roboxim_core.poses import Array, Pose
from roboxim_runs.assets.floating_hand import BLOCKED, CLEARANCE_M, Floating, FloatingHand, lowest_tip, try_grasp
from roboxim_runs.assets.solids import surface_points
from roboxim_sim.bullet import BulletClient, bullet_client

SAMPLES = 1500
"""Surface points among which pairs are sought."""
CONE_RAD = math.atan(0.3)
"""Half angle of the friction cone that a pair must keep to: of a friction well below the fingers' [rad]."""
SPARE_M = 0.008
"""Least part of the gripper's stroke that stays free [m]."""
ROOMS_M = (0.022, 0.012)
"""Openings before a grasp beyond the width of what is grasped: wide if the shape leaves room for it [m]."""
MAX_BLOCKED = 400
"""Number of candidates with a colliding open hand at which the search ends; these cost little."""
STEEP = math.cos(math.radians(45))
"""Least share of its closing direction that is level: fingers do not fit under an object."""
TILTS_RAD = tuple(math.radians(angle) for angle in (0, 30, -30, 60, -60))
"""Turns of the approach about the closing direction, from straight down [rad]."""
SLIDE_M = 0.008
"""How far up its approach a grasp may be moved to keep off the table: half a fingertip's pad [m]."""
YAW_RAD, PLACE_M = math.radians(30), 0.02
"""Grasps whose closing directions and positions differ by less belong to one family [rad, m]."""


@dataclass(frozen=True, kw_only=True)
class Search:
    """What a search for grasps found."""

    grasps: tuple[GraspAnnotation, ...]
    """Proven grasps, best first."""
    tried: int
    """Candidates on which the floating hand closed."""
    pairs: int
    """Antipodal pairs that fit the gripper."""
    failures: tuple[str, ...] = ()
    """Why each other candidate failed."""


def find_grasps(
    mesh: trimesh.Trimesh,
    model: ObjectModel,
    *,
    max_opening_m: float,
    enough: int,
    tries: int,
    make: Callable[[BulletClient, Pose, float], Floating] = FloatingHand,
    on_try: Callable[[int], None] = lambda _: None,
) -> Search:
    """Find grasps of an object that stands on a table.

    Args:
        mesh: Its surface in the base frame [m].
        model: The object, without grasps.
        max_opening_m: Opening of the gripper [m].
        enough: Number of proven grasps at which the search ends.
        tries: Most candidates that are tried.
        make: Makes the floating gripper, see `try_grasp`.
        on_try: Called with the number of candidates tried so far.
    """
    pairs = antipodal_pairs(mesh, max_opening_m - SPARE_M)
    found: list[GraspAnnotation] = []
    failures: list[str] = []
    closed = 0
    with bullet_client() as client:
        for candidate in _candidates(pairs, model):
            if len(found) >= enough or closed >= tries or len(failures) - closed >= MAX_BLOCKED:
                break
            if _like_one_of(candidate, found):
                continue
            for room in ROOMS_M:
                opening = min(max_opening_m, candidate.width_m + room)
                grasp = replace(candidate, opening_m=round(opening, 4))
                reason = try_grasp(client, model, grasp, make)
                if not reason.startswith(BLOCKED):
                    break
            if not reason:
                found.append(grasp)
            else:
                failures.append(reason)
            closed += not reason.startswith(BLOCKED)
            on_try(closed)
    return Search(grasps=tuple(found), tried=closed, pairs=len(pairs), failures=tuple(failures))


def antipodal_pairs(mesh: trimesh.Trimesh, widest_m: float) -> Array:
    """Return pairs of surface points between which a gripper holds, the most central and best opposed first.

    Args:
        mesh: The surface [m].
        widest_m: Largest distance of a pair [m].

    Returns:
        Shape (N, 2, 3) [m].
    """
    points, normals = surface_points(mesh, SAMPLES)
    way = points[None] - points[:, None]  # from i to j
    length = np.linalg.norm(way, axis=2)
    with np.errstate(invalid="ignore", divide="ignore"):
        unit = way / length[..., None]
    opposed = np.minimum(-np.einsum("ijk,ik->ij", unit, normals), np.einsum("ijk,jk->ij", unit, normals))
    level = np.hypot(unit[..., 0], unit[..., 1])
    first, second = np.nonzero(
        (opposed > math.cos(CONE_RAD)) & (length > 0.002) & (length < widest_m) & (level > STEEP)
    )
    once = first < second
    first, second = first[once], second[once]
    middle = (points[first] + points[second]) / 2
    center = mesh.center_mass if mesh.is_volume else mesh.bounds.mean(axis=0)
    off = np.linalg.norm((middle - center)[:, :2], axis=1) / np.linalg.norm(mesh.extents[:2])
    order = np.argsort(off + (1.0 - opposed[first, second]) + 0.5 * (1.0 - level[first, second]), kind="stable")
    return np.stack([points[first[order]], points[second[order]]], axis=1)


def _candidates(pairs: Array, model: ObjectModel) -> Iterator[GraspAnnotation]:
    """Yield grasps for pairs: families first, straight down before tilted, then the other pairs of a family."""
    seen: dict[tuple[int, ...], int] = {}
    ranked = []
    for rank, (one, other) in enumerate(pairs):
        middle, closing = (one + other) / 2, other - one
        yaw = math.atan2(closing[1], closing[0]) % math.pi
        family = (round(yaw / YAW_RAD), *np.round(middle / PLACE_M).astype(int).tolist())
        seen[family] = seen.get(family, 0) + 1
        if seen[family] <= 3:
            ranked.append((seen[family], rank))
    for turn in TILTS_RAD:
        for _, rank in sorted(ranked):
            grasp = _grasp(pairs[rank], turn, model)
            if grasp is not None:
                yield grasp


def _grasp(pair: Array, tilt_rad: float, model: ObjectModel) -> GraspAnnotation | None:
    """Return the grasp of a pair at a tilt; none if the fingertips would touch the table."""
    middle, width = pair.mean(axis=0), float(np.linalg.norm(pair[1] - pair[0]))
    y = (pair[1] - pair[0]) / width
    down = np.array([0.0, 0.0, -1.0])
    z = down - (down @ y) * y
    z /= np.linalg.norm(z)
    z = Rotation.from_rotvec(tilt_rad * y).apply(z)
    x = np.cross(y, z)
    axes = np.stack([x, y, z], axis=1)
    lack = CLEARANCE_M - model.rest_height - lowest_tip(middle, axes)
    if lack > 0:
        if z[2] > -0.2 or lack / -z[2] > SLIDE_M:
            return None
        middle = middle - z * lack / -z[2]
    pose = Pose.from_arrays(middle, Rotation.from_matrix(axes))
    name = "top" if tilt_rad == 0 else "side" if abs(tilt_rad) > math.radians(45) else "tilted"
    return GraspAnnotation(name=name, pose=pose, width_m=round(width, 4))


def _like_one_of(grasp: GraspAnnotation, found: list[GraspAnnotation]) -> bool:
    """Tell whether a proven grasp is almost the same."""
    for other in found:
        near = np.linalg.norm(np.subtract(grasp.pose.position, other.pose.position)) < PLACE_M
        turn = (other.pose.rotation.inv() * grasp.pose.rotation).magnitude()
        half = (other.pose.rotation.inv() * grasp.pose.rotation * Rotation.from_euler("z", math.pi)).magnitude()
        if near and min(turn, half) < YAW_RAD:
            return True
    return False
