"""Trials in which the target stands, lies or leans on the wrong object, or in the wrong way."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from roboxim_core.plain_data.merging import merged
from roboxim_core.poses import Array, Pose
from roboxim_tasks.motion import TABLE, ExpertScene, Stage, grasps_of
from roboxim_tasks.script import Script
from roboxim_tasks.skills.push_object import extent
from roboxim_tasks.trials.base import cheat, honest
from roboxim_tasks.trials.moves import about_vertical, around, displaced, each_way, own_ways
from roboxim_tasks.trials.neighbours import AROUND, OTHER, beside_a, colored
from roboxim_tasks.trials.place_on import from_middle, on
from roboxim_tasks.trials.place_relation import RED_AND_BLUE, across, beside, direction
from roboxim_tasks.trials.placing import CUBES, RELATIONS, lowest_m
from roboxim_tasks.trials.turn_upright import CARTON

SPOON = merged(colored("reference", "wooden_block", "blue"), {"objects": {"target": {"models": {"values": ["spoon"]}}}})
"""Changes to a relation: the target is a spoon, which can lie with one end on the reference."""


TIP_RAD = 0.95
"""Angle by which a cube is tipped [rad]; it falls onto its next side when it is let go."""


def turned_about(pose: Pose, axis: Array, angle_rad: float) -> Pose:
    """Return a pose turned about a horizontal axis through its origin."""
    from scipy.spatial.transform import Rotation

    return Pose.from_arrays(pose.position, Rotation.from_rotvec(np.asarray(axis) * angle_rad) * pose.rotation)


@cheat(*RELATIONS, reason="leans_on_something", change=SPOON)
def one_end_on_the_reference(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Lay it there with one end on the reference and the other on the table."""
    from scipy.spatial.transform import Rotation

    toward, base = direction(scene), scene.pose_of("reference")
    model, now = scene.model_of("target"), scene.pose_of("target")
    top_m, half_m = scene.model_of("reference").size[2], model.size[0] / 2
    slope = float(np.arcsin(top_m / (1.6 * half_m)))
    for grasp, _ in own_ways(scene):
        for end in (1.0, -1.0):
            heading = float(np.arctan2(toward[1], toward[0])) + (0.0 if end > 0 else np.pi)
            lying = Rotation.from_euler("z", heading) * Rotation.from_euler("y", end * slope)
            x, y, _ = base.position + toward * 0.075
            script = Script(scene)
            script.pick("target", grasp)
            height = now.position[2] + half_m * float(np.sin(slope))
            script.place(Pose.from_arrays((float(x), float(y), height), lying), onto="reference", drop_m=0.004)
            yield script.stages


@cheat("turn_upright", reason="not_upright", change=CARTON)
def on_its_head(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Stand it on its head."""
    from scipy.spatial.transform import Rotation

    model, pose = scene.model_of("target"), scene.pose_of("target")
    foot = pose.position[2] + model.size[2] / 2 - extent(model, pose, np.array([0.0, 0.0, -1.0]))
    for grasp, goal in own_ways(scene):
        script = Script(scene)
        script.pick("target", grasp)
        lying = pose.rotation
        axis = np.cross(lying.apply((0.0, 0.0, 1.0)), (0.0, 0.0, -1.0))
        turn = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.pi / 2)
        script.place(Pose.from_arrays((*goal.position[:2], foot + 0.004), turn * lying))
        yield script.stages


@cheat("stack", reason="leans_on_something", change=merged(
    beside_a("wooden_block", colored("target", "wooden_block", "red"), "blue"),
    colored("support", "wooden_block", "green"),
))  # fmt: skip
def bridge(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Put another block beside the base, and lay the target across both."""
    base = scene.pose_of("support")
    side = base.rotation.apply((0.0, 1.0, 0.0))
    for sign in (1.0, -1.0):
        pillar = displaced(base, *(sign * 0.06 * side).tolist())
        for first in grasps_of(scene, OTHER)[:4]:
            for grasp, goal in list(own_ways(scene))[:8]:
                middle = displaced(base, *(sign * 0.004 * side).tolist())
                across_both = replace(
                    about_vertical(middle, np.pi / 2), position=(*middle.position[:2], goal.position[2])
                )
                script = Script(scene)
                script.pick(OTHER, first)
                script.place(pillar)
                script.pick("target", grasp)
                script.place(across_both, onto="support")
                yield script.stages


@cheat("pick_up", reason="wrong_object_lifted", change=beside_a(
    "cube", colored("target", "wooden_block", "red"), "blue"
))  # fmt: skip
def with_another_on_top(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Put a cube on the block first, and lift both."""
    block = scene.pose_of("target")
    end = displaced(block, *(-0.02 * block.rotation.apply((1.0, 0.0, 0.0))).tolist())
    top = displaced(end, z=scene.model_of("target").rest_height + scene.model_of(OTHER).rest_height)
    for first in grasps_of(scene, OTHER)[:4]:
        for grasp in grasps_of(scene, "target", "towards_end"):
            script = Script(scene)
            script.pick(OTHER, first)
            script.place(top, onto="target")
            script.pick("target", grasp, lift_m=0.12)
            script.wait(1.0)
            yield script.stages


@cheat("rotate", reason="toppled", change=CUBES)
def tip_and_turn(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Turn it, and tip it over onto another of its sides when putting it down."""
    model = scene.model_of("target")
    low_m = model.size[0] / 2 * (np.cos(TIP_RAD) + np.sin(TIP_RAD)) - model.rest_height
    for grasp, goal in own_ways(scene):
        closing = goal.rotation.apply(
            scene.pose_of("target").rotation.inv().apply(grasp.pose.rotation.apply((0, 1, 0)))
        )
        for sign in (1.0, -1.0):
            script = Script(scene)
            script.pick("target", grasp)
            script.move(displaced(goal, z=0.12) @ script.held_in_tcp.inverse(), name="turn")
            script.wait(0.3)
            tipped = displaced(turned_about(goal, closing, sign * TIP_RAD), z=low_m)
            script.place(tipped, drop_m=0.002)
            yield script.stages


@honest(*RELATIONS, change=RED_AND_BLUE)
def against_the_reference(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Put it down so close that it touches the side of the reference."""
    toward = direction(scene)
    here, model = scene.pose_of("reference"), scene.model_of("reference")
    target_model = scene.model_of("target")
    for slope in (0.0, 0.3, -0.3):
        way = toward + slope * across(toward)
        for grasp, goal in own_ways(scene):
            far = extent(model, here, way) + extent(target_model, goal, -way) + 0.001
            script = Script(scene)
            script.pick("target", grasp)
            script.place(replace(goal, position=(*beside(scene, "target", "reference", far * way).position[:2],
                                                 goal.position[2])))  # fmt: skip
            yield script.stages


@honest("rotate", change=CUBES)
def there_and_back(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Turn it in the hand by 40 degrees too far and back before putting it down."""
    now = scene.pose_of("target")
    for grasp, goal in own_ways(scene):
        turned = (goal.rotation * now.rotation.inv()).as_rotvec()[2]
        beyond = about_vertical(now, turned + np.sign(turned) * 0.7)
        script = Script(scene)
        script.pick("target", grasp)
        script.move(displaced(about_vertical(now, turned / 2), z=0.1) @ script.held_in_tcp.inverse(), name="turn")
        script.move(displaced(beyond, z=0.1) @ script.held_in_tcp.inverse(), name="too_far")
        script.wait(0.3)
        script.place(goal)
        yield script.stages


@honest("turn_upright", change=CARTON)
def moved_on(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Stand it up and slide it 4 cm over the table before letting go."""
    for grasp, goal in own_ways(scene):
        for way in AROUND:
            there = displaced(goal, 0.04 * way[0], 0.04 * way[1])
            script = Script(scene)
            script.pick("target", grasp)
            at = goal @ script.held_in_tcp.inverse()
            script.carry(at)
            script.move(at, name="lower", speed=0.6, touching=(("target", TABLE),))
            script.move(there @ script.held_in_tcp.inverse(), name="slide", speed=0.4, touching=(("target", TABLE),))
            script.release(there)
            script.shift((0.0, 0.0, 0.05), name="rise")
            yield script.stages


@honest("pick_up", change=CUBES)
@each_way(lift_m=0.12)
def turned_in_the_air(script: Script, goal: Pose) -> None:
    """Lift it and turn it by 60 degrees in the air."""
    script.move(about_vertical(script.pose, 1.05), name="turn")
    script.wait(1.0)


@honest("put_into", change=merged(dict(CUBES), {"objects": {"container": {"models": {"values": ["tray"]}}}}))
@each_way(over=around(0.05))
def off_the_middle(script: Script, goal: Pose, away: tuple[float, float]) -> None:
    """Put it into the tray 5 cm from the middle."""
    script.place(displaced(goal, *away), onto="container", drop_m=lowest_m(script.scene))


@honest("place_on", change=on("tray"))
@each_way(over=((0.5, 0.5), (0.5, -0.5), (-0.5, 0.5), (-0.5, -0.5)))
def in_a_corner(script: Script, goal: Pose, shares: tuple[float, float]) -> None:
    """Put it in a corner of the tray."""
    script.place(from_middle(script.scene, goal, *shares), onto="support")
