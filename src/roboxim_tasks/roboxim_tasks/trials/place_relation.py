"""Trials of ``place_left_of`` and its sisters besides those of `roboxim_tasks.trials.placing`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from roboxim_core.poses import Array, Pose
from roboxim_tasks.motion import ExpertScene, Stage, grasps_of
from roboxim_tasks.script import Script
from roboxim_tasks.trials.base import cheat, honest
from roboxim_tasks.trials.moves import own_ways
from roboxim_tasks.trials.placing import RELATIONS

RED_AND_BLUE = {
    "objects": {
        role: {"models": {"values": ["cube"]}, "modifiers": {"color": {"values": [color]}}}
        for role, color in (("reference", "blue"), ("target", "red"))
    }
}


def direction(scene: ExpertScene) -> Array:
    """Return the task's direction in the base, shape (3,)."""
    arguments = scene.task.arguments
    toward = (float(arguments["direction_x"]), float(arguments["direction_y"]), 0.0)
    return np.asarray(scene.scene.robot.pose.rotation.inv().apply(toward))


def beside(scene: ExpertScene, entity: str, other: str, vector: Array) -> Pose:
    """Return an entity's present pose, moved to a vector from another entity."""
    x, y, _ = scene.pose_of(other).position + vector
    now = scene.pose_of(entity)
    return replace(now, position=(float(x), float(y), now.position[2]))


def across(toward: Array) -> Array:
    """Return the horizontal vector at right angles to a direction, shape (3,)."""
    return np.array([-toward[1], toward[0], 0.0])


def put_beside(scene: ExpertScene, vectors: Iterable[Array]) -> Iterator[tuple[Stage, ...]]:
    """Yield ways to put the target at one of some vectors from the reference."""
    for vector in vectors:
        for grasp, _ in own_ways(scene):
            script = Script(scene)
            script.pick("target", grasp)
            script.place(beside(scene, "target", "reference", vector))
            yield script.stages


@cheat(*RELATIONS, reason="not_in_direction", change=RED_AND_BLUE)
def on_the_opposite_side(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Put it on the opposite side."""
    away, side, slopes = -direction(scene), across(direction(scene)), (0.0, 0.4, -0.4, 0.9, -0.9)
    yield from put_beside(scene, (m * (away + slope * side) for m in (0.1, 0.13, 0.08) for slope in slopes))


@cheat(*RELATIONS, reason="too_far_to_the_side", change=RED_AND_BLUE)
def diagonally(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Put it as far to the side as in the direction."""
    toward = direction(scene)
    yield from put_beside(scene, (0.09 * (toward + slope * across(toward)) for slope in (1.2, -1.2)))


@cheat(*RELATIONS, reason="moved_reference", change=RED_AND_BLUE)
def move_the_reference(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Move the reference to the other side of it instead."""
    for length in (0.1, 0.14):
        for slope in (0.0, 0.4, -0.4):
            vector = length * (slope * across(direction(scene)) - direction(scene))
            for grasp in grasps_of(scene, "reference"):
                script = Script(scene)
                script.pick("reference", grasp)
                script.place(beside(scene, "reference", "target", vector))
                yield script.stages


@honest(*RELATIONS, change=RED_AND_BLUE)
def slanting(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Put it farther away than the expert does, and a little to the side."""
    toward, side, slopes = direction(scene), across(direction(scene)), (0.5, -0.5, 0.3, -0.3)
    yield from put_beside(scene, (m * (toward + slope * side) for m in (0.15, 0.12, 0.18, 0.1) for slope in slopes))
