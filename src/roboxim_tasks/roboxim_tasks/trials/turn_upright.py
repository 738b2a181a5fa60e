"""Trials of ``turn_upright`` besides those of `roboxim_tasks.trials.placing`."""

from __future__ import annotations

from roboxim_core.poses import Pose
from roboxim_tasks.motion import TABLE
from roboxim_tasks.script import Script
from roboxim_tasks.trials.base import cheat, honest
from roboxim_tasks.trials.moves import around, displaced, each_way, other_grasps

CARTON = {"objects": {"target": {"models": {"values": ["milk_carton"]}}}}
"""Changes to the task: the target is a carton, which does not roll when it is released lying."""


@cheat("turn_upright", reason="not_upright")
@each_way()
def lift_and_lay(script: Script, goal: Pose) -> None:
    """Pick it up and lay it down again."""
    script.place(script.scene.pose_of("target"))


@cheat("turn_upright", reason="not_released")
@each_way()
def hold_upright(script: Script, goal: Pose) -> None:
    """Stand it on the table and hold on to it."""
    at = displaced(goal, z=-0.002) @ script.held_in_tcp.inverse()
    script.carry(at)
    script.move(at, name="lower", speed=0.6, touching=(("target", TABLE),))
    script.wait(2.0)


@cheat("turn_upright", reason="dropped", change=CARTON)
@each_way()
def drop(script: Script, goal: Pose) -> None:
    """Turn it upright and let go of it 15 cm above the table."""
    script.place(goal, drop_m=0.15)


@honest("turn_upright", change=CARTON)
@each_way(other_grasps)
def other_grasp(script: Script, goal: Pose) -> None:
    """With the hand turned by 40 degrees or more from how the expert grasps."""
    script.place(goal)


@honest("turn_upright", change=CARTON)
@each_way(over=around(0.1))
def elsewhere(script: Script, goal: Pose, away: tuple[float, float]) -> None:
    """Stand it 10 cm from where it lay."""
    script.place(displaced(goal, *away))


@honest("turn_upright", change=CARTON)
@each_way()
def from_above(script: Script, goal: Pose) -> None:
    """Let go of it 1.5 cm above the table."""
    script.place(goal, drop_m=0.015)
