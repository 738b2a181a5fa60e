"""Trials that all pick-and-place skills share."""

from __future__ import annotations

from collections.abc import Iterator

from roboxim_core.poses import Pose
from roboxim_tasks.motion import TABLE, ExpertScene, Stage
from roboxim_tasks.script import Script
from roboxim_tasks.trials.base import cheat, honest
from roboxim_tasks.trials.moves import around, caging, each_way, other_grasps, own_stages, own_ways, set_aside, slowed

RELATIONS = ("place_left_of", "place_right_of", "place_in_front_of", "place_behind")
PLACING = ("place_on", *RELATIONS, "stack")
CUBES = {"objects": {"target": {"models": {"values": ["cube"]}}}}
"""Changes to the task: the target is a cube, whose grasps are equivalent, so that only the handling matters."""
ASIDE_M = 0.07
"""Distance by which the target is set aside before it is grasped again [m]."""


def onto(scene: ExpertScene) -> str:
    """Return the entity that the target is put on."""
    roles = ("support", "container")
    return next((scene.task.objects[role].entity for role in roles if role in scene.task.objects), TABLE)


def lowest_m(scene: ExpertScene) -> float:
    """Return the height above a goal at which to release the target [m]: fingers do not reach a container's floor."""
    return 0.02 if "container" in scene.task.objects else 0.002


@cheat(*PLACING, "rotate", reason="dropped", change=CUBES)
@each_way()
def drop(script: Script, goal: Pose) -> None:
    """Let go of it 20 cm above where it is to be."""
    script.place(goal, onto=onto(script.scene), drop_m=0.2)


@cheat(*PLACING, "rotate", "put_into", reason="still_held", change=CUBES)
@each_way()
def cage(script: Script, goal: Pose) -> None:
    """Put it down and open the fingers, but stay around it."""
    caging(script, "target", goal, onto(script.scene))


@honest(*PLACING, "rotate", "put_into", "pick_up", "turn_upright")
def slowly(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """As the expert does, at a third of its speed."""
    yield from map(slowed, own_stages(scene))


@honest(*PLACING, "rotate", "put_into", change=CUBES)
@each_way(other_grasps)
def other_grasp(script: Script, goal: Pose) -> None:
    """With the hand turned by 40 degrees or more from how the expert grasps."""
    script.place(goal, onto=onto(script.scene), drop_m=lowest_m(script.scene))


@honest(*PLACING, "rotate", "put_into", change=CUBES)
@each_way()
def from_above(script: Script, goal: Pose) -> None:
    """Let go of it 2.5 cm above where it is to be."""
    script.place(goal, onto=onto(script.scene), drop_m=0.025)


@honest(*PLACING, "rotate", "put_into", change=CUBES)
def regrasp(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Set it down beside where it was, grasp it again, and then put it where it is to be."""
    for grasp, goal in own_ways(scene):
        for shift in around(ASIDE_M):
            script = Script(scene)
            again = set_aside(script, "target", grasp, shift)
            script.pick("target", again)
            script.place(goal, onto=onto(scene), drop_m=lowest_m(scene))
            yield script.stages
