"""Trials of drawers, buttons and pushes that a person would judge by the final scene."""

from __future__ import annotations

from collections.abc import Iterator

from roboxim_tasks.motion import ExpertScene, Stage, fingers_touch, grasps_of, retreated, shifted
from roboxim_tasks.script import Script
from roboxim_tasks.skills.push_button import YAWS, button_face, pressed_pose
from roboxim_tasks.skills.push_object import pushing_poses
from roboxim_tasks.trials.base import cheat, honest
from roboxim_tasks.trials.moves import own_stages
from roboxim_tasks.trials.neighbours import OTHER, beside_a, colored, put_against
from roboxim_tasks.trials.parts import DRAWERS, moving
from roboxim_tasks.trials.place_relation import direction
from roboxim_tasks.trials.placing import CUBES
from roboxim_tasks.trials.push_button import OTHER_BUTTON
from roboxim_tasks.trials.push_object import along, full_way, push, starts

# ------------------------------------------------------------------ drawers


@cheat("open_drawer", reason="moved_other_drawer", change={"arguments": {"drawer": {"values": ["top"]}}})
def two_drawers(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Open a lower drawer first, and then the named top one."""
    for other in reversed(DRAWERS[1:]):
        first = moving(scene, other)
        for opened in first.moved(0.08):
            for stages in own_stages(scene):
                yield opened + stages


# ------------------------------------------------------------------ buttons


@cheat("push_button", reason="pressed_other_button", change=OTHER_BUTTON)
def both_buttons(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Press the other button first, and then the named one."""
    face = button_face(scene.model_of(OTHER), scene.pose_of(OTHER))
    for yaw in YAWS:
        pressed = pressed_pose(face, yaw)
        script = Script(scene, opening=0.0)
        script.move(retreated(pressed, 0.08), name="approach")
        script.move(pressed, name="press", speed=0.6)
        script.wait(0.3)
        script.move(retreated(pressed, 0.08), name="withdraw")
        for stages in own_stages(scene):
            yield script.stages + stages


@honest("push_button")
def tapped(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Tap it: press it at full speed and withdraw at once."""
    face = button_face(scene.model_of("target"), scene.pose_of("target"))
    touching = fingers_touch(scene, "target")
    for yaw in YAWS:
        pressed = pressed_pose(face, yaw)
        script = Script(scene, opening=0.0)
        script.move(retreated(pressed, 0.08), name="approach", free=True)
        script.move(pressed, name="press", speed=1.5, touching=touching)
        script.wait(0.1)
        script.move(retreated(pressed, 0.08), name="withdraw", speed=1.5, touching=touching)
        script.wait(0.5)
        yield script.stages


# ------------------------------------------------------------------ pushes


CAN = {"objects": {"target": {"models": {"values": ["soda_can"]}}}}
"""Changes to the task: the target is a can, which is tall enough to topple."""


@cheat("push_object", reason="toppled", change=CAN)
def tip_it_over(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Push it near its top, so that it falls over in that direction."""
    toward = direction(scene)
    for begin, _ in pushing_poses(scene.model_of("target"), scene.pose_of("target"), toward):
        script = Script(scene, opening=0.0)
        high = shifted(begin, 0.085)
        script.move(shifted(high, 0.1), name="approach")
        script.move(high, name="descend")
        script.move(along(high, toward, 0.12), name="push", speed=1.5)
        script.move(shifted(along(script.pose, toward, -0.03), 0.1), name="rise")
        script.wait(1.5)
        yield script.stages


@cheat("push_object", reason="pushed_another_too", change=beside_a("cube", colored("target", "cube", "red"), "blue"))
def by_another(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Put another object behind it, and push that one against it."""
    toward = direction(scene)
    behind = put_against(scene, OTHER, "target", -toward, 0.008)
    for start, begin in starts(scene):
        for grasp in grasps_of(scene, OTHER)[:4]:
            script = Script(scene)
            script.pick(OTHER, grasp)
            script.place(behind)
            script.opening = start.opening
            push(script, along(begin, toward, -0.053), full_way(scene) + 0.02)
            yield script.stages


@honest("push_object", change=CUBES)
def farther(scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
    """Push it 5 cm farther than the expert does."""
    for script, begin in starts(scene):
        push(script, begin, full_way(scene) + 0.05)
        yield script.stages
