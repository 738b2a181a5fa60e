"""Pick up an object.

Randomisation: which object and colour; where it lies and at what yaw; where the end effector starts; distractors that
do not fit the instruction.

Success: the object is more than ``lift_m`` above its initial height, pressed by at least two links of the robot, off
the table and carried by nothing else, for ``hold_s`` without a break.

Non-obvious: heights are relative to tick 0, so a task is never solved at its start. Forces are those of the tick's last
physics step, so a finger that only brushed the object within the tick does not count.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from roboxim_core.errors import ConfigError
from roboxim_core.specs import TaskSpec
from roboxim_core.state import StateRecord
from roboxim_tasks.components import Constraint, ResetContext
from roboxim_tasks.measures import (
    PROP_N,
    Condition,
    Conditions,
    above,
    fallen_off,
    highest_lift,
    lift,
    lowest_lift,
    pressing_links,
    table_force,
)
from roboxim_tasks.motion import ExpertScene, Stage, grasps_of
from roboxim_tasks.reach import graspable, start_clear
from roboxim_tasks.script import Script
from roboxim_tasks.skills.base import Evaluator, Role, Skill, parameters_of, register
from roboxim_tasks.standing import carried_by_others

LIFT_M = 0.12


@dataclass(frozen=True, kw_only=True)
class PickUpParameters:
    """Thresholds of success."""

    lift_m: float = 0.05
    """Height above the object's initial height [m]."""
    finger_force_n: float = 0.05
    """Normal force that each finger must exceed [N]."""
    hold_s: float = 0.5
    """Time that the object must stay lifted [s]."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: When a threshold is out of range.
        """
        if not 0 < self.lift_m <= 0.1 or self.finger_force_n < 0 or self.hold_s < 0:
            raise ConfigError(f"needs 0 < lift_m <= 0.1, finger_force_n >= 0 and hold_s >= 0, got {self}")


@register
class PickUp(Skill):
    """Generator, resetter, executor and evaluator of ``pick_up``."""

    name = "pick_up"
    roles = {"target": Role(affordance="graspable")}
    templates = ("Pick up the {target}", "Lift the {target}", "Grasp the {target} and lift it")
    max_steps = 100
    Parameters = PickUpParameters

    def constraints(self, context: ResetContext) -> Sequence[Constraint]:
        """Require that the arm can execute one grasp from approach to lift, and does not start at an object."""
        return (graspable(context, "target", lift_m=LIFT_M), start_clear(context))

    def stages(self, scene: ExpertScene) -> Iterator[tuple[Stage, ...]]:
        """Approach from above, descend, close, lift; one candidate per grasp, least rotation first."""
        entity = scene.task.objects["target"].entity
        for grasp in [None] if scene.held == entity else grasps_of(scene, entity):
            script = Script(scene)
            script.pick(entity, grasp, lift_m=LIFT_M)
            script.wait(1.0)
            yield script.stages

    def evaluator(self, task: TaskSpec, initial: StateRecord) -> Evaluator:
        """Judge: lifted, grasped and off the table, and nothing else lifted."""
        parameters: PickUpParameters = parameters_of(task, PickUpParameters)
        target = task.objects["target"].entity
        others = [entity.name for entity in initial.entities if entity.name != target]
        height, fingers = lift(target, initial), pressing_links(target, parameters.finger_force_n)
        return Conditions(
            (
                fallen_off(lowest_lift((target,), initial)),
                Condition(
                    name="others_left", measure=highest_lift(others, initial), most=parameters.lift_m,
                    reason="wrong_object_lifted",
                ),
                Condition(name="grasped", measure=fingers, least=2.0),
                Condition(name="lifted", measure=height, least=above(parameters.lift_m)),
                Condition(name="off_table", measure=table_force(target), most=0.0, reason="touches_table"),
                Condition(
                    name="in_the_air", measure=carried_by_others(target), most=PROP_N,
                    reason="rests_on_something",
                ),
            ),
            hold_s=parameters.hold_s,
        )  # fmt: skip
