"""Roles of a task's objects: those that the instruction speaks of, and distractors."""

from __future__ import annotations

from roboxim_core.models.library import ModelLibrary
from roboxim_core.specs import PhysicalObject, TaskSpec

DISTRACTOR = "distractor"
STAY = "distractors_stay_m"
"""Argument that a task of any skill may have: how far its distractors may be moved [m]."""


def distractor_role(number: int) -> str:
    """Return the role, and entity name, of the distractor with a number from 1."""
    return f"{DISTRACTOR}_{number}"


def task_objects(task: TaskSpec) -> tuple[PhysicalObject, ...]:
    """Return the objects that the instruction speaks of, in the order of their roles."""
    return tuple(thing for role, thing in task.objects.items() if not role.startswith(f"{DISTRACTOR}_"))


def task_distractors(task: TaskSpec) -> tuple[PhysicalObject, ...]:
    """Return the distractors, in order."""
    return tuple(thing for role, thing in task.objects.items() if role.startswith(f"{DISTRACTOR}_"))


SPOKEN = ("size", "color", "material")
"""Modifiers that instructions name, in the order in which they are said."""


def description(thing: PhysicalObject) -> str:
    """Return how an instruction names an object, e.g. ``small red cube``."""
    return " ".join((*(str(thing.modifiers[kind]) for kind in SPOKEN if kind in thing.modifiers), thing.name))


def fits_description(thing: PhysicalObject, named: PhysicalObject, library: ModelLibrary) -> bool:
    """Tell whether a thing could be what an instruction means that names another one.

    Modifiers that the thing was drawn without have the values that its model has by default: an apple is red even if
    nobody says so.
    """
    defaults = library.object_modifiers(thing.model)

    def value(kind: str) -> object:
        return thing.modifiers.get(kind, defaults[kind].default if kind in defaults else None)

    spoken = {kind: named.modifiers[kind] for kind in SPOKEN if kind in named.modifiers}
    return thing.name == named.name and all(value(kind) == wanted for kind, wanted in spoken.items())
