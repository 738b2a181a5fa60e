"""Trials of ``put_into`` besides those of `roboxim_tasks.trials.placing`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from roboxim_tasks.motion import ExpertScene, Stage
from roboxim_tasks.script import Script
from roboxim_tasks.trials.base import cheat, honest
from roboxim_tasks.trials.moves import around, displaced, own_ways
from roboxim_tasks.trials.placing import CUBES


@cheat("put_into", reason="dropped", change=CUBES)
def throw_in(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Let go of it 30 cm above the container's floor."""
    for grasp, goal in own_ways(scene):
        script = Script(scene)
        script.pick("target", grasp)
        script.place(goal, onto="container", drop_m=0.3)
        yield script.stages


@cheat("put_into", reason="not_inside", change=CUBES)
def beside(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Put it on the table beside the container."""
    for grasp, goal in own_ways(scene):
        for x, y in around(0.14):
            position = goal.position[0] + x, goal.position[1] + y, scene.pose_of("target").position[2]
            script = Script(scene)
            script.pick("target", grasp)
            script.place(replace(goal, position=position))
            yield script.stages


@cheat("put_into", reason="not_released", change=CUBES)
def hold_inside(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Lower it into the container and hold it there."""
    for grasp, goal in own_ways(scene):
        script = Script(scene)
        script.pick("target", grasp)
        at = displaced(goal, z=0.01) @ script.held_in_tcp.inverse()
        script.carry(at)
        script.move(at, name="lower", speed=0.6)
        script.wait(2.0)
        yield script.stages


@honest("put_into", change=CUBES)
def from_the_rim(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Let go of it 3 cm above the rim, as one drops a lemon into a bowl."""
    for grasp, goal in own_ways(scene):
        script = Script(scene)
        script.pick("target", grasp)
        script.place(goal, onto="container", drop_m=0.085)
        yield script.stages
