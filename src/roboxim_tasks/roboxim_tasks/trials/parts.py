"""Trials of drawers, doors and knobs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from roboxim_core.poses import Pose
from roboxim_tasks.motion import ExpertScene, Stage, fingers_touch, retreated, shifted
from roboxim_tasks.script import Script
from roboxim_tasks.skills.parts import (
    APPROACH_M,
    FINGER_M,
    GRASP_OPENING,
    PRESS_M,
    STANDOFF_M,
    Part,
    handle_of,
    moved_by,
    part_in,
)
from roboxim_tasks.skills.rotate import DIRECTIONS
from roboxim_tasks.trials.base import cheat, honest
from roboxim_tasks.trials.moves import own_stages, slowed, without

DRAWERS = ("top", "middle", "bottom")
FRONT_M = 0.051
"""Distance from a drawer's handle, where fingers touch it from outside, to the drawer's front [m]."""
OTHER_KNOB = {
    "objects": {"target": {"modifiers": {"color": {"values": ["red", "green"]}}}},
    "distractors": {
        "minimum": 1, "maximum": 1, "models": {"values": ["knob"]},
        "modifiers": {"color": {"values": ["blue", "yellow"]}},
    },
}  # fmt: skip


@dataclass(kw_only=True)
class Moving:
    """A part in the robot's base, and how a script moves it."""

    scene: ExpertScene
    """The scene."""
    part: Part
    """The part where it is at first."""
    entity: str = "target"
    """Its object."""

    @property
    def touching(self) -> tuple[tuple[str, str], ...]:
        """Pairs that may touch while the part is moved."""
        return fingers_touch(self.scene, self.entity)

    def grasped(self, grasp: Pose) -> Script:
        """Return a script that grasps the handle."""
        script = Script(self.scene)
        script.opening = GRASP_OPENING
        script.move(retreated(grasp, APPROACH_M), name="approach", free=True)
        script.move(grasp, name="reach", speed=0.6, touching=self.touching)
        script.grip(0.0, name="close")
        return script

    def move(self, script: Script, begin: float, end: float) -> None:
        """Move the hand with the part from one joint position to another [m or rad], and record where the part is."""
        for position, pose in self.part.at(begin).way(script.pose, end):
            script.move(pose, name="move", speed=0.6, touching=self.touching)
            script.set_entity(self.entity, joints={self.part.handle.joint: position})

    def leave(self, script: Script) -> None:
        """Release the handle and retreat."""
        script.grip(GRASP_OPENING, name="release")
        script.move(retreated(script.pose, APPROACH_M), name="retreat", touching=self.touching)

    def moved(self, way: float, pulls: int = 1) -> Iterator[tuple[Stage, ...]]:
        """Yield ways to grasp the handle, move the part by a way [m or rad] and leave it, all in several pulls."""
        here = self.part.position
        for grasp in self.part.grasps():
            script = self.grasped(grasp)
            for pull in range(pulls):
                if pull:
                    script.move(retreated(script.pose, -APPROACH_M), name="reach", speed=0.6, touching=self.touching)
                    script.grip(0.0, name="close")
                self.move(script, here + way * pull / pulls, here + way * (pull + 1) / pulls)
                self.leave(script)
            yield script.stages


def moving(scene: ExpertScene, name: str = "", entity: str = "target") -> Moving:
    """Return a part by its handle's name; without a name, the task's part."""
    handles = scene.model_of(entity).handles
    joint = scene.task.arguments["joint"]
    handle = handle_of(scene.model_of(entity), name) if name else next(h for h in handles if h.joint == joint)
    return Moving(scene=scene, part=part_in(scene, entity, handle), entity=entity)


# ------------------------------------------------------------------ open_drawer, open_door


@cheat("open_drawer", reason="not_opened")
def half_way(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Pull it open by 6 cm."""
    yield from moving(scene).moved(0.06)


@cheat("open_door", reason="not_opened")
def ajar(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Pull it open by 0.5 rad."""
    yield from moving(scene).moved(0.5)


@cheat("open_drawer", "open_door", "turn_knob", reason="not_released")
def hold_on(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Do as the expert does, and hold on to the handle."""
    for stages in own_stages(scene):
        yield without(stages, "release", "retreat")


@cheat("open_drawer", "open_door", reason="still_held")
def stay_round_the_handle(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Pull it open and open the fingers, but stay around the handle."""
    for stages in own_stages(scene):
        yield without(stages, "retreat")


@cheat("open_drawer", reason="not_opened")
def another_drawer(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Open another drawer."""
    other = next(name for name in DRAWERS if name != scene.task.arguments["drawer"])
    yield from moving(scene, other).moved(0.12)


@honest("open_drawer", "close_drawer", "open_door", "close_door", "turn_knob")
def slowly(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """As the expert does, at a third of its speed."""
    yield from map(slowed, own_stages(scene))


@honest("open_drawer")
def farther(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Pull it open by 13.5 cm."""
    yield from moving(scene).moved(0.135)


@honest("open_door")
def wider(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Pull it open by 0.95 rad."""
    yield from moving(scene).moved(0.95)


@honest("open_drawer")
def in_two_pulls(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Pull it open by half, let go, grasp the handle anew and pull again."""
    yield from moving(scene).moved(0.12, pulls=2)


@honest("open_door")
def door_in_two_pulls(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Pull it open by half, let go, grasp the handle anew and pull again."""
    yield from moving(scene).moved(0.8, pulls=2)


# ------------------------------------------------------------------ close_drawer, close_door


def pushes(
    scene: ExpertScene,
    short: float,
    *,
    sideways_m: float = 0.0,
    down_m: float = 0.0,
    deeper_m: float = 0.0,
    leave: bool = True,
    times: int = 1,
) -> Iterator[Script]:
    """Yield scripts that push with the closed fingers until a part is open by a little.

    Args:
        scene: The scene.
        short: Position of the part at the end [m or rad].
        sideways_m: Distance of the push beside the middle of the handle's bar [m].
        down_m: Distance of the push below it [m].
        deeper_m: Distance of the pushed surface behind the bar [m].
        leave: Whether to withdraw.
        times: Number of pushes, each of the same way.
    """
    it = moving(scene)
    part, joint = it.part, it.part.handle.joint
    side = np.array([-part.opening[1], part.opening[0], 0.0])
    for grasp in part.grasps():
        script = Script(scene, opening=0.0)
        touch = moved_by(grasp, part.opening * (FINGER_M - deeper_m) + side * sideways_m - (0.0, 0.0, down_m))
        begin = moved_by(touch, part.opening * STANDOFF_M)
        script.move(retreated(begin, APPROACH_M), name="approach", free=True)
        script.move(begin, name="reach")
        here = part.position
        for time in range(times):
            goal = part.position + (short - part.position) * (time + 1) / times
            if time:
                script.move(retreated(script.pose, -APPROACH_M), name="return", touching=it.touching)
            for position, pose in part.at(here).way(touch, goal - PRESS_M / part.lever_m):
                script.set_entity("target", joints={joint: max(goal, position)})
                script.move(pose, name="push", speed=0.6, touching=it.touching)
            touch, here = script.pose, goal - PRESS_M / part.lever_m
            script.wait(0.3)
            if not leave:
                script.wait(2.0)
                break
            away = part.at(goal).opening * STANDOFF_M
            script.move(moved_by(script.pose, away), name="withdraw", touching=it.touching)
            script.move(retreated(script.pose, APPROACH_M), name="retreat", touching=it.touching)
        yield script


@cheat("close_drawer", reason="not_shut")
def half_shut(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Push it until it is open by 3 cm."""
    yield from (script.stages for script in pushes(scene, 0.03))


@cheat("close_door", reason="not_shut")
def left_ajar(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Push it until it is open by 0.15 rad."""
    yield from (script.stages for script in pushes(scene, 0.15))


@cheat("close_drawer", "close_door", reason="still_held")
def stay_at_it(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Push it shut and leave the fingers at its handle."""
    yield from (script.stages for script in pushes(scene, 0.0, leave=False))


@cheat("close_drawer", "close_door", reason="still_held")
def stay_round_the_shut_handle(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Grasp the handle, push it shut and open the fingers, but stay around the handle."""
    it = moving(scene)
    for grasp in it.part.grasps():
        script = it.grasped(grasp)
        it.move(script, it.part.position, 0.0)
        script.grip(GRASP_OPENING, name="open")
        script.wait(2.0)
        yield script.stages


@honest("close_drawer", "close_door")
def low_on_the_bar(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Push the handle 1.2 cm below its middle."""
    yield from (script.stages for script in pushes(scene, 0.0, down_m=0.012))


@honest("close_drawer", change={"arguments": {"drawer": {"values": ["top"]}}})
def beside_the_handle(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Push the front of the top drawer 5 cm beside its handle."""
    for side_m in (0.05, -0.05):
        yield from (script.stages for script in pushes(scene, 0.0, sideways_m=side_m, deeper_m=FRONT_M))


@honest("close_door")
def by_its_handle(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Grasp the handle, and carry the door shut."""
    it = moving(scene)
    yield from it.moved(-it.part.position)


@honest("close_drawer", "close_door")
def in_two_pushes(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Push it half shut, withdraw, and push it shut."""
    yield from (script.stages for script in pushes(scene, 0.0, times=2))


# ------------------------------------------------------------------ turn_knob


def turned(scene: ExpertScene, way_rad: float, pulls: int = 1) -> Iterator[tuple[Stage, ...]]:
    """Yield ways to turn the knob in the direction of the instruction [rad], in several grips."""
    yield from moving(scene).moved(DIRECTIONS[str(scene.task.arguments["direction"])] * way_rad, pulls)


@cheat("turn_knob", reason="not_turned")
def too_little(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Turn it by 0.6 rad."""
    yield from turned(scene, 0.6)


@cheat("turn_knob", reason="not_turned")
def the_other_way(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Turn it in the other direction."""
    yield from turned(scene, -0.95)


@cheat("turn_knob", reason="opened_other", change=OTHER_KNOB)
def other_knob(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Turn the other knob."""
    yield from moving(scene, entity="distractor_1").moved(0.95)  # it stands at the lower end of its travel


@cheat("turn_knob", reason="opened_other", change=OTHER_KNOB)
def both_knobs(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Turn the other knob first, and then the named one."""
    for first in moving(scene, entity="distractor_1").moved(0.5):
        for stages in own_stages(scene):
            yield first + stages


@honest("turn_knob")
def farther_round(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Turn it by 1.1 rad."""
    yield from turned(scene, 1.1)


@honest("turn_knob")
def in_two_grips(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Turn it by half, let go, hold it anew where it is, and turn it again."""
    yield from turned(scene, 0.96, pulls=2)


@honest("turn_knob")
def higher_up(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Hold the ridge 5 mm nearer to its top."""
    it = moving(scene)
    way = DIRECTIONS[str(scene.task.arguments["direction"])] * 0.95
    for grasp in it.part.grasps():
        script = it.grasped(shifted(grasp, 0.005))
        it.move(script, it.part.position, it.part.position + way)
        it.leave(script)
        yield script.stages
