"""Trials of ``open_drawer`` and ``close_drawer``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from roboxim_core.poses import Array, Pose
from roboxim_tasks.motion import ExpertScene, Stage, fingers_touch, retreated
from roboxim_tasks.script import Script
from roboxim_tasks.skills.close_drawer import FINGER_M, STANDOFF_M
from roboxim_tasks.skills.drawers import handle_grasps, handle_of, moved_by, opening_axis
from roboxim_tasks.skills.open_drawer import GRASP_OPENING
from roboxim_tasks.trials.base import cheat, honest
from roboxim_tasks.trials.moves import own_stages, slowed, without

APPROACH_M = 0.08
DRAWERS = ("top", "middle", "bottom")
FRONT_M = 0.051
"""Distance from the handle's bar, where fingers touch it from outside, to the drawer's front [m]."""


@dataclass(frozen=True, kw_only=True)
class Drawer:
    """Geometry of a drawer in the robot's base."""

    scene: ExpertScene
    """The scene."""
    axis: Array
    """Unit vector along which the drawer opens, in the base, shape (3,)."""
    open_m: float
    """Opening of the drawer [m]."""
    joint: str
    """Its joint."""
    grasps: tuple[Pose, ...]
    """Tool poses that grasp the handle, best first, in the base."""

    @property
    def touching(self) -> tuple[tuple[str, str], ...]:
        """Pairs that may touch while the drawer is moved."""
        return fingers_touch(self.scene, "target")

    def grasped(self, grasp: Pose) -> Script:
        """Return a script that grasps the handle."""
        script = Script(self.scene)
        script.opening = GRASP_OPENING
        script.move(retreated(grasp, APPROACH_M), name="approach", free=True)
        script.move(grasp, name="reach", speed=0.6, touching=self.touching)
        script.grip(0.0, name="close")
        return script

    def move(self, script: Script, way_m: float, speed: float = 0.6) -> None:
        """Move the hand with the drawer along the drawer's axis [m], and record the drawer's new position."""
        way = script.pose, self.axis * way_m
        script.move(moved_by(*way), name="move", speed=speed, touching=self.touching)
        script.set_entity("target", joints={self.joint: max(0.0, self.open_m + way_m)})

    def leave(self, script: Script) -> None:
        """Release the handle and retreat."""
        script.grip(GRASP_OPENING, name="release")
        script.move(retreated(script.pose, APPROACH_M), name="retreat", touching=self.touching)

    def pulled(self, way_m: float) -> Iterator[tuple[Stage, ...]]:
        """Yield ways to grasp the handle, pull the drawer by a length [m] and leave it."""
        for grasp in self.grasps:
            script = self.grasped(grasp)
            self.move(script, way_m)
            self.leave(script)
            yield script.stages


def drawer_of(scene: ExpertScene, name: str = "") -> Drawer:
    """Return a drawer by name; without a name, the task's drawer."""
    model, base, state = scene.model_of("target"), scene.pose_of("target"), scene.state.entity("target")
    handle = handle_of(model, name or str(scene.task.arguments["drawer"]))
    joints = dict(zip(state.joint_names, state.joint_positions, strict=True))
    return Drawer(
        scene=scene, axis=opening_axis(model, handle, base), open_m=joints[handle.joint], joint=handle.joint,
        grasps=tuple(handle_grasps(model, handle, base, joints)),
    )  # fmt: skip


# ------------------------------------------------------------------ open_drawer


@cheat("open_drawer", reason="not_opened")
def half_way(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Pull it open by 6 cm."""
    yield from drawer_of(scene).pulled(0.06)


@cheat("open_drawer", reason="not_released")
def hold_on(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Pull it open and hold on to the handle."""
    for stages in own_stages(scene):
        yield without(stages, "release", "retreat")


@cheat("open_drawer", reason="still_held")
def stay_round_the_handle(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Pull it open and open the fingers, but stay around the handle."""
    for stages in own_stages(scene):
        yield without(stages, "retreat")


@cheat("open_drawer", reason="not_opened")
def another_drawer(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Open another drawer."""
    other = next(name for name in DRAWERS if name != scene.task.arguments["drawer"])
    yield from drawer_of(scene, other).pulled(0.12)


@honest("open_drawer", "close_drawer")
def slowly(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """As the expert does, at a third of its speed."""
    yield from map(slowed, own_stages(scene))


@honest("open_drawer")
def farther(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Pull it open by 13.5 cm."""
    yield from drawer_of(scene).pulled(0.135)


@honest("open_drawer")
def in_two_pulls(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Pull it open by half, let go, grasp the handle anew and pull again."""
    drawer = drawer_of(scene)
    for grasp in drawer.grasps:
        script = drawer.grasped(grasp)
        drawer.move(script, 0.06)
        drawer.leave(script)
        script.move(moved_by(grasp, drawer.axis * 0.06), name="reach", speed=0.6, touching=drawer.touching)
        script.grip(0.0, name="close")
        drawer.move(script, 0.06)
        script.set_entity("target", joints={drawer.joint: drawer.open_m + 0.12})
        drawer.leave(script)
        yield script.stages


# ------------------------------------------------------------------ close_drawer


def pushes(
    scene: ExpertScene,
    short_m: float,
    *,
    sideways_m: float = 0.0,
    down_m: float = 0.0,
    deeper_m: float = 0.0,
    leave: bool = True,
) -> Iterator[Script]:
    """Yield scripts that push with the closed fingers until the drawer is open by a length.

    Args:
        scene: The scene.
        short_m: Opening of the drawer at the end [m].
        sideways_m: Distance of the push beside the middle of the handle's bar [m].
        down_m: Distance of the push below it [m].
        deeper_m: Distance of the pushed surface behind the bar [m].
        leave: Whether to withdraw.
    """
    drawer = drawer_of(scene)
    side = np.array([-drawer.axis[1], drawer.axis[0], 0.0])
    for grasp in drawer.grasps:
        script = Script(scene)
        script.opening = 0.0
        away = drawer.axis * (FINGER_M + STANDOFF_M - deeper_m) + side * sideways_m - (0.0, 0.0, down_m)
        begin = moved_by(grasp, away)
        script.move(retreated(begin, APPROACH_M), name="approach", free=True)
        script.move(begin, name="reach")
        script.set_entity("target", joints={drawer.joint: short_m})
        end = moved_by(begin, -drawer.axis * (drawer.open_m - short_m + STANDOFF_M + 0.002))
        script.move(end, name="push", speed=0.6, touching=drawer.touching)
        script.wait(0.3)
        if leave:
            script.move(moved_by(end, drawer.axis * STANDOFF_M), name="withdraw", touching=drawer.touching)
            script.move(retreated(script.pose, APPROACH_M), name="retreat", touching=drawer.touching)
        else:
            script.wait(2.0)
        yield script


@cheat("close_drawer", reason="not_shut")
def half_shut(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Push it until it is open by 3 cm."""
    yield from (script.stages for script in pushes(scene, 0.03))


@cheat("close_drawer", reason="still_held")
def stay_at_it(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Push it shut and leave the fingers at its handle."""
    yield from (script.stages for script in pushes(scene, 0.0, leave=False))


@cheat("close_drawer", reason="still_held")
def stay_round_the_shut_handle(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Grasp the handle, push the drawer shut and open the fingers, but stay around the handle."""
    drawer = drawer_of(scene)
    for grasp in drawer.grasps:
        script = drawer.grasped(grasp)
        drawer.move(script, -drawer.open_m)
        script.grip(GRASP_OPENING, name="open")
        script.wait(2.0)
        yield script.stages


@honest("close_drawer")
def low_on_the_bar(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Push the handle 1.2 cm below its middle."""
    yield from (script.stages for script in pushes(scene, 0.0, down_m=0.012))


@honest("close_drawer", change={"arguments": {"drawer": {"values": ["top"]}}})
def beside_the_handle(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Push the front of the top drawer 5 cm beside its handle."""
    for side_m in (0.05, -0.05):
        yield from (script.stages for script in pushes(scene, 0.0, sideways_m=side_m, deeper_m=FRONT_M))


@honest("close_drawer")
def in_two_pushes(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Push it half shut, withdraw, and push it shut."""
    drawer = drawer_of(scene)
    for script in pushes(scene, drawer.open_m / 2):
        script.move(script.pose @ Pose(position=(0.0, 0.0, APPROACH_M)), name="return", touching=drawer.touching)
        script.set_entity("target", joints={drawer.joint: 0.0})
        way_m = drawer.open_m / 2 + STANDOFF_M + 0.002
        script.move(moved_by(script.pose, -drawer.axis * way_m), name="push", speed=0.6, touching=drawer.touching)
        script.wait(0.3)
        script.move(moved_by(script.pose, drawer.axis * STANDOFF_M), name="withdraw", touching=drawer.touching)
        script.move(retreated(script.pose, APPROACH_M), name="retreat", touching=drawer.touching)
        yield script.stages
