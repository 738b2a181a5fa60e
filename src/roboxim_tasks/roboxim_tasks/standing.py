"""Measures of how an object stands or lies at the end, and of other objects that the robot put there.

The conditions are folds over state records like those of `roboxim_tasks.measures`, so they judge live and from a bag.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_core.specs import Scalar, TaskSpec
from roboxim_core.state import Contact, StateRecord
from roboxim_tasks.measures import TOPPLED_DEG, Condition, Measure, tilt
from roboxim_tasks.motion import ROBOT, TABLE
from roboxim_tasks.roles import UPRIGHT

LEANING_DEG = 3.0
"""Change of the angle between the vertical and the nearest of an object's axes from which it may lean [degrees].

What rests on a level surface alone keeps that angle; physics settles it to less than a degree."""
LEANING_SHARE = 0.1
"""Largest share of the force on a resting object that may come from neighbours; not 0, because contacts chatter."""


def upright_arguments(task: TaskSpec, library: ModelLibrary) -> dict[str, Scalar]:
    """Return the argument that a task's target has to stay upright, if its model has a right way up; else nothing."""
    target = task.objects["target"]
    stands = "upright" in library.object(target.model, target.modifiers).affordances
    return {UPRIGHT: True} if stands else {}


def stays_upright(task: TaskSpec, initial: StateRecord) -> tuple[Condition, ...]:
    """Return the condition that a task's target stands as at tick 0, if the task demands it; else none."""
    if not task.arguments.get(UPRIGHT):
        return ()
    return (kept_upright(task.objects["target"].entity, initial),)


def kept_upright(entity: str, initial: StateRecord) -> Condition:
    """Return the condition that the side of an object that was up at tick 0 is still up."""
    up = tuple(initial.entity(entity).pose.rotation.inv().apply((0.0, 0.0, 1.0)).tolist())
    lean = tilt(entity, up)
    degrees = Measure(name="toppled_deg", of=lambda state: math.degrees(lean.of(state)))
    return Condition(name="kept_upright", measure=degrees, most=TOPPLED_DEG, reason="toppled")


def rests_alone(entity: str, initial: StateRecord, *carriers: str) -> Condition:
    """Return the condition that neighbours neither prop nor carry a resting object.

    Args:
        entity: The object.
        initial: State of tick 0.
        carriers: Bodies that may carry it besides the table.
    """
    share = propped_share(entity, initial, (TABLE, *carriers))
    return Condition(name="rests_alone", measure=share, most=LEANING_SHARE, reason="leans_on_something")


def propped_share(entity: str, initial: StateRecord, carriers: Iterable[str]) -> Measure:
    """Measure the share of the force on an object that comes from neighbours, at the end of a tick.

    Of a level object only upward forces count: what touches a neighbour's side stands by itself. Of a tilted one all
    forces count, because it leans.
    """
    begin, allowed = _nearest_axis_deg(initial.entity(entity).pose), {entity, ROBOT, *carriers}

    def of(state: StateRecord) -> float:
        tilted = _nearest_axis_deg(state.entity(entity).pose) - begin > LEANING_DEG
        propped = total = 0.0
        for contact, upward in _upward(state, entity):
            force = contact.force_last if tilted else upward
            total += force
            if {contact.body_a, contact.body_b} - allowed:
                propped += force
        return propped / total if total > 0.0 else 0.0

    return Measure(name="propped_share", of=of)


def carried_by_others(entity: str) -> Measure:
    """Measure the largest upward force of anything but the robot and the table on an object [N].

    What hangs in a hand may touch a neighbour's side, whose force is level.
    """
    return Measure(
        name="props_force_n",
        of=lambda state: max(
            (force for contact, force in _upward(state, entity) if TABLE not in (contact.body_a, contact.body_b)),
            default=0.0,
        ),
    )


def _upward(state: StateRecord, entity: str) -> Iterator[tuple[Contact, float]]:
    """Yield an object's contacts with anything but the robot, each with its upward force on the object [N]."""
    for contact in state.contacts:
        bodies = contact.body_a, contact.body_b
        if entity in bodies and ROBOT not in bodies:
            yield contact, max(0.0, contact.force_on_b[2] * (1.0 if contact.body_b == entity else -1.0))


def nothing_else_put(task: TaskSpec, initial: StateRecord, there: Callable[[StateRecord, str], bool]) -> Condition:
    """Return the condition that no object that the task does not name has come to where the target belongs.

    Args:
        task: The task.
        initial: State of tick 0.
        there: Returns whether an entity is there.
    """
    named = {thing.entity for role, thing in task.objects.items() if not role.startswith("distractor_")}
    others = [e.name for e in initial.entities if e.name not in named and not there(initial, e.name)]
    count = Measure(name="others_put", of=lambda state: float(sum(there(state, name) for name in others)))
    return Condition(name="nothing_else_put", measure=count, most=0.0, reason="put_another_there")


def rests_on(state: StateRecord, entity: str, support: str) -> bool:
    """Return whether an object touched a support in a tick, and the table did not touch it."""
    touched = any(contact.force_max > 0.0 for contact in state.contacts_between(entity, support))
    return touched and not any(contact.force_max > 0.0 for contact in state.contacts_between(entity, TABLE))


def _nearest_axis_deg(pose: Pose) -> float:
    """Return the angle between the vertical and the nearest of an object's axes [degrees]."""
    return math.degrees(math.acos(min(1.0, float(np.abs(pose.quaternion.matrix()[2]).max()))))
