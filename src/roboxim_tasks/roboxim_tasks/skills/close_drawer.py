"""Push an open drawer shut.

Randomisation: the cabinet's place, yaw and colour; how far the drawer is open; where the end effector starts;
distractors.

Success: the drawer is open by less than ``shut_m`` and still, the other drawers have moved by less than 2 cm, and the
robot does not touch the cabinet, for ``hold_s``.

Non-obvious:
    - The closed fingers push the handle's bar. A drawer runs in rails, so one point of contact suffices.
    - The fingers go 2 mm farther than the drawer, because its friction would hold it wherever the push ends.
    - What lies in the drawer moves with it.
    - The fingers dwell there, because the reference rounds corners where it does not stop.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from roboxim_core.errors import ConfigError
from roboxim_core.models.description import ObjectModel
from roboxim_core.poses import Pose
from roboxim_core.specs import TaskSpec
from roboxim_core.state import StateRecord
from roboxim_tasks.components import Constraint, ResetContext
from roboxim_tasks.measures import Condition, Conditions
from roboxim_tasks.motion import ExpertScene, Stage, fingers_touch, retreated
from roboxim_tasks.reach import start_clear
from roboxim_tasks.sampling.generators import GenerationContext
from roboxim_tasks.script import SLOW, Script
from roboxim_tasks.skills.base import Evaluator, Role, Skill, parameters_of, register
from roboxim_tasks.skills.drawers import (
    APPROACH_M,
    CABINET_PLACES,
    drawer_contents,
    drawer_position,
    drawer_rests,
    generate_drawer_task,
    handle_grasps,
    handle_of,
    handle_reachable,
    joint_of,
    moved_by,
    not_there_already,
    opening_axis,
    way_clear,
)

FINGER_M = 0.022
"""Distance from the middle of the bar to the tool centre point when the leaning fingertips touch the bar [m]."""
STANDOFF_M = 0.015
OVERSHOOT_M = 0.002
DWELL_S = 0.2


@dataclass(frozen=True, kw_only=True)
class CloseDrawerParameters:
    """Drawer to close, and thresholds of success."""

    drawer: str = "top"
    """Name of the drawer, which is the name of its handle."""
    shut_m: float = 0.01
    """Largest opening that counts as shut [m]."""
    hold_s: float = 0.3
    """Time that the drawer must stay shut [s]."""
    joint: str = ""
    """Name of the drawer's joint; set by the generator."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: When a threshold is out of range.
        """
        if not 0 < self.shut_m <= 0.03 or self.hold_s < 0:
            raise ConfigError(f"needs 0 < shut_m <= 0.03 and hold_s >= 0, got {self}")


@register
class CloseDrawer(Skill):
    """Generator, resetter, executor and evaluator of ``close_drawer``."""

    name = "close_drawer"
    roles = {"target": Role(affordance="openable", models=("cabinet",))}
    words = ("drawer",)
    templates = (
        "Close the {drawer} drawer",
        "Push the {drawer} drawer shut",
        "Close the {drawer} drawer of the {target}",
    )
    components = ("robot", "objects", "joints", "distractors", "cameras", "lights")
    reset = {
        "objects": {**CABINET_PLACES, "area": {"lower": [0.70, -0.22], "upper": [0.80, 0.22]}},
        "joints": {"target": {"lower": 0.6, "upper": 1.0}},
    }
    max_steps = 150
    Parameters = CloseDrawerParameters

    def check(self, parameters: Any, models: Mapping[str, Sequence[ObjectModel]]) -> None:
        """Refuse a drawer that one of the models lacks."""
        for model in models["target"]:
            handle_of(model, parameters.drawer)

    def generate(self, context: GenerationContext) -> TaskSpec:
        """Draw a task."""
        return generate_drawer_task(context)

    def constraints(self, context: ResetContext) -> Sequence[Constraint]:
        """Require a drawer that is not shut yet, that the arm can push, and no object in its place."""
        shut_m = parameters_of(context.task, CloseDrawerParameters).shut_m
        return (
            not_there_already(context, "target", lambda position_m: position_m <= shut_m),
            way_clear(context, "target"),
            handle_reachable(context, "target", 0.0, FINGER_M + STANDOFF_M),
            start_clear(context),
        )

    def stages(self, scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
        """Approach the front of the handle with closed fingers, push, withdraw."""
        parameters: CloseDrawerParameters = parameters_of(scene.task, CloseDrawerParameters)
        cabinet = scene.task.objects["target"].entity
        model, base, state = scene.model_of(cabinet), scene.pose_of(cabinet), scene.state.entity(cabinet)
        handle = handle_of(model, parameters.drawer)
        joints = dict(zip(state.joint_names, state.joint_positions, strict=True))
        axis = opening_axis(model, handle, base)
        travel_m = joints[handle.joint] - joint_of(model, handle).lower
        touching = fingers_touch(scene, cabinet)
        inside = drawer_contents(scene, cabinet, parameters.drawer)
        for grasp in handle_grasps(model, handle, base, joints):
            touch = moved_by(grasp, axis * FINGER_M)
            begin = moved_by(touch, axis * STANDOFF_M)
            script = Script(scene)
            script.opening = 0.0
            script.move(retreated(begin, APPROACH_M), name="approach", free=True)
            script.move(begin, name="reach")
            script.set_entity(cabinet, joints={handle.joint: 0.0})
            for name in inside:
                script.set_entity(name, pose=moved_by(scene.pose_of(name), -axis * travel_m))
            script.move(moved_by(touch, -axis * (travel_m + OVERSHOOT_M)), name="push", speed=SLOW, touching=touching)
            script.wait(DWELL_S, name="dwell")
            script.move(moved_by(script.pose, axis * STANDOFF_M), name="withdraw", touching=touching)
            script.move(script.pose @ Pose(position=(0.0, 0.0, -APPROACH_M)), name="retreat", touching=touching)
            yield script.stages

    def evaluator(self, task: TaskSpec, initial: StateRecord) -> Evaluator:
        """Judge: shut, still, let go, and no other drawer moved."""
        parameters: CloseDrawerParameters = parameters_of(task, CloseDrawerParameters)
        shut = Condition(name="shut", measure=drawer_position(task), most=parameters.shut_m)
        return Conditions(drawer_rests(task, initial, shut), hold_s=parameters.hold_s)
