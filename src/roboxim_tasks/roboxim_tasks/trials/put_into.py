"""Trials of ``put_into`` besides those of `roboxim_tasks.trials.placing`."""

from __future__ import annotations

from dataclasses import replace

from roboxim_core.poses import Pose
from roboxim_tasks.script import Script
from roboxim_tasks.trials.base import cheat, honest
from roboxim_tasks.trials.moves import around, displaced, each_way
from roboxim_tasks.trials.placing import CUBES


@cheat("put_into", reason="dropped", change=CUBES)
@each_way()
def throw_in(script: Script, goal: Pose) -> None:
    """Let go of it 30 cm above the container's floor."""
    script.place(goal, onto="container", drop_m=0.3)


@cheat("put_into", reason="not_inside", change=CUBES)
@each_way(over=around(0.14))
def beside(script: Script, goal: Pose, away: tuple[float, float]) -> None:
    """Put it on the table beside the container."""
    height = script.scene.pose_of("target").position[2]
    script.place(replace(goal, position=(goal.position[0] + away[0], goal.position[1] + away[1], height)))


@cheat("put_into", reason="not_released", change=CUBES)
@each_way()
def hold_inside(script: Script, goal: Pose) -> None:
    """Lower it into the container and hold it there."""
    at = displaced(goal, z=0.01) @ script.held_in_tcp.inverse()
    script.carry(at)
    script.move(at, name="lower", speed=0.6)
    script.wait(2.0)


@honest("put_into", change=CUBES)
@each_way()
def from_the_rim(script: Script, goal: Pose) -> None:
    """Let go of it 3 cm above the rim, as one drops a lemon into a bowl."""
    script.place(goal, onto="container", drop_m=0.085)
