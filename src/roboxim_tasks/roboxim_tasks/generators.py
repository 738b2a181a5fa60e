"""Task generators (thesis 4.2.1): one per property, composed by a skill into a task.

Every property draws from a stream of its own, so two datasets that differ in one property stay paired in the rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from roboxim_core.errors import ErrorCode, TaskError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import PhysicalObject, TaskSpec
from roboxim_tasks.choices import Choice
from roboxim_tasks.roles import description, distractor_role

if TYPE_CHECKING:
    from roboxim_tasks.config import TaskConfig

MAX_TRIES = 1000


@dataclass(frozen=True, kw_only=True)
class GenerationContext:
    """What generators draw from."""

    seed: SeedPath
    """Address of the episode's randomness."""
    config: TaskConfig
    """Task configuration."""
    library: ModelLibrary
    """Where the objects' nouns come from."""


def generate_object(
    context: GenerationContext, entity: str, models: Choice, modifiers: Mapping[str, Choice], attempt: int = 0
) -> PhysicalObject:
    """Draw an object: its model, then each modifier.

    Args:
        context: What to draw from.
        entity: Name of the entity, which also names the streams.
        models: Ids of object models.
        modifiers: Modifier name to its values.
        attempt: How often this object was drawn before, for a fresh draw.

    Raises:
        ConfigError: When a model, a modifier or its value is unknown.
    """
    index = context.seed.index
    suffix = f"/{attempt}" if attempt else ""
    model = str(models.draw(context.seed.rng(f"{entity}/model{suffix}"), index))
    drawn = {
        name: choice.draw(context.seed.rng(f"{entity}/{name}{suffix}"), index) for name, choice in modifiers.items()
    }
    noun = context.library.object(model, drawn).name
    return PhysicalObject(entity=entity, model=model, name=noun, modifiers=drawn)


def generate_distractors(
    context: GenerationContext, objects: Mapping[str, PhysicalObject]
) -> dict[str, PhysicalObject]:
    """Draw the distractors: none fits the description of an object of the task.

    Args:
        context: What to draw from.
        objects: The task's objects by role.

    Returns:
        Role to object.

    Raises:
        TaskError: With code ``RESET_INFEASIBLE`` when everything that may be drawn fits.
    """
    config = context.config.distractors
    count = int(context.seed.rng("distractors/count").integers(config.minimum, config.maximum + 1))
    taken = {description(thing) for thing in objects.values()}
    distractors = {}
    for number in range(1, count + 1):
        role = distractor_role(number)
        for attempt in range(MAX_TRIES):
            thing = generate_object(context, role, config.models, config.modifiers, attempt)
            if description(thing) not in taken:
                distractors[role] = thing
                break
        else:
            raise TaskError(
                f"no distractor can be told from {sorted(taken)}: distractor_distinct refused {MAX_TRIES} draws; "
                "give distractors.modifiers.color or distractors.models more values",
                ErrorCode.RESET_INFEASIBLE,
            )
    return distractors


def generate_instruction(context: GenerationContext, objects: Mapping[str, PhysicalObject]) -> str:
    """Draw a template and fill in the objects' descriptions.

    Args:
        context: What to draw from.
        objects: The task's objects by role.
    """
    assert context.config.templates is not None
    template = str(context.config.templates.draw(context.seed.rng("instruction"), context.seed.index))
    return template.format_map({role: description(thing) for role, thing in objects.items()})


def generate_task(context: GenerationContext, *, arguments: Any) -> TaskSpec:
    """Compose a task: an object per role, distractors, the instruction, and the skill's parameters as arguments.

    Args:
        context: What to draw from.
        arguments: Frozen dataclass of scalars: what the skill's evaluator needs to know.

    Raises:
        TaskError: With code ``RESET_INFEASIBLE`` when no distinct distractor can be drawn.
        ConfigError: When the configuration names what does not exist.
    """
    objects = {
        role: generate_object(context, role, config.models, config.modifiers)
        for role, config in context.config.objects.items()
    }
    return TaskSpec(
        skill=context.config.skill,
        objects=objects | generate_distractors(context, objects),
        arguments=asdict(arguments),
        instruction=generate_instruction(context, objects),
    )
