"""Trials of ``push_object``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

from roboxim_core.poses import Array, Pose
from roboxim_tasks.motion import TABLE, ExpertScene, Stage, fingers_touch, grasps_of, shifted
from roboxim_tasks.script import Script
from roboxim_tasks.skills.push_object import BACK_OFF_M, STANDOFF_M, pushing_poses, way_m
from roboxim_tasks.trials.base import cheat, honest
from roboxim_tasks.trials.moves import displaced, own_stages, slowed, without
from roboxim_tasks.trials.place_relation import direction
from roboxim_tasks.trials.placing import CUBES

APPROACH_M = 0.1
WAY_M = 0.11


def along(pose: Pose, toward: Array, length_m: float) -> Pose:
    """Return a pose moved along a direction [m]."""
    return displaced(pose, *(toward * length_m).tolist())


def push(script: Script, begin: Pose, length_m: float, *, entity: str = "target", toward: Array | None = None) -> None:
    """Descend behind an object, push, withdraw, rise; the pose is that of the fingers behind it.

    Args:
        script: The script to extend.
        begin: Pose of the fingers behind the object.
        length_m: Length of the push [m].
        entity: The object.
        toward: Horizontal unit vector in the base, shape (3,); none: the task's direction.
    """
    toward = direction(script.scene) if toward is None else toward
    touching = fingers_touch(script.scene, entity)
    script.move(shifted(begin, APPROACH_M), name="approach", free=True)
    script.move(begin, name="descend", speed=0.6)
    script.set_entity(entity, pose=along(script.pose_of(entity), toward, length_m))
    script.move(along(begin, toward, length_m + STANDOFF_M), name="push", speed=0.6, touching=touching)
    script.wait(0.3)
    script.move(along(script.pose, toward, -BACK_OFF_M), name="back_off", touching=touching)
    script.move(shifted(script.pose, APPROACH_M), name="rise", touching=touching)


def starts(scene: ExpertScene) -> Iterator[tuple[Script, Pose]]:
    """Yield scripts with the gripper's opening, each with a pose from which the expert would push."""
    for pose, opening in pushing_poses(scene.model_of("target"), scene.pose_of("target"), direction(scene)):
        script = Script(scene, opening=opening)
        yield script, pose


def full_way(scene: ExpertScene) -> float:
    """Return the distance that the expert would push [m]."""
    return way_m(scene.model_of("target"), scene.pose_of("target"), direction(scene))


@cheat("push_object", reason="carried", change=CUBES)
def carry(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Grasp it, lift it by 2 cm, carry it there and set it down."""
    for grasp in grasps_of(scene, "target"):
        script = Script(scene)
        script.pick("target", grasp, lift_m=0.02)
        script.move(along(script.pose, direction(scene), WAY_M), name="carry")
        script.move(shifted(script.pose, -0.018), name="lower", speed=0.6, touching=(("target", TABLE),))
        script.release(along(scene.pose_of("target"), direction(scene), WAY_M))
        yield script.stages


@cheat("push_object", reason="carried", change=CUBES)
def drag(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Grasp it and drag it over the table without lifting it."""
    for grasp in grasps_of(scene, "target"):
        script = Script(scene)
        script.pick("target", grasp, lift_m=0.0)
        script.move(along(script.pose, direction(scene), WAY_M), name="drag", speed=0.6)
        script.release(along(scene.pose_of("target"), direction(scene), WAY_M))
        yield script.stages


@cheat("push_object", reason="not_pushed")
def too_short(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Push it by half the way."""
    for script, begin in starts(scene):
        push(script, begin, full_way(scene) - 0.06)
        yield script.stages


@cheat("push_object", reason="still_held", change=CUBES)
def stay_at_it(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Push it there and leave the fingers at it."""
    for script, begin in starts(scene):
        push(script, begin, full_way(scene))
        yield (*without(script.stages, "back_off", "rise"), Stage(name="stay", opening=script.opening, duration_s=2.0))


@honest("push_object")
def slowly(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """As the expert does, at a third of its speed."""
    yield from map(slowed, own_stages(scene))


@honest("push_object", change=CUBES)
def with_the_closed_hand(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Push with the back of a finger of the closed gripper."""
    for script, begin in starts(scene):
        if script.opening == 0.0:
            push(script, begin, full_way(scene))
            yield script.stages


@honest("push_object", change=CUBES)
def in_two_pushes(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Push it half the way, withdraw, and push it the rest."""
    for script, begin in starts(scene):
        half = full_way(scene) / 2
        push(script, begin, half)
        push(script, along(begin, direction(scene), half), half)
        yield script.stages


@honest("push_object", change=CUBES)
def low(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Push it 6 mm lower down than the expert does, with the fingers leaning back."""
    for script, begin in islice(starts(scene), 4, None):
        push(script, replace(begin, position=(*begin.position[:2], begin.position[2] - 0.006)), full_way(scene))
        yield script.stages
