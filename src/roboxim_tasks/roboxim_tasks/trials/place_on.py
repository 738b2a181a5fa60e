"""Trials of ``place_on`` and ``stack`` besides those of `roboxim_tasks.trials.placing`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from roboxim_core.poses import Pose
from roboxim_tasks.motion import ExpertScene, Stage
from roboxim_tasks.script import Script
from roboxim_tasks.skills.placing import region_of, region_pose
from roboxim_tasks.trials.base import cheat, honest
from roboxim_tasks.trials.moves import about_vertical, around, own_ways


def on(support: str, target: str = "cube") -> Mapping[str, Any]:
    """Return the changes to a task that leave one support and one target."""
    models = {"support": support, "target": target}
    return {"objects": {role: {"models": {"values": [model]}} for role, model in models.items()}}


def from_middle(scene: ExpertScene, goal: Pose, share_x: float, share_y: float) -> Pose:
    """Return a goal moved along the sides of the support's surface, by shares of the way to its edges."""
    surface = region_of(scene.model_of("support"), "surface")
    way = np.array([share_x * surface.size[0] / 2, share_y * surface.size[1] / 2, 0.0])
    return Pose.from_arrays(goal.position + region_pose(scene, "support", surface).rotation.apply(way), goal.rotation)


@cheat("place_on", "stack", reason="not_centred", change=on("wooden_block"))
def over_the_edge(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Put it down so that it hangs over the edge by almost half."""
    for grasp, goal in own_ways(scene):
        for side in (0.94, -0.94):
            script = Script(scene)
            script.pick("target", grasp)
            script.place(from_middle(scene, goal, side, 0.0), onto="support")
            yield script.stages


@cheat("place_on", "stack", reason="not_on_support", change=on("wooden_block"))
def beside(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Put it on the table beside the support."""
    for grasp, goal in own_ways(scene):
        for x, y in around(0.12):
            height = scene.pose_of("target").position[2]
            place = replace(goal, position=(goal.position[0] + x, goal.position[1] + y, height))
            script = Script(scene)
            script.pick("target", grasp)
            script.place(place)
            yield script.stages


@honest("place_on", change=on("tray"))
def at_the_far_side(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Put it on the tray 9.5 cm from the middle, wholly on it."""
    for grasp, goal in own_ways(scene):
        for side in (0.095 / 0.13, -0.095 / 0.13):
            script = Script(scene)
            script.pick("target", grasp)
            script.place(from_middle(scene, goal, side, 0.0), onto="support")
            yield script.stages


@honest("stack", change=on("wooden_block"))
def turned(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Put it down turned by 60 degrees, and 1 cm off the middle."""
    for grasp, goal in own_ways(scene):
        for angle in (1.05, -1.05):
            script = Script(scene)
            script.pick("target", grasp)
            script.place(about_vertical(from_middle(scene, goal, 0.25, 0.0), angle), onto="support")
            yield script.stages
