"""Trials about how the target comes to lie: on its side, pushed to its place, turned where it stands."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from roboxim_core.poses import Pose
from roboxim_tasks.motion import TABLE, ExpertScene, Stage, fingers_touch, grasps_of, shifted
from roboxim_tasks.script import Script
from roboxim_tasks.skills.push_object import pushing_poses
from roboxim_tasks.trials.base import cheat, honest
from roboxim_tasks.trials.moves import around, displaced, own_ways
from roboxim_tasks.trials.place_on import on
from roboxim_tasks.trials.place_relation import RED_AND_BLUE, direction
from roboxim_tasks.trials.placing import CUBES, RELATIONS, onto
from roboxim_tasks.trials.push_object import along, push

FLAT_RAD = 1.0
"""Least angle of a lying object's axis from the vertical [rad]."""


def cans(**others: str) -> Mapping[str, Any]:
    """Return the changes to a task whose target is a red can, with one model of each other role."""
    objects: dict[str, Any] = {role: {"models": {"values": [model]}} for role, model in others.items()}
    red = {"modifiers": {"color": {"values": ["red"]}}}
    return {"objects": {**objects, "target": {"models": {"values": ["soda_can"]}, **red}}}


def laid_down(scene: ExpertScene, held_in_tcp: Pose, goal: Pose) -> Pose | None:
    """Return the pose of the target on its side at a goal, with the tool pointing down; none if it would stand."""
    from scipy.spatial.transform import Rotation

    tool = goal @ held_in_tcp.inverse()
    approach = tool.rotation.apply((0.0, 0.0, 1.0))
    turn, _ = Rotation.align_vectors([(0.0, 0.0, -1.0)], [approach])
    lying = turn * goal.rotation
    axis = lying.apply((0.0, 0.0, 1.0))
    if np.arccos(min(1.0, abs(float(axis[2])))) < FLAT_RAD:
        return None
    model = scene.model_of("target")
    height = goal.position[2] - model.rest_height + model.size[0] / 2
    return Pose.from_arrays((*goal.position[:2], height), lying)


@cheat(*RELATIONS, reason="toppled", change=cans())
@cheat("place_on", reason="toppled", change=cans(support="tray"))
@cheat("put_into", reason="toppled", change=cans(container="bowl"))
@cheat("stack", reason="toppled", change=cans(support="wooden_block"))
def lay_it_down(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Lay it there on its side, though it stood before."""
    goals = {goal.position: goal for _, goal in zip(range(8), (goal for _, goal in own_ways(scene)), strict=False)}
    sides = [*grasps_of(scene, "target", "tilted"), *grasps_of(scene, "target", "side")]
    for grasp, goal in itertools.product(sides, goals.values()):
        script = Script(scene)
        script.pick("target", grasp)
        lying = laid_down(scene, script.held_in_tcp, goal)
        if lying is not None:
            script.place(lying, onto=onto(scene), drop_m=0.02 if "container" in scene.task.objects else 0.004)
            yield script.stages


# ------------------------------------------------------------------ honest


@honest(*RELATIONS, change=RED_AND_BLUE)
def pushed_on(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Put it there, and push it 4 cm farther over the table."""
    toward, way_m = direction(scene), 0.04
    for grasp, goal in own_ways(scene):
        for begin, opening in list(pushing_poses(scene.model_of("target"), goal, toward))[:4]:
            script = Script(scene)
            script.pick("target", grasp)
            script.place(goal)
            script.opening = opening
            push(script, begin, way_m, toward=toward)
            yield script.stages


@honest("push_object", change=CUBES)
def fast(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Push it as fast as the hand goes, so that it slides on a little."""
    toward = direction(scene)
    for begin, opening in pushing_poses(scene.model_of("target"), scene.pose_of("target"), toward):
        script = Script(scene, opening=opening)
        touching = fingers_touch(scene, "target")
        script.move(shifted(begin, 0.1), name="approach", free=True)
        script.move(begin, name="descend", speed=0.6)
        script.set_entity("target", pose=along(scene.pose_of("target"), toward, 0.14))
        script.move(along(begin, toward, 0.16), name="push", touching=touching)
        script.move(shifted(along(script.pose, toward, -0.06), 0.05), name="back_off", touching=touching)
        yield script.stages


@honest("push_object", change={"objects": {"target": {"models": {"values": ["sponge"]}}}})
def from_its_top(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Press the closed fingers on its top and slide it over the table."""
    toward, model = direction(scene), scene.model_of("target")
    now = scene.pose_of("target")
    for turn in (0.0, np.pi / 2):
        from scipy.spatial.transform import Rotation

        down = Rotation.from_euler("z", turn) * Rotation.from_euler("x", np.pi)
        top = Pose.from_arrays(np.add(now.position, (0, 0, model.size[2] - model.rest_height + 0.004)), down)
        script = Script(scene, opening=0.0)
        touching = fingers_touch(scene, "target")
        script.move(shifted(top, 0.1), name="approach", free=True)
        script.move(top, name="press", speed=0.3, touching=touching)
        script.set_entity("target", pose=along(now, toward, 0.12))
        script.move(along(top, toward, 0.12), name="slide", speed=0.5, touching=touching)
        script.move(shifted(script.pose, 0.1), name="rise", touching=touching)
        yield script.stages


@honest("stack", change=on("wooden_block"))
def base_nudged(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Push the base 1 cm aside before stacking."""
    yield from _nudged(scene, "support", 0.01)


def _nudged(scene: ExpertScene, entity: str, way_m: float) -> Iterator[tuple[Stage, ...]]:
    for x, y in around(1.0):
        unit = np.array([x, y, 0.0])
        shift = tuple((unit * way_m).tolist())
        for begin, opening in list(pushing_poses(scene.model_of(entity), scene.pose_of(entity), unit))[:4]:
            for grasp, goal in list(own_ways(scene))[:4]:
                script = Script(scene, opening=opening)
                push(script, begin, way_m, entity=entity, toward=unit)
                script.pick("target", grasp)
                script.place(displaced(goal, *shift), onto=entity if entity == "support" else TABLE)
                yield script.stages


@honest("rotate", change=CUBES)
def without_lifting(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Grasp it and turn it on the table without lifting it."""
    for grasp, goal in own_ways(scene):
        script = Script(scene)
        script.pick("target", grasp, lift_m=0.0)
        script.move(goal @ script.held_in_tcp.inverse(), name="turn", speed=0.6, touching=(("target", TABLE),))
        script.release(goal)
        yield script.stages
