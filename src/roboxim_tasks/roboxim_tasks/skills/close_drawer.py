"""Push an open drawer shut.

Randomisation: the cabinet's place, yaw and colour; how far the drawer is open; where the end effector starts;
distractors.

Success: the drawer is open by less than ``shut_m`` and still, the other drawers have moved by less than 2 cm, and the
robot does not touch the cabinet, for ``hold_s``.

Non-obvious:
    - The closed fingers push the handle's bar. A drawer runs in rails, so one point of contact suffices.
    - The fingers go 2 mm farther than the drawer, because friction would stop it where the push ends.
    - What lies in the drawer moves with it.
    - The fingers dwell there, because the reference rounds corners where it does not stop.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from roboxim_core.errors import ConfigError
from roboxim_core.models.description import ObjectModel
from roboxim_core.specs import TaskSpec
from roboxim_core.state import StateRecord
from roboxim_tasks.components import Constraint, ResetContext
from roboxim_tasks.measures import Condition, Conditions, joint_position
from roboxim_tasks.motion import ExpertScene, Stage
from roboxim_tasks.reach import start_clear
from roboxim_tasks.sampling.generators import GenerationContext
from roboxim_tasks.skills.base import Evaluator, Role, Skill, parameters_of, register
from roboxim_tasks.skills.parts import (
    BEHIND_THE_MIDDLE,
    FINGER_M,
    STANDOFF_M,
    generate_part_task,
    handle_of,
    handle_reachable,
    not_there_already,
    part_in,
    part_rests,
    pushed_shut,
    way_clear,
)
from roboxim_tasks.skills.placing import contents


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
        "objects": {**BEHIND_THE_MIDDLE, "area": {"lower": [0.70, -0.22], "upper": [0.80, 0.22]}},
        "joints": {"target": {"lower": 0.6, "upper": 1.0}},
    }
    rotations = 3
    max_steps = 150
    Parameters = CloseDrawerParameters

    def check(self, parameters: Any, models: Mapping[str, Sequence[ObjectModel]]) -> None:
        """Refuse a drawer that one of the models lacks."""
        for model in models["target"]:
            handle_of(model, parameters.drawer)

    def generate(self, context: GenerationContext) -> TaskSpec:
        """Draw a task."""
        return generate_part_task(context, "drawer", {"drawer": context.parameters.drawer})

    def constraints(self, context: ResetContext) -> Sequence[Constraint]:
        """Require a drawer that is not shut yet, that the arm can push, and no object in its place."""
        shut_m = parameters_of(context.task, CloseDrawerParameters).shut_m
        return (
            not_there_already(context, "target", lambda position_m: position_m <= shut_m),
            way_clear(context, "target"),
            handle_reachable(context, "target", lambda part: part.joint.lower, FINGER_M + STANDOFF_M),
            start_clear(context),
        )

    def stages(self, scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
        """Approach the front of the handle with closed fingers, push, withdraw."""
        parameters: CloseDrawerParameters = parameters_of(scene.task, CloseDrawerParameters)
        cabinet, drawer = scene.task.objects["target"].entity, parameters.drawer
        model = scene.model_of(cabinet)
        part = part_in(scene, cabinet, handle_of(model, drawer))
        regions = [region for region in model.regions if region.kind == "interior" and region.name == drawer]
        inside = [name for region in regions[:1] for name in contents(scene, cabinet, region)]
        for grasp in part.grasps():
            yield pushed_shut(scene, cabinet, part, grasp, inside)

    def evaluator(self, task: TaskSpec, initial: StateRecord) -> Evaluator:
        """Judge: shut, still, let go, and no other drawer moved."""
        parameters: CloseDrawerParameters = parameters_of(task, CloseDrawerParameters)
        position = joint_position(task.objects["target"].entity, parameters.joint, "drawer_m")
        shut = Condition(name="shut", measure=position, most=parameters.shut_m)
        return Conditions(part_rests(task, initial, shut), hold_s=parameters.hold_s)
