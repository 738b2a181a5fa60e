"""Trials of ``place_on`` and ``stack`` besides those of `roboxim_tasks.trials.placing`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from roboxim_core.poses import Pose
from roboxim_tasks.motion import ExpertScene
from roboxim_tasks.script import Script
from roboxim_tasks.skills.placing import region_of, region_pose
from roboxim_tasks.trials.base import cheat, honest
from roboxim_tasks.trials.moves import about_vertical, around, each_way


def on(support: str) -> Mapping[str, Any]:
    """Return the changes to a task that leave one support, and the cube."""
    models = {"support": support, "target": "cube"}
    return {"objects": {role: {"models": {"values": [model]}} for role, model in models.items()}}


def from_middle(scene: ExpertScene, goal: Pose, share_x: float, share_y: float) -> Pose:
    """Return a goal moved along the sides of the support's surface, by shares of the way to its edges."""
    surface = region_of(scene.model_of("support"), "surface")
    way = np.array([share_x * surface.size[0] / 2, share_y * surface.size[1] / 2, 0.0])
    return Pose.from_arrays(goal.position + region_pose(scene, "support", surface).rotation.apply(way), goal.rotation)


@cheat("place_on", "stack", reason="not_centred", change=on("wooden_block"))
@each_way(over=(0.94, -0.94))
def over_the_edge(script: Script, goal: Pose, side: float) -> None:
    """Put it down so that it hangs over the edge by almost half."""
    script.place(from_middle(script.scene, goal, side, 0.0), onto="support")


@cheat("place_on", "stack", reason="not_on_support", change=on("wooden_block"))
@each_way(over=around(0.12))
def beside(script: Script, goal: Pose, away: tuple[float, float]) -> None:
    """Put it on the table beside the support."""
    height = script.scene.pose_of("target").position[2]
    script.place(replace(goal, position=(goal.position[0] + away[0], goal.position[1] + away[1], height)))


@honest("place_on", change=on("tray"))
@each_way(over=(0.095 / 0.13, -0.095 / 0.13))
def at_the_far_side(script: Script, goal: Pose, side: float) -> None:
    """Put it on the tray 9.5 cm from the middle, wholly on it."""
    script.place(from_middle(script.scene, goal, side, 0.0), onto="support")


@honest("stack", change=on("wooden_block"))
@each_way(over=(1.05, -1.05))
def turned(script: Script, goal: Pose, angle_rad: float) -> None:
    """Put it down turned by 60 degrees, and 1 cm off the middle."""
    script.place(about_vertical(from_middle(script.scene, goal, 0.25, 0.0), angle_rad), onto="support")
