"""Trials of ``turn_upright`` besides those of `roboxim_tasks.trials.placing`."""

from __future__ import annotations

from collections.abc import Iterator

from roboxim_tasks.motion import TABLE, ExpertScene, Stage
from roboxim_tasks.script import Script
from roboxim_tasks.trials.base import cheat, honest
from roboxim_tasks.trials.moves import around, displaced, other_grasps, own_ways

CARTON = {"objects": {"target": {"models": {"values": ["milk_carton"]}}}}
"""Changes to the task: the target is a carton, which does not roll when it is released lying."""


@cheat("turn_upright", reason="not_upright")
def lift_and_lay(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Pick it up and lay it down again."""
    for grasp, _ in own_ways(scene):
        script = Script(scene)
        script.pick("target", grasp)
        script.place(scene.pose_of("target"))
        yield script.stages


@cheat("turn_upright", reason="not_released")
def hold_upright(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Stand it on the table and hold on to it."""
    for grasp, goal in own_ways(scene):
        script = Script(scene)
        script.pick("target", grasp)
        at = displaced(goal, z=-0.002) @ script.held_in_tcp.inverse()
        script.carry(at)
        script.move(at, name="lower", speed=0.6, touching=(("target", TABLE),))
        script.wait(2.0)
        yield script.stages


@cheat("turn_upright", reason="dropped", change=CARTON)
def drop(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Turn it upright and let go of it 15 cm above the table."""
    for grasp, goal in own_ways(scene):
        script = Script(scene)
        script.pick("target", grasp)
        script.place(goal, drop_m=0.15)
        yield script.stages


@honest("turn_upright", change=CARTON)
def other_grasp(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """With the hand turned by 40 degrees or more from how the expert grasps."""
    for grasp, goal in other_grasps(scene):
        script = Script(scene)
        script.pick("target", grasp)
        script.place(goal)
        yield script.stages


@honest("turn_upright", change=CARTON)
def elsewhere(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Stand it 10 cm from where it lay."""
    for grasp, goal in own_ways(scene):
        for x, y in around(0.1):
            script = Script(scene)
            script.pick("target", grasp)
            script.place(displaced(goal, x, y))
            yield script.stages


@honest("turn_upright", change=CARTON)
def from_above(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Let go of it 1.5 cm above the table."""
    for grasp, goal in own_ways(scene):
        script = Script(scene)
        script.pick("target", grasp)
        script.place(goal, drop_m=0.015)
        yield script.stages
