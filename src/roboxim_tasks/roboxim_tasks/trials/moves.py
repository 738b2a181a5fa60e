"""Building blocks of the trials of many skills."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import wraps
from typing import Any

import numpy as np

from roboxim_core.poses import Pose, distance
from roboxim_tasks.motion import ExpertScene, Grasp, Stage
from roboxim_tasks.script import LIFT_M, Script
from roboxim_tasks.skills import SKILLS
from roboxim_tasks.trials.base import Stages

SLOWLY = 0.35
"""Speed of slow trials, as a fraction of the expert's."""
OTHER_RAD = 0.7
"""Least rotation of another grasp from the expert's grasp [rad]."""


def own_stages(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Yield the candidates of the skill's own executor."""
    return iter(SKILLS[scene.task.skill].stages(scene))


def own_ways(scene: ExpertScene) -> Iterator[tuple[Grasp, Pose]]:
    """Yield the grasps that the skill's own executor tries, each with the target's goal pose.

    Non-obvious: only for skills whose executors pick up the target. If the target stays in the hand, the pose is its
    present one.
    """
    entity, last = scene.task.objects["target"].entity, None
    for stages in own_stages(scene):
        by_name = {stage.name: stage for stage in stages}
        grasp, release = by_name["descend"], by_name.get("release", by_name["descend"])
        assert grasp.pose is not None
        moved = {state.name: scene.in_base(state.pose) for state in stages[-1].moved}
        way = (
            Grasp(pose=grasp.pose, opening=grasp.opening, release_opening=release.opening),
            moved.get(entity, scene.pose_of(entity)),
        )
        if way != last:
            yield way
        last = way


def other_grasps(scene: ExpertScene) -> Iterator[tuple[Grasp, Pose]]:
    """Yield the ways whose grasp is turned by `OTHER_RAD` or more from the first way's grasp."""
    first: Pose | None = None
    for grasp, goal in own_ways(scene):
        first = first or grasp.pose
        if distance(first, grasp.pose)[1] >= OTHER_RAD:
            yield grasp, goal


def slowed(stages: tuple[Stage, ...]) -> tuple[Stage, ...]:
    """Return stages at a fraction of their speed."""
    return tuple(replace(stage, speed=stage.speed * SLOWLY) for stage in stages)


def without(stages: tuple[Stage, ...], *names: str) -> tuple[Stage, ...]:
    """Return stages without those with some names."""
    return tuple(stage for stage in stages if stage.name not in names)


def caging(script: Script, entity: str, goal: Pose, onto: str) -> None:
    """Put the held object at a pose and open the fingers, but do not withdraw."""
    at = goal @ script.held_in_tcp.inverse()
    script.carry(at)
    script.move(at, name="lower", speed=0.6, touching=((entity, onto),))
    script.grip(1.0, name="open")
    script.wait(2.0)


def set_aside(script: Script, entity: str, grasp: Grasp, shift: tuple[float, float]) -> Grasp:
    """Pick up an object, set it down beside its place, and return the same grasp of it there."""
    script.pick(entity, grasp)
    now = script.scene.pose_of(entity)
    there = replace(now, position=(now.position[0] + shift[0], now.position[1] + shift[1], now.position[2]))
    script.place(there)
    return replace(grasp, pose=there @ now.inverse() @ grasp.pose)


def around(length_m: float, count: int = 8) -> Iterator[tuple[float, float]]:
    """Yield horizontal vectors of a length in all directions [m]."""
    for angle in np.arange(count) * 2 * np.pi / count:
        yield float(length_m * np.cos(angle)), float(length_m * np.sin(angle))


def displaced(pose: Pose, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Pose:
    """Return a pose moved in its parent frame [m]."""
    return Pose.from_arrays(np.add(pose.position, (x, y, z)), pose.rotation)


def about_vertical(pose: Pose, angle_rad: float) -> Pose:
    """Return a pose turned about the vertical through its origin."""
    from scipy.spatial.transform import Rotation

    return Pose.from_arrays(pose.position, Rotation.from_euler("z", angle_rad) * pose.rotation)


def each_way(
    ways: Callable[[ExpertScene], Iterable[tuple[Grasp, Pose]]] = own_ways,
    *,
    over: Iterable[Any] = (),
    lift_m: float = LIFT_M,
) -> Callable[[Callable[..., object]], Stages]:
    """Return a decorator that makes a trial from an action with the target in the hand.

    The decorated function adds to a script that has picked up the target. It gets the script, the target's goal pose
    and, with ``over``, one of the variants.

    Args:
        ways: Yields the grasps to try, each with the goal pose.
        over: Variants of each way, tried in this order; empty: one without a variant.
        lift_m: Height of the lift after the grasp [m]; 0: no lift.
    """
    variants: list[tuple[Any, ...]] = [(variant,) for variant in over] or [()]

    def decorate(act: Callable[..., object]) -> Stages:
        @wraps(act)
        def stages(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
            for grasp, goal in ways(scene):
                for variant in variants:
                    script = Script(scene)
                    script.pick("target", grasp, lift_m=lift_m)
                    act(script, goal, *variant)
                    yield script.stages

        return stages

    return decorate
