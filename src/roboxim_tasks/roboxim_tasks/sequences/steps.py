"""The steps of a task, each a task of one skill, as arguments of the sequence.

A task of several steps is a plain `TaskSpec`: its ``arguments`` hold ``order`` and, for step k from 1 on,
``step_<k>.skill``, ``step_<k>.roles`` (``target=fruit container=cabinet``: role of the skill to role of the task),
``step_<k>.instruction`` and ``step_<k>.<argument>``. So messages, bags and readers need no other form.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from functools import lru_cache

from roboxim_core.errors import ErrorCode, TaskError
from roboxim_core.specs import PhysicalObject, Scalar, TaskSpec
from roboxim_tasks.roles import STAY, task_distractors

JOINED = "+"
"""Joins the skills of a sequence in its name, e.g. ``put_into+close_drawer``."""
BETWEEN = {
    "fixed": re.compile(r",? and then |, then | then ", re.IGNORECASE),
    "any": re.compile(r",? and also |, also ", re.IGNORECASE),
}
"""What stands between the sentences of steps in the templates of a sequence, by its order."""
BEFORE = re.compile(r"first |in any order: ", re.IGNORECASE)
"""What may stand before them."""
MAX_STEPS = 5
ORDERS = ("fixed", "any")
ORDER = "order"
ALSO = "also_"
"""Prefix of the roles of objects that other steps name: a step must not treat them as unnamed objects."""
_OWN = ("skill", "roles", "instruction")


def is_sequence(skill: str) -> bool:
    """Return whether a task's skill is the name of a sequence."""
    return JOINED in skill


def joined(skills: Iterable[str]) -> str:
    """Return the name of the sequence of some skills."""
    return JOINED.join(skills)


def arguments_of(steps: Iterable[tuple[TaskSpec, Mapping[str, str]]], order: str) -> dict[str, Scalar]:
    """Return the arguments of a task made of steps.

    Args:
        steps: Each step's task, and the role of its skill to the role of the whole task.
        order: ``fixed`` or ``any``.
    """
    arguments: dict[str, Scalar] = {ORDER: order}
    for number, (step, roles) in enumerate(steps, start=1):
        named = {
            "skill": step.skill,
            "roles": " ".join(f"{own}={role}" for own, role in roles.items()),
            "instruction": step.instruction,
        }
        arguments |= {f"step_{number}.{name}": value for name, value in (named | step.arguments).items()}
    joints = [step.arguments["joint"] for step, _ in steps if step.arguments.get("joint")]
    return arguments | ({"joint": joints[0]} if joints else {})


def templates_of(count: int, order: str) -> tuple[str, ...]:
    """Return the templates that join a number of steps; the first is canonical.

    Args:
        count: Number of steps.
        order: ``fixed`` or ``any``; a template says no order that does not count.
    """
    steps = [f"{{step_{number}}}" for number in range(1, count + 1)]
    if order == "any":
        return " and also ".join(steps), f"In any order: {', also '.join(steps)}", ", also ".join(steps)
    then = ", then ".join(steps)
    return then, f"First {then}", " and then ".join(steps)


def sentences_of(text: str) -> tuple[list[str], str]:
    """Return the sentences of the steps that a text joins as the templates of a sequence do, and their order.

    A text that joins none is one sentence.
    """
    text = text.strip()
    order = "fixed" if BETWEEN["fixed"].search(text) else "any"
    return BETWEEN[order].split(text[found.end() :] if (found := BEFORE.match(text)) else text), order


def task_of(steps: Iterable[TaskSpec], instruction: str, order: str = "fixed") -> TaskSpec:
    """Return the task that some tasks of one skill make, one after another.

    Args:
        steps: The tasks, about objects of one scene.
        instruction: The whole sentence.
        order: ``fixed`` or ``any``.
    """
    steps = tuple(steps)
    things: dict[str, PhysicalObject] = {}
    pairs = []
    for number, step in enumerate(steps, start=1):
        roles = {}
        for own, thing in step.objects.items():
            named = next((role for role, other in things.items() if other.entity == thing.entity), "")
            roles[own] = named or (own if own not in things else f"{own}_{number}")
            things.setdefault(roles[own], thing)
        pairs.append((step, roles))
    name = joined(step.skill for step in steps)
    return TaskSpec(skill=name, objects=things, arguments=arguments_of(pairs, order), instruction=instruction)


@lru_cache(maxsize=256)
def steps_of(task: TaskSpec) -> tuple[TaskSpec, ...]:
    """Return the steps of a task in the order of its sentence, each as a task of one skill; itself if it is one.

    A step's objects are those of its own roles, the distractors, and, with the prefix ``also_``, the objects that the
    other steps name.

    Raises:
        TaskError: With code ``UNKNOWN_SKILL`` when the arguments do not describe the steps that the skill's name says.
    """
    if not is_sequence(task.skill):
        return (task,)
    distractors = {thing.entity for thing in task_distractors(task)}
    apart = {role: thing for role, thing in task.objects.items() if thing.entity in distractors}
    named = {role: thing for role, thing in task.objects.items() if role not in apart}
    steps = []
    for number, skill in enumerate(task.skill.split(JOINED), start=1):
        prefix = f"step_{number}."
        given = {name.removeprefix(prefix): v for name, v in task.arguments.items() if name.startswith(prefix)}
        try:
            roles = dict(pair.split("=") for pair in str(given["roles"]).split())
            own = {role: named[whole] for role, whole in roles.items()}
            sentence = str(given["instruction"])
        except (KeyError, ValueError) as error:
            raise TaskError(
                f"the arguments of '{task.skill}' do not describe step {number}: {error}; expected {prefix}skill, "
                f"{prefix}roles as 'role=role ...' and {prefix}instruction",
                ErrorCode.UNKNOWN_SKILL,
            ) from None
        others = {f"{ALSO}{role}": thing for role, thing in named.items() if role not in roles.values()}
        arguments = {name: value for name, value in given.items() if name not in _OWN}
        stay = {STAY: task.arguments[STAY]} if STAY in task.arguments else {}
        steps.append(
            TaskSpec(skill=skill, objects=own | others | apart, arguments=arguments | stay, instruction=sentence)
        )  # fmt: skip
    return tuple(steps)


def own_objects(step: TaskSpec) -> dict[str, str]:
    """Return the entity of each role that a step's own sentence is about."""
    apart = {thing.entity for thing in task_distractors(step)}
    return {
        role: thing.entity
        for role, thing in step.objects.items()
        if thing.entity not in apart and not role.startswith(ALSO)
    }


def superseded(step: TaskSpec, later: Iterable[TaskSpec]) -> bool:
    """Return whether a later step moves what a step has put somewhere, so that it need not hold at the end.

    - A later step with the same target supersedes it; if both move a joint, only with the same joint.
    - So does a later step whose target is another object of the step, e.g. the one on which the target stands, unless
      it moves a joint of it: closing a drawer does not take out what lies in it.
    """
    own = own_objects(step)
    for other in later:
        target, joint = own_objects(other).get("target"), other.arguments.get("joint")
        if target is None:
            continue
        moves_joint = bool(joint) and "container" not in other.objects
        if target == own.get("target"):
            if not (moves_joint and step.arguments.get("joint") and step.arguments["joint"] != joint):
                return True
        elif target in own.values() and not moves_joint:
            return True
    return False
