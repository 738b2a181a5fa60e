"""Trials of ``flip_switch``."""

from __future__ import annotations

from collections.abc import Iterator

from roboxim_tasks.motion import ExpertScene, Stage, fingers_touch, shifted
from roboxim_tasks.script import Script
from roboxim_tasks.skills.flip_switch import BEGIN_M, END_M, HEIGHT_M, LeverAt, lever_at, pushed
from roboxim_tasks.skills.parts import APPROACH_M, part_in
from roboxim_tasks.trials.base import cheat, honest
from roboxim_tasks.trials.moves import own_stages, slowed, without

OTHER_SWITCH = {
    "objects": {"target": {"modifiers": {"color": {"values": ["red", "green"]}}}},
    "distractors": {
        "minimum": 1, "maximum": 1, "models": {"values": ["switch"]},
        "modifiers": {"color": {"values": ["blue", "yellow"]}},
    },
}  # fmt: skip


def lever_in(scene: ExpertScene, entity: str = "target") -> LeverAt:
    """Return the lever of a switch in the scene."""
    return lever_at(part_in(scene, entity, scene.model_of(entity).handles[0]))


def pushes(
    scene: ExpertScene,
    entity: str = "target",
    *,
    end_m: float = END_M,
    up_m: float = HEIGHT_M,
    speed: float = 0.6,
    opening: float = 0.0,
) -> Iterator[Script]:
    """Yield scripts that push a lever over, with the expert's push changed.

    Args:
        scene: The scene.
        entity: The switch.
        end_m: Distance beyond the pivot at which the push ends [m].
        up_m: Height of the tool centre point above the pivot [m].
        speed: Speed of the push, 1 being the arm's usual one.
        opening: Opening of the gripper, 0 to 1.
    """
    at = lever_in(scene, entity)
    for yaw in at.headings(scene.pose_tcp):
        script = Script(scene, opening=opening)
        pushed(script, entity, at, at.tool(-BEGIN_M, yaw, up_m), at.tool(end_m, yaw, up_m), speed)
        yield script


@cheat("flip_switch", reason="not_flipped")
def half_way(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Push the lever until it is about upright."""
    yield from (script.stages for script in pushes(scene, end_m=-0.017))


@cheat("flip_switch", reason="opened_other", change=OTHER_SWITCH)
def other_switch(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Flip the other switch."""
    yield from (script.stages for script in pushes(scene, "distractor_1"))


@cheat("flip_switch", reason="opened_other", change=OTHER_SWITCH)
def both_switches(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Flip the other switch first, and then the named one."""
    for script in pushes(scene, "distractor_1"):
        for stages in own_stages(scene):
            yield script.stages + stages


@cheat("flip_switch", reason="not_released")
def stay_at_the_lever(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Push it over and leave the fingers at the lever."""
    for stages in own_stages(scene):
        yield without(stages, "withdraw")


@honest("flip_switch")
def slowly(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """As the expert does, at a third of its speed."""
    yield from map(slowed, own_stages(scene))


@honest("flip_switch")
def quickly(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Push it over at full speed."""
    yield from (script.stages for script in pushes(scene, speed=1.2))


@honest("flip_switch")
def higher_and_farther(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Push the lever nearer to its tip, and therefore farther."""
    yield from (script.stages for script in pushes(scene, up_m=0.031, end_m=-0.005))


@honest("flip_switch")
def in_two_pushes(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Push it half-way, withdraw, and push it over."""
    at = lever_in(scene)
    for yaw in at.headings(scene.pose_tcp):
        script = Script(scene, opening=0.0)
        pushed(script, "target", at, at.tool(-BEGIN_M, yaw), at.tool(-0.017, yaw))
        begin, end = at.push(yaw)
        script.move(shifted(begin, APPROACH_M), name="return")
        script.move(begin, name="reach", speed=0.6, touching=fingers_touch(scene, "target"))
        script.move(end, name="push", speed=0.6, touching=fingers_touch(scene, "target"))
        script.wait(0.2)
        script.move(shifted(end, APPROACH_M), name="withdraw", touching=fingers_touch(scene, "target"))
        yield script.stages
