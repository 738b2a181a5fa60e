"""Pairs of links that self-collision checks leave out, found by sampling: the SRDF of a robot."""

from __future__ import annotations

import itertools
from collections import Counter
from pathlib import Path

import numpy as np
import pinocchio as pin

SAMPLES = 10_000
OFTEN = 0.95
"""Fraction of the samples from which a pair counts as always in contact."""


def srdf_text(name: str, urdf: Path, *, together: frozenset[str] = frozenset(), samples: int = SAMPLES) -> str:
    """Return an SRDF that disables adjacent links, and pairs that touch in no or almost every sampled state.

    Args:
        name: Name of the robot.
        urdf: Its URDF; meshes are ``package://NAME/...`` beside its folder.
        together: Links of the gripper, whose mechanism keeps them off each other.
        samples: Number of states, uniform within the joint limits.
    """
    model = pin.buildModelFromUrdf(str(urdf))
    geometry = pin.buildGeomFromUrdf(model, str(urdf), pin.GeometryType.COLLISION, package_dirs=[str(urdf.parents[1])])
    geometry.addAllCollisionPairs()
    for pair in list(geometry.collisionPairs):
        links = {model.frames[geometry.geometryObjects[k].parentFrame].name for k in (pair.first, pair.second)}
        if together.issuperset(links):
            geometry.removeCollisionPair(pair)
    data, placed = model.createData(), geometry.createData()
    items = geometry.geometryObjects
    link = [model.frames[item.parentFrame].name for item in items]
    for item in items:
        item.geometry.computeLocalAABB()
    centers, radii = (
        [item.geometry.aabb_center for item in items],
        np.array([item.geometry.aabb_radius for item in items]),
    )
    first, second = np.array([(pair.first, pair.second) for pair in geometry.collisionPairs]).T
    hits: Counter[tuple[str, str]] = Counter()
    rng = np.random.default_rng(0)
    for q in rng.uniform(model.lowerPositionLimit, model.upperPositionLimit, (samples, model.nq)):
        pin.forwardKinematics(model, data, q)
        pin.updateGeometryPlacements(model, data, geometry, placed)
        at = np.array([placed.oMg[k].act(center) for k, center in enumerate(centers)])
        near = np.linalg.norm(at[first] - at[second], axis=1) <= radii[first] + radii[second]
        hits.update(
            {
                _pair(link[first[k]], link[second[k]])
                for k in np.flatnonzero(near).tolist()
                if pin.computeCollision(geometry, placed, k)
            }
        )
    adjacent = _adjacent(model, set(link))
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', f'<robot name="{name}">']
    for pair in itertools.combinations(sorted(set(link)), 2):
        reason = ""
        if pair in adjacent:
            reason = "Adjacent"
        elif together.issuperset(pair):
            reason = "User"
        elif hits[pair] == 0:
            reason = "Never"
        elif hits[pair] >= OFTEN * samples:
            reason = "Default"
        if reason:
            lines.append(f'    <disable_collisions link1="{pair[0]}" link2="{pair[1]}" reason="{reason}"/>')
    return "\n".join([*lines, "</robot>", ""])


def _pair(first: str, second: str) -> tuple[str, str]:
    return (first, second) if first < second else (second, first)


def _adjacent(model: pin.Model, links: set[str]) -> set[tuple[str, str]]:
    """Return the pairs of links with geometry that a joint or a mount connects."""
    found = set()
    for frame in model.frames:
        if frame.type != pin.FrameType.BODY or frame.name not in links:
            continue
        above = model.frames[frame.parentFrame]
        while above.name not in links and above.name != "universe":
            above = model.frames[above.parentFrame]
        if above.name in links:
            found.add(_pair(frame.name, above.name))
    return found
