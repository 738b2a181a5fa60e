"""Stack an object on another graspable one.

Randomisation and executor are those of ``place_on``. The support may be grasped and moved too.

Success: as for ``place_on``, and the base has moved by less than ``base_shift_m``.
"""

from __future__ import annotations

from dataclasses import dataclass

from roboxim_core.specs import TaskSpec
from roboxim_core.state import StateRecord
from roboxim_tasks.measures import Conditions, stayed
from roboxim_tasks.skills.base import Evaluator, Role, parameters_of, register
from roboxim_tasks.skills.place_on import PlaceOn, PlaceOnParameters, placed_on


@dataclass(frozen=True, kw_only=True)
class StackParameters(PlaceOnParameters):
    """Thresholds of success."""

    base_shift_m: float = 0.02
    """Largest displacement of the base [m]."""


@register
class Stack(PlaceOn):
    """Generator, resetter, executor and evaluator of ``stack``."""

    name = "stack"
    roles = {"support": Role(affordance="support", max_width_m=0.1), "target": Role(affordance="graspable")}
    templates = (
        "Stack the {target} on the {support}",
        "Put the {target} on top of the {support}",
        "Build a tower: the {target} on the {support}",
    )
    Parameters = StackParameters

    def evaluator(self, task: TaskSpec, initial: StateRecord) -> Evaluator:
        """Judge as ``place_on`` does, and require that the base has stayed."""
        parameters: StackParameters = parameters_of(task, StackParameters)
        support = task.objects["support"].entity
        base = stayed(support, initial, parameters.base_shift_m, "base")
        return Conditions((*placed_on(task, initial, parameters), base), hold_s=parameters.hold_s)
