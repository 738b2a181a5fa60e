"""Trials of ``pick_up``."""

from __future__ import annotations

from collections.abc import Iterator

from roboxim_core.poses import Pose
from roboxim_tasks.motion import ExpertScene, Stage, grasps_of
from roboxim_tasks.script import Script
from roboxim_tasks.trials.base import cheat, honest
from roboxim_tasks.trials.moves import around, each_way, other_grasps, own_ways, set_aside
from roboxim_tasks.trials.placing import ASIDE_M, CUBES


@cheat("pick_up", reason="not_lifted")
@each_way(lift_m=0.0)
def squeeze(script: Script, goal: Pose) -> None:
    """Grasp it and stay."""
    script.wait(2.0)


@cheat("pick_up", reason="not_lifted")
@each_way(lift_m=0.04)
def lift_a_little(script: Script, goal: Pose) -> None:
    """Lift it by 4 cm and hold it there."""
    script.wait(2.0)


@cheat("pick_up", reason="not_grasped")
@each_way(lift_m=0.07)
def lift_and_drop(script: Script, goal: Pose) -> None:
    """Lift it by 7 cm and let go at once."""
    script.grip(1.0, name="open")
    script.wait(1.0)


@cheat(
    "pick_up", reason="wrong_object_lifted", change={
        "distractors": {"minimum": 1, "maximum": 1, "models": {"values": ["cube", "apple"]}},
    },
)  # fmt: skip
def other_object(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Pick up the other object."""
    for grasp in grasps_of(scene, "distractor_1"):
        script = Script(scene)
        script.pick("distractor_1", grasp, lift_m=0.12)
        script.wait(1.0)
        yield script.stages


@honest("pick_up", change=CUBES)
@each_way(other_grasps, lift_m=0.1)
def other_grasp(script: Script, goal: Pose) -> None:
    """With the hand turned by 40 degrees or more from how the expert grasps."""
    script.wait(1.0)


@honest("pick_up")
@each_way(lift_m=0.22)
def high(script: Script, goal: Pose) -> None:
    """Lift it by 22 cm and carry it to the side."""
    script.shift((0.0, 0.08, 0.0), name="aside")
    script.wait(0.5)


@honest("pick_up", change=CUBES)
def regrasp(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Set it down beside where it was and pick it up again."""
    for grasp, _ in own_ways(scene):
        for shift in around(ASIDE_M):
            script = Script(scene)
            script.pick("target", set_aside(script, "target", grasp, shift), lift_m=0.12)
            script.wait(1.0)
            yield script.stages
