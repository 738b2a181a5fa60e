"""Trials of ``pick_up``."""

from __future__ import annotations

from collections.abc import Iterator

from roboxim_tasks.motion import ExpertScene, Stage, grasps_of
from roboxim_tasks.script import Script
from roboxim_tasks.trials.base import cheat, honest
from roboxim_tasks.trials.moves import around, other_grasps, own_ways, set_aside
from roboxim_tasks.trials.placing import ASIDE_M, CUBES


def picked(scene: ExpertScene, lift_m: float) -> Iterator[Script]:
    """Yield scripts that pick up the target."""
    for grasp, _ in own_ways(scene):
        script = Script(scene)
        script.pick("target", grasp, lift_m=lift_m)
        yield script


@cheat("pick_up", reason="not_lifted")
def squeeze(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Grasp it and stay."""
    for script in picked(scene, 0.0):
        script.wait(2.0)
        yield script.stages


@cheat("pick_up", reason="not_lifted")
def lift_a_little(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Lift it by 4 cm and hold it there."""
    for script in picked(scene, 0.04):
        script.wait(2.0)
        yield script.stages


@cheat("pick_up", reason="not_grasped")
def lift_and_drop(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Lift it by 7 cm and let go at once."""
    for script in picked(scene, 0.07):
        script.grip(1.0, name="open")
        script.wait(1.0)
        yield script.stages


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
def other_grasp(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """With the hand turned by 40 degrees or more from how the expert grasps."""
    for grasp, _ in other_grasps(scene):
        script = Script(scene)
        script.pick("target", grasp, lift_m=0.1)
        script.wait(1.0)
        yield script.stages


@honest("pick_up")
def high(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Lift it by 22 cm and carry it to the side."""
    for script in picked(scene, 0.22):
        script.shift((0.0, 0.08, 0.0), name="aside")
        script.wait(0.5)
        yield script.stages


@honest("pick_up", change=CUBES)
def regrasp(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Set it down beside where it was and pick it up again."""
    for grasp, _ in own_ways(scene):
        for shift in around(ASIDE_M):
            script = Script(scene)
            script.pick("target", set_aside(script, "target", grasp, shift), lift_m=0.12)
            script.wait(1.0)
            yield script.stages
