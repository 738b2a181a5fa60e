"""Trials that involve another object: knocked over, leaned on, put there too, brushed on the way."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from roboxim_core.plain_data.merging import merged
from roboxim_core.poses import Array, Pose
from roboxim_tasks.motion import TABLE, ExpertScene, Stage, grasps_of, shifted
from roboxim_tasks.script import Script
from roboxim_tasks.skills.placing import upright
from roboxim_tasks.skills.push_object import extent
from roboxim_tasks.trials.base import cheat, honest
from roboxim_tasks.trials.moves import around, displaced, own_stages, own_ways
from roboxim_tasks.trials.place_on import on
from roboxim_tasks.trials.place_relation import across, beside, direction
from roboxim_tasks.trials.placing import CUBES, PLACING, RELATIONS, lowest_m, onto
from roboxim_tasks.trials.push_object import full_way, push, starts
from roboxim_tasks.trials.turn_upright import CARTON

OTHER = "distractor_1"
AROUND = tuple(around(1.0))
"""Horizontal unit vectors in all directions."""


def beside_a(model: str, target: Mapping[str, Any] | None = None, color: str = "") -> dict[str, Any]:
    """Return the changes to a task that add one other object of a model."""
    other: dict[str, Any] = {"minimum": 1, "maximum": 1, "models": {"values": [model]}}
    if color:
        other["modifiers"] = {"color": {"values": [color]}}
    changed: dict[str, Any] = merged(dict(target or {}), {"distractors": other})
    return changed


def colored(role: str, model: str, color: str) -> dict[str, Any]:
    """Return the changes to a task that leave one model and one colour of a role."""
    return {"objects": {role: {"models": {"values": [model]}, "modifiers": {"color": {"values": [color]}}}}}


def moved_over(script: Script, entity: str, goal: Pose, *, onto: str = TABLE) -> None:
    """Pick up an entity with its first grasp and put it at a pose."""
    script.pick(entity, grasps_of(script.scene, entity)[0])
    script.place(goal, onto=onto)


def put_against(scene: ExpertScene, entity: str, other: str, toward: Array, gap_m: float) -> Pose:
    """Return an entity's present pose moved beside another one, in a direction, with a gap between them [m]."""
    here, there = scene.pose_of(entity), scene.pose_of(other)
    far = extent(scene.model_of(other), there, toward) + extent(scene.model_of(entity), here, -toward) + gap_m
    return beside(scene, entity, other, toward * far)


def vector(xy: tuple[float, float]) -> Array:
    """Return a horizontal vector, shape (3,)."""
    return np.array([*xy, 0.0])


# ------------------------------------------------------------------ knocked over


def knocked_over(scene: ExpertScene, way: tuple[float, float]) -> Script:
    """Return a script that sweeps the closed fingers through the upper half of the other object."""
    script, pose, model = Script(scene), scene.pose_of(OTHER), scene.model_of(OTHER)
    down = upright(Pose(quat_xyzw=(1.0, 0.0, 0.0, 0.0)), pose.position, 0.0)
    high = displaced(down, z=0.35 * (model.size[2] - model.rest_height))
    script.opening = 0.0
    script.move(displaced(high, -0.09 * way[0], -0.09 * way[1], 0.10), name="above")
    script.move(displaced(high, -0.09 * way[0], -0.09 * way[1]), name="beside_it")
    script.move(displaced(high, 0.09 * way[0], 0.09 * way[1]), name="knock")
    script.move(displaced(high, 0.09 * way[0], 0.09 * way[1], 0.15), name="rise")
    return script


def _knocks(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Knock another object over, and then do as the expert does."""
    for way in AROUND:
        first = knocked_over(scene, way).stages
        for _, stages in zip(range(6), own_stages(scene), strict=False):
            yield first + stages


_knocks.__name__ = "knock_another_over"
cheat(*PLACING, "put_into", "rotate", "pick_up", "push_object", "push_button", "flip_switch", "turn_knob",
      "open_drawer", "close_drawer", "open_door", "close_door",
      reason="toppled_other", change=beside_a("bottle", color="green"))(_knocks)  # fmt: skip
cheat("turn_upright", reason="toppled_other", change=beside_a("bottle", CARTON, "green"))(_knocks)


# ------------------------------------------------------------------ put there too


@cheat("place_on", reason="put_another_there", change=beside_a("apple", on("tray")))
@cheat("put_into", reason="put_another_there", change=beside_a("apple", {
    "objects": {"container": {"models": {"values": ["tray"]}}, "target": {"models": {"values": ["cube"]}}}
}))  # fmt: skip
def both(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Put another object there first, and then the target beside it."""
    place, height = onto(scene), scene.pose_of(OTHER).position[2] + 0.02
    for grasp, goal in own_ways(scene):
        for side in (0.07, -0.07):
            way = scene.pose_of(place).rotation.apply((side, 0.0, 0.0))
            other, target_pose = displaced(goal, *way.tolist()), displaced(goal, *(-way).tolist())
            now = scene.pose_of(OTHER)
            script = Script(scene)
            moved_over(script, OTHER, replace(now, position=(*other.position[:2], height)), onto=place)
            script.pick("target", grasp)
            script.place(target_pose, onto=place, drop_m=lowest_m(scene))
            yield script.stages


@cheat(*RELATIONS, reason="put_another_there", change=beside_a("apple", CUBES))
def both_in_direction(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Put another object to that side first, and then the target."""
    toward = direction(scene)
    if float((scene.pose_of(OTHER).position - np.array(scene.pose_of("reference").position)) @ toward) > 0.0:
        return  # it is there already
    for grasp, goal in own_ways(scene):
        for side in (0.09, -0.09):
            x, y, _ = goal.position + side * across(toward) + 0.03 * toward
            script = Script(scene)
            now = scene.pose_of(OTHER)
            moved_over(script, OTHER, replace(now, position=(float(x), float(y), now.position[2])))
            script.pick("target", grasp)
            script.place(goal)
            yield script.stages


@cheat("push_object", reason="pushed_another_too", change=beside_a("cube", colored("target", "cube", "red"), "blue"))
def two_at_once(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Put another object in front of it, and push both."""
    toward = direction(scene)
    there = put_against(scene, OTHER, "target", toward, 0.008)
    for start, begin in starts(scene):
        for grasp in grasps_of(scene, OTHER)[:4]:
            script = Script(scene)
            script.pick(OTHER, grasp)
            script.place(there)
            script.opening = start.opening
            push(script, begin, full_way(scene))
            yield script.stages


# ------------------------------------------------------------------ leaned or rested on


@cheat("turn_upright", reason="leans_on_something", change=merged(
    beside_a("spoon", CARTON), {"parameters": {"tilt_deg": 20}}
))  # fmt: skip
def one_foot_on_a_spoon(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Stand it with one side of its foot on a spoon."""
    spoon = scene.pose_of(OTHER)
    for grasp, goal in own_ways(scene):
        for side in (1.0, -1.0):
            way = spoon.rotation.apply((0.0, side * 0.030, 0.0))
            x, y, _ = spoon.position + way + spoon.rotation.apply((-0.03, 0.0, 0.0))
            script = Script(scene)
            script.pick("target", grasp)
            script.place(replace(goal, position=(float(x), float(y), goal.position[2] + 0.012)), onto=OTHER)
            yield script.stages


@cheat("pick_up", reason="rests_on_something", change=merged(
    beside_a("soda_can", CUBES), {"parameters": {"hold_s": 4.0}}
))  # fmt: skip
def rest_it_on_another(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Lift it, and then rest it on a can without letting go."""
    can = scene.pose_of(OTHER)
    for grasp, _ in own_ways(scene):
        script = Script(scene)
        script.pick("target", grasp)
        now = script.scene.pose_of("target")
        top = replace(now, position=(*can.position[:2], can.position[2] + 0.06 + 0.0225 - 0.001))
        at = top @ script.held_in_tcp.inverse()
        script.carry(at)
        script.move(at, name="rest", speed=0.6, touching=(("target", OTHER),))
        script.wait(6.0)
        yield script.stages


# ------------------------------------------------------------------ honest


@honest("pick_up", change=beside_a("milk_carton", CUBES))
def brushing_another(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Lift it and hold it so that it touches the side of a carton."""
    for grasp, _ in own_ways(scene):
        for way in AROUND:
            there = put_against(scene, "target", OTHER, vector(way), -0.001)
            script = Script(scene)
            script.pick("target", grasp)
            at = shifted(displaced(there, z=0.075) @ script.held_in_tcp.inverse(), 0.0)
            before = displaced(at, 0.03 * way[0], 0.03 * way[1])
            script.carry(before)
            script.move(before, name="lower", speed=0.6)
            script.move(at, name="touch", speed=0.3, touching=(("target", OTHER),))
            script.wait(2.0)
            yield script.stages


@honest("turn_upright", change=beside_a("wooden_block", CARTON))
def flush_with_another(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Stand it close to a block so that they touch, and push it there."""
    block, model = scene.pose_of(OTHER), scene.model_of("target")
    for grasp, goal in own_ways(scene):
        for way in AROUND:
            toward = vector(way)
            inward = -goal.rotation.inv().apply(toward)
            far = extent(scene.model_of(OTHER), block, toward) + extent(model, Pose(), inward)
            x, y, _ = block.position + toward * (far - 0.001)
            at = replace(goal, position=(float(x), float(y), goal.position[2]))
            script = Script(scene)
            script.pick("target", grasp)
            before = displaced(at, 0.02 * way[0], 0.02 * way[1]) @ script.held_in_tcp.inverse()
            script.carry(before)
            script.move(before, name="lower", speed=0.6, touching=(("target", TABLE),))
            script.move(
                at @ script.held_in_tcp.inverse(),
                name="against",
                speed=0.3,
                touching=(("target", TABLE), ("target", OTHER)),
            )
            script.release(at)
            script.shift((0.0, 0.0, 0.05), name="rise")
            yield script.stages


@honest("place_on", "put_into", "rotate", "pick_up", *RELATIONS, "push_object", change=beside_a("lemon", {}))
def another_aside_first(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Move another object 6 cm aside first, and then do as the expert does."""
    for x, y in around(0.06):
        for _, stages in zip(range(4), own_stages(scene), strict=False):
            script = Script(scene)
            moved_over(script, OTHER, displaced(scene.pose_of(OTHER), x, y))
            yield script.stages + stages
