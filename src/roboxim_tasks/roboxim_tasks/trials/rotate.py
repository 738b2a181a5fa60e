"""Trials of ``rotate`` besides those of `roboxim_tasks.trials.placing`."""

from __future__ import annotations

from collections.abc import Iterator

from roboxim_core.poses import Pose
from roboxim_tasks.motion import TABLE, ExpertScene, Grasp, Stage
from roboxim_tasks.script import Script
from roboxim_tasks.skills.base import parameters_of
from roboxim_tasks.skills.rotate import RotateParameters
from roboxim_tasks.trials.base import cheat, honest
from roboxim_tasks.trials.moves import about_vertical, around, displaced, each_way, own_ways
from roboxim_tasks.trials.placing import CUBES

STANDING = {"objects": {"target": {"models": {"values": ["bottle", "soda_can"]}}}}
"""Changes to the task: the target stands and can topple."""


def turned_by(scene: ExpertScene, share: float) -> Iterator[tuple[Grasp, Script]]:
    """Yield scripts that turn the target by a share of the task's angle."""
    angle = parameters_of(scene.task, RotateParameters).angle_rad
    for grasp, _ in own_ways(scene):
        script = Script(scene)
        script.pick("target", grasp)
        script.place(about_vertical(scene.pose_of("target"), share * angle))
        yield grasp, script


@cheat("rotate", reason="not_turned", change=CUBES)
def half_way(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Turn it by half the angle."""
    for _, script in turned_by(scene, 0.5):
        yield script.stages


@cheat("rotate", reason="not_turned", change=CUBES)
def the_other_way(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Turn it in the other direction."""
    for _, script in turned_by(scene, -1.0):
        yield script.stages


@cheat("rotate", reason="moved_away", change=CUBES)
@each_way(over=around(0.08))
def elsewhere(script: Script, goal: Pose, away: tuple[float, float]) -> None:
    """Turn it, but put it down 8 cm from where it was."""
    script.place(displaced(goal, *away))


@cheat("rotate", reason="toppled", change=STANDING)
@each_way()
def turn_and_topple(script: Script, goal: Pose) -> None:
    """Turn it, let go, and knock it over with a finger."""
    at = goal @ script.held_in_tcp.inverse()
    script.carry(at)
    script.move(displaced(at, z=0.002), name="lower", speed=0.6, touching=(("target", TABLE),))
    script.grip(1.0, name="open")
    script.move(displaced(script.pose, z=0.02), name="to_its_top", speed=0.6)
    sideways = script.pose.rotation.apply((0.0, 0.12, 0.0))
    script.move(displaced(script.pose, *sideways.tolist()), name="knock")
    script.move(displaced(script.pose, z=0.12), name="rise")
    script.wait(2.0)


@honest("rotate", change=CUBES)
def in_two_steps(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Turn it by half the angle, let go, grasp it anew as at first, and turn it by the rest."""
    for grasp, goal in own_ways(scene):
        for way, script in turned_by(scene, 0.5):
            if way != grasp:
                continue
            half = script.pose_of("target")
            script.pick("target", Grasp(
                pose=half @ scene.pose_of("target").inverse() @ grasp.pose, opening=grasp.opening,
                release_opening=grasp.release_opening,
            ))  # fmt: skip
            script.place(goal)
            yield script.stages
