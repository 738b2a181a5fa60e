"""Trials of ``push_button``."""

from __future__ import annotations

import math
from collections.abc import Iterator

from roboxim_core.poses import Pose
from roboxim_tasks.motion import ExpertScene, Stage, fingers_touch, retreated, shifted
from roboxim_tasks.script import Script
from roboxim_tasks.skills.push_button import DEPTH_M, YAWS, button_face, pressed_pose
from roboxim_tasks.trials.base import cheat, honest
from roboxim_tasks.trials.moves import own_stages, slowed

APPROACH_M = 0.08
OTHER_BUTTON = {
    "objects": {"target": {"modifiers": {"color": {"values": ["red", "green"]}}}},
    "distractors": {
        "minimum": 1, "maximum": 1, "models": {"values": ["button"]},
        "modifiers": {"color": {"values": ["blue", "yellow"]}},
    },
}  # fmt: skip


def presses(scene: ExpertScene, entity: str, change: Pose, opening: float = 0.0) -> Iterator[tuple[Stage, ...]]:
    """Yield ways to press a button with the expert's tool pose changed by a pose in the tool's frame."""
    face = button_face(scene.model_of(entity), scene.pose_of(entity))
    for yaw in YAWS:
        pressed = pressed_pose(face, yaw) @ change
        script = Script(scene, opening=opening)
        script.move(retreated(pressed, APPROACH_M), name="approach", free=True)
        script.move(pressed, name="press", speed=0.6, touching=fingers_touch(scene, entity))
        script.wait(0.3)
        script.move(retreated(pressed, APPROACH_M), name="withdraw", touching=fingers_touch(scene, entity))
        yield script.stages


@cheat("push_button", reason="not_pressed")
def half_way(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Press it in by 3.5 mm."""
    yield from presses(scene, "target", Pose(position=(0.0, 0.0, -0.006 - DEPTH_M)))


@cheat("push_button", reason="not_pressed")
def on_its_box(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Press beside the button, on its box."""
    yield from presses(scene, "target", Pose(position=(0.043, 0.0, 0.0)))


@cheat("push_button", reason="pressed_other_button", change=OTHER_BUTTON)
def other_button(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Press the other button."""
    yield from presses(scene, "distractor_1", Pose())


@cheat("push_button", reason="not_by_finger")
def side_of_the_hand(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Lay the hand on its side and press with it."""
    from scipy.spatial.transform import Rotation

    face = button_face(scene.model_of("target"), scene.pose_of("target"))
    back_m, half_m = 0.07, 0.032  # from the tool centre point to the middle of the hand; half of the hand's thickness
    for heading in (0.0, 0.5, -0.5, 1.0, -1.0, 1.5, -1.5):
        for flat in (0.0, math.pi):
            turn = Rotation.from_euler("z", heading) * Rotation.from_euler("y", math.pi / 2)
            level = Pose.from_arrays((0.0, 0.0, 0.0), turn * Rotation.from_euler("z", flat))
            x, y, z = face.position + level.rotation.apply((0.0, 0.0, back_m))
            pressed = Pose.from_arrays((x, y, z + half_m - DEPTH_M), level.rotation)
            script = Script(scene, opening=0.0)
            script.move(shifted(pressed, APPROACH_M), name="approach")
            script.move(pressed, name="press", speed=0.6)
            script.wait(0.3)
            script.move(shifted(pressed, APPROACH_M), name="withdraw")
            yield script.stages


@honest("push_button")
def slowly(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """As the expert does, at a third of its speed."""
    yield from map(slowed, own_stages(scene))


@honest("push_button")
def one_finger(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Open the gripper half and press with one finger alone."""
    yield from presses(scene, "target", Pose(position=(0.0, 0.02, 0.0)), opening=0.5)


@honest("push_button")
def off_the_middle(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Press 1.5 cm from the middle."""
    yield from presses(scene, "target", Pose(position=(0.015, 0.0, 0.0)))


@honest("push_button")
def leaning(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Press with the hand tilted by 15 degrees."""
    from scipy.spatial.transform import Rotation

    for side in (1.0, -1.0):
        yield from presses(scene, "target", Pose.from_arrays((0.0, 0.0, 0.0), Rotation.from_euler("y", side * 0.26)))
