"""Steps of a task's YAML: built and checked when the file is loaded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import TYPE_CHECKING

from roboxim_core.plain_data.merging import merged
from roboxim_tasks.choices import Choice
from roboxim_tasks.sequences.steps import MAX_STEPS, ORDERS, is_sequence, joined
from roboxim_tasks.skills.base import SKILLS
from roboxim_tasks.task_config import StepConfig, TaskConfig

if TYPE_CHECKING:
    from roboxim_tasks.checks import Document


def with_steps(document: Document, config: TaskConfig) -> TaskConfig:
    """Return a task's configuration with complete steps, whose skill is their sequence; as it is if it has no steps.

    Args:
        document: The task's data.
        config: The task as its file says.

    Raises:
        ConfigError: When the skill of the task or of a step is unknown, there are too few or too many steps, a step
            names a role, parameter or argument that its skill lacks, or equal steps may be done in any order.
    """
    document.require(("order",), config.order, ORDERS)
    if not config.steps:
        if is_sequence(config.skill):
            raise document.error(("skill",), f"'{config.skill}' needs 'steps', one for each skill")
        document.require(("skill",), config.skill, SKILLS)
        return config
    if not 2 <= len(config.steps) <= MAX_STEPS:
        raise document.error(("steps",), f"a longer task has 2 to {MAX_STEPS} steps, got {len(config.steps)}")
    steps = tuple(_complete(document, config, number, step) for number, step in enumerate(config.steps))
    asked = [replace(step, templates=None) for step in steps]
    for number, step in enumerate(asked):
        if config.order == "any" and step in asked[:number]:
            first = asked.index(step) + 1
            raise document.error(
                ("steps", number),
                f"asks for the same as step {first}, so that one action would do both; use order: fixed",
            )
    name = joined(step.skill for step in steps)
    if "skill" in document.data and config.skill != name:
        raise document.error(("skill",), f"leave it out, or give the skills of the steps: '{name}'")
    if config.arguments:
        raise document.error(("arguments",), "give the arguments of a longer task below its steps")
    return replace(config, skill=name, steps=steps)


def _complete(document: Document, config: TaskConfig, number: int, step: StepConfig) -> StepConfig:
    path = ("steps", number)
    document.require((*path, "skill"), step.skill, SKILLS)
    skill = SKILLS[step.skill]
    for role in step.roles:
        document.require((*path, "roles", role), role, skill.roles)
    roles = {own: step.roles.get(own, own) for own in skill.roles}
    for own, role in roles.items():
        document.require((*path, "roles", own) if own in step.roles else path, role, config.objects)
    if len(set(roles.values())) < len(roles):
        raise document.error((*path, "roles"), "two roles of a step have the same object; each needs one of its own")
    given = document.data["steps"][number]
    sections = {key: given.get(key) or {} for key in ("parameters", "lenient")} if isinstance(given, Mapping) else {}
    parameters = document.build(sections.get("parameters", {}), skill.Parameters, (*path, "parameters"))
    both = merged(sections.get("parameters", {}), sections.get("lenient", {}))
    lenient = document.build(both, skill.Parameters, (*path, "lenient"))
    for name in step.arguments:
        document.require((*path, "arguments", name), name, asdict(parameters))
    templates = step.templates or Choice(values=skill.templates[: None if config.paraphrases else 1])
    return replace(step, roles=roles, parameters=parameters, lenient=lenient, templates=templates)
