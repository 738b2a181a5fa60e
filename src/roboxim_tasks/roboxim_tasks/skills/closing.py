"""Push an open drawer or door shut: ``close_drawer``, ``close_door``.

Randomisation: the object's place, yaw and colour; how far the part is open; where the end effector starts; distractors.

Success: the part is open by less than ``shut_m`` or ``shut_rad`` and still, the object's other parts have moved by less
than 2 cm, and the robot does not touch the object, for ``hold_s``.

Non-obvious:
    - The closed fingers push the handle's bar, and turn with a door. A drawer runs in rails, so one point of contact
      suffices.
    - The fingers go 2 mm farther than the part, because friction would stop it where the push ends.
    - What lies in a drawer moves with it.
    - The fingers dwell there, because the reference rounds corners where it does not stop.
    - At a door the hand's heading nearest to the present one comes first: after a larger turn the arm begins near its
      limits, and the noise of a demonstration may then stop it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from roboxim_core.errors import ConfigError
from roboxim_core.poses import distance
from roboxim_tasks.components import Constraint, ResetContext
from roboxim_tasks.measures import Condition, Measure
from roboxim_tasks.motion import ExpertScene, Stage
from roboxim_tasks.reach import start_clear
from roboxim_tasks.skills.base import Role, parameters_of, register
from roboxim_tasks.skills.opening import PartSkill
from roboxim_tasks.skills.parts import (
    BEHIND_THE_MIDDLE,
    FINGER_M,
    STANDOFF_M,
    handle_of,
    handle_reachable,
    not_there_already,
    part_in,
    pushed_shut,
    way_clear,
)
from roboxim_tasks.skills.placing import contents


class ClosingSkill(PartSkill):
    """A skill that closes a part."""

    def constraints(self, context: ResetContext) -> Sequence[Constraint]:
        """Require a part that is not shut yet, that the arm can push, and no object in its place."""
        limit = getattr(parameters_of(context.task, self.Parameters), self.limit)
        return (
            not_there_already(context, "target", lambda position: position <= limit),
            way_clear(context, "target"),
            handle_reachable(context, "target", lambda part: part.joint.lower, FINGER_M + STANDOFF_M),
            start_clear(context),
        )

    def goal(self, opening: Measure, limit: float) -> Condition:
        """Require at most the parameter."""
        return Condition(name="shut", measure=opening, most=limit)


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
class CloseDrawer(ClosingSkill):
    """Generator, resetter, executor and evaluator of ``close_drawer``."""

    name = "close_drawer"
    roles = {"target": Role(affordance="openable", models=("cabinet",))}
    words = ("drawer",)
    templates = (
        "Close the {drawer} drawer",
        "Push the {drawer} drawer shut",
        "Close the {drawer} drawer of the {target}",
    )
    reset = {
        "objects": {**BEHIND_THE_MIDDLE, "area": {"lower": [0.70, -0.22], "upper": [0.80, 0.22]}},
        "joints": {"target": {"lower": 0.6, "upper": 1.0}},
    }
    Parameters = CloseDrawerParameters
    limit = "shut_m"
    opening = "drawer_m"

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


@dataclass(frozen=True, kw_only=True)
class CloseDoorParameters:
    """Thresholds of success."""

    shut_rad: float = 0.05
    """Largest opening that counts as shut [rad]."""
    hold_s: float = 0.3
    """Time that the door must stay shut [s]."""
    joint: str = ""
    """Name of the door's joint; set by the generator."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: When a threshold is out of range.
        """
        if not 0 < self.shut_rad <= 0.2 or self.hold_s < 0:
            raise ConfigError(f"needs 0 < shut_rad <= 0.2 and hold_s >= 0, got {self}")


@register
class CloseDoor(ClosingSkill):
    """Generator, resetter, executor and evaluator of ``close_door``."""

    name = "close_door"
    roles = {"target": Role(affordance="hinged", models=("microwave",))}
    templates = ("Close the {target}", "Close the door of the {target}", "Push the door of the {target} shut")
    reset = {"objects": BEHIND_THE_MIDDLE, "joints": {"target": {"lower": 0.3, "upper": 0.6}}}
    Parameters = CloseDoorParameters
    limit = "shut_rad"
    opening = "door_rad"

    def stages(self, scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
        """Approach the front of the handle with closed fingers, push it around, withdraw; least rotation first."""
        entity = scene.task.objects["target"].entity
        part = part_in(scene, entity, scene.model_of(entity).handles[0])
        for grasp in sorted(part.grasps(), key=lambda grasp: round(distance(scene.pose_tcp, grasp)[1], 3)):
            yield pushed_shut(scene, entity, part, grasp)
