"""Trials in which the hand lets go of the target while it moves, or hits it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from roboxim_core.poses import Array, Pose
from roboxim_tasks.motion import ExpertScene, Stage
from roboxim_tasks.script import Script
from roboxim_tasks.trials.base import cheat
from roboxim_tasks.trials.moves import around, displaced, own_ways
from roboxim_tasks.trials.neighbours import vector
from roboxim_tasks.trials.place_on import on
from roboxim_tasks.trials.place_relation import RED_AND_BLUE, direction
from roboxim_tasks.trials.placing import CUBES, RELATIONS

FAST = 2.3
"""Speed of a throw as a multiple of the expert's: 0.46 m/s, just below the limit of actions."""
RUN_UP_M = 0.26
"""Way of the closed hand at the beginning of a throw [m]; it reaches its speed after 9 cm."""
LAG_M = 0.11
"""Way by which the hand lags behind its stages at full speed, because the motion is smoothed [m]."""
FOLLOW_M = 0.12
"""Way of the opening hand at the end of a throw [m]."""


def thrown(script: Script, goal: Pose, toward: Array, *, ahead_m: float, height_m: float) -> None:
    """Throw the held object to a goal: swing the hand past it and open the fingers on the way.

    Args:
        script: The script, with the object in the hand.
        goal: Pose of the object where it shall come to rest.
        toward: Horizontal unit vector of the throw in the base, shape (3,).
        ahead_m: Distance before the goal at which the fingers begin to open [m].
        height_m: Height of the throw above the goal [m].
    """
    at = displaced(goal, z=height_m) @ script.held_in_tcp.inverse()
    let_go = displaced(at, *((LAG_M - ahead_m) * toward).tolist())
    begin = displaced(let_go, *(-RUN_UP_M * toward).tolist())
    script.carry(begin)
    script.move(begin, name="take_aim", speed=0.6)
    script.wait(0.3)
    script.move(let_go, name="swing", speed=FAST)
    script.opening = 1.0
    script.move(displaced(let_go, *(FOLLOW_M * toward).tolist()), name="throw", speed=FAST)
    script.wait(0.3)
    script.move(displaced(script.pose, z=0.12), name="rise")
    script.wait(1.5)


def throws(
    scene: ExpertScene, ways: tuple[Array, ...], *, ahead_m: float, height_m: float, beyond: Array | None = None
) -> Iterator[tuple[Stage, ...]]:
    """Yield throws of the target to its goal, or a vector beyond it [m], in one of some directions."""
    for grasp, near in own_ways(scene):
        goal = near if beyond is None else displaced(near, *beyond.tolist())
        for toward in ways:
            script = Script(scene)
            script.pick("target", grasp)
            thrown(script, goal, toward, ahead_m=ahead_m, height_m=height_m)
            yield script.stages


@cheat(*RELATIONS, reason="tossed", change=RED_AND_BLUE)
def toss(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Throw it there: open the fingers while the hand moves at 0.46 m/s."""
    toward = direction(scene)
    side = np.array([-toward[1], toward[0], 0.0])
    yield from throws(scene, (side, -side), ahead_m=0.04, height_m=0.04, beyond=0.05 * toward)


def _toss_onto(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Throw it there: open the fingers while the hand moves at 0.46 m/s."""
    yield from throws(scene, tuple(map(vector, around(1.0))), ahead_m=0.04, height_m=0.04)


def _toss_into(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Throw it in from 12 cm above its place: open the fingers while the hand moves at 0.46 m/s."""
    yield from throws(scene, tuple(map(vector, around(1.0))), ahead_m=0.07, height_m=0.12)


_toss_onto.__name__ = _toss_into.__name__ = "toss"
cheat("place_on", reason="tossed", change=on("tray"))(_toss_onto)
cheat("put_into", reason="tossed", change=CUBES)(_toss_into)
