"""The poses in which an object comes to rest on a table, found by dropping it many times."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from roboxim_core.models.description import ObjectModel
from roboxim_core.poses import Array, Pose
from roboxim_core.specs import EntitySpec, TableSpec
from roboxim_sim.bodies import ObjectBody, build_table, configure
from roboxim_sim.bullet import BulletClient, bullet_client

DROPS = 40
"""Number of drops from random orientations."""
SECONDS = 2.5
"""Time after which an object has come to rest or rolls [s]."""
STILL = (0.01, 0.1)
"""Speeds below which an object is at rest [m/s, rad/s]."""
SAME_RAD = math.radians(8)
"""Poses whose vertical axes differ by less count as the same pose [rad]."""


@dataclass(frozen=True, kw_only=True)
class RestPose:
    """A pose in which an object comes to rest."""

    pose: Pose
    """Pose of the base above a surface at z = 0, at x = y = 0; any yaw."""
    share: float
    """Share of the drops that ended in it."""

    @property
    def tilt_rad(self) -> float:
        """Angle between the base's z axis and the vertical [rad]."""
        return float(np.arccos(np.clip(self.pose.rotation.as_matrix()[2, 2], -1.0, 1.0)))


def rest_poses(model: ObjectModel, drops: int = DROPS) -> list[RestPose]:
    """Drop an object from random orientations; return the poses in which it lies still, the most frequent first.

    Args:
        model: The object; its pose on the table need not be stable.
        drops: Number of drops; the upright orientation is one of them.
    """
    turns = Rotation.random(drops - 1, random_state=np.random.default_rng(0))
    ends: list[Pose] = []
    with bullet_client() as client:
        for turn in (Rotation.identity(), *turns):
            if (end := _drop(client, model, turn)) is not None:
                ends.append(end)
    groups: list[list[Pose]] = []
    for end in ends:
        group = next((group for group in groups if _between(_up(group[0]), _up(end)) < SAME_RAD), None)
        if group is None:
            groups.append([end])
        else:
            group.append(end)
    groups.sort(key=len, reverse=True)
    return [RestPose(pose=_without_yaw(group[0]), share=len(group) / drops) for group in groups]


def _drop(client: BulletClient, model: ObjectModel, turn: Rotation) -> Pose | None:
    """Return where an object lies after a drop from 1 cm above the table; none if it still moves or fell off."""
    configure(client, 240.0)
    build_table(client, TableSpec())
    start = Pose.from_arrays((0.5, 0.0, 1.0), turn)
    body = ObjectBody(client, model, EntitySpec(name="it", model=model.id, pose=start))
    lowest = client.getAABB(body.id, -1)[0][2]
    client.resetBasePositionAndOrientation(
        body.id, [0.5, 0.0, client.getBasePositionAndOrientation(body.id)[0][2] - lowest + 0.01],
        client.getBasePositionAndOrientation(body.id)[1],
    )  # fmt: skip
    for _ in range(round(240 * SECONDS)):
        client.stepSimulation()
    linear, angular = client.getBaseVelocity(body.id)
    joints = body.read_joints()[0]
    pose = body.read(joints, joints)[0].pose
    still = np.linalg.norm(linear) < STILL[0] and np.linalg.norm(angular) < STILL[1]
    return pose if still and pose.position[2] > 0.0 else None


def _up(pose: Pose) -> Array:
    """Return the vertical in the base frame, shape (3,)."""
    return np.asarray(pose.rotation.as_matrix()[2])


def _between(one: Array, other: Array) -> float:
    return float(np.arccos(np.clip(one @ other, -1.0, 1.0)))


def _without_yaw(pose: Pose) -> Pose:
    """Return a pose with its yaw removed, at x = y = 0."""
    up = _up(pose)
    turn, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])
    return Pose.from_arrays((0.0, 0.0, pose.position[2]), turn)
