"""Roles of a task's objects: those that the instruction speaks of, and distractors."""

from __future__ import annotations

from roboxim_core.specs import PhysicalObject, TaskSpec

DISTRACTOR = "distractor"


def distractor_role(number: int) -> str:
    """Return the role, and entity name, of the distractor with a number from 1."""
    return f"{DISTRACTOR}_{number}"


def task_objects(task: TaskSpec) -> tuple[PhysicalObject, ...]:
    """Return the objects that the instruction speaks of, in the order of their roles."""
    return tuple(thing for role, thing in task.objects.items() if not role.startswith(f"{DISTRACTOR}_"))


def task_distractors(task: TaskSpec) -> tuple[PhysicalObject, ...]:
    """Return the distractors, in order."""
    return tuple(thing for role, thing in task.objects.items() if role.startswith(f"{DISTRACTOR}_"))


def description(thing: PhysicalObject) -> str:
    """Return how an instruction names an object, e.g. ``red cube``."""
    color = thing.modifiers.get("color")
    return f"{color} {thing.name}" if color else thing.name
