"""Task generators: one per property, composed by a skill into a task.

Every property draws from a stream of its own, so two datasets that differ in one property stay paired in the rest.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

from roboxim_core.errors import ErrorCode, TaskError
from roboxim_core.models.description import ObjectModel
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.modifiers import PHYSICAL
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import PhysicalObject, Scalar, TaskSpec
from roboxim_tasks.choices import Choice
from roboxim_tasks.roles import SPOKEN, STAY, description, distractor_role, fits_description

if TYPE_CHECKING:
    from roboxim_tasks.config import TaskConfig

MAX_TRIES = 1000
ROUNDS = 50
TRIES_A_ROUND = 20


@dataclass(frozen=True, kw_only=True)
class GenerationContext:
    """What generators draw from."""

    seed: SeedPath
    """Address of the episode's randomness."""
    config: TaskConfig
    """Task configuration."""
    library: ModelLibrary
    """Where the objects' nouns come from."""
    ordinal: int | None = None
    """Number of the episode in its cell of a mix, which ordered lists go by; none: the seed's index."""

    @property
    def index(self) -> int:
        """Number that ordered lists go by."""
        return self.seed.index if self.ordinal is None else self.ordinal

    @property
    def parameters(self) -> Any:
        """The skill's parameters, with those drawn that vary; lenient ones where a policy is evaluated."""
        base = self.config.lenient if self.seed.purpose == "eval" else self.config.parameters
        drawn = {
            name: choice.draw(self.seed.rng(f"argument/{name}"), self.index)
            for name, choice in self.config.arguments.items()
        }
        return replace(base, **drawn)


def generate_object(
    context: GenerationContext, entity: str, models: Choice, modifiers: Mapping[str, Choice], attempt: int = 0
) -> PhysicalObject:
    """Draw an object: its model, then each modifier that the model takes, of the values that it allows.

    Args:
        context: What to draw from.
        entity: Name of the entity, which also names the streams.
        models: Ids of object models.
        modifiers: Modifier name to its values.
        attempt: How often this object was drawn before, for a fresh draw.

    Raises:
        ConfigError: When a model, a modifier or its value is unknown.
    """
    suffix = f"/{attempt}" if attempt else ""
    model = str(models.draw(context.seed.rng(f"{entity}/model{suffix}"), context.index))
    allowed = context.library.object_modifiers(model)
    drawn = {}
    for name, choice in modifiers.items():
        mine = choice.only(allowed[name].words(name)) if name in allowed and name in SPOKEN else choice
        if mine is not None and (name in allowed or name in PHYSICAL):
            drawn[name] = mine.draw(context.seed.rng(f"{entity}/{name}{suffix}"), context.index)
    noun = context.library.object(model, drawn).name
    return PhysicalObject(entity=entity, model=model, name=noun, modifiers=drawn)


def generate_objects(
    context: GenerationContext, suits: Callable[[Mapping[str, ObjectModel]], bool]
) -> dict[str, PhysicalObject]:
    """Draw the objects that the instruction speaks of: each can be told from the others, and together they suit.

    Args:
        context: What to draw from.
        suits: Whether models by role make sense together, e.g. whether the one fits into the other.

    Returns:
        Role to object.

    Raises:
        TaskError: With code ``RESET_INFEASIBLE`` when none of many draws does.
    """
    refused: Counter[str] = Counter()
    for start in range(ROUNDS):
        objects: dict[str, PhysicalObject] = {}
        for role, config in context.config.objects.items():
            for attempt in range(start * TRIES_A_ROUND, (start + 1) * TRIES_A_ROUND):
                thing = generate_object(context, role, config.models, config.modifiers, attempt)
                reason = _refusal(context, objects, {role: thing}, suits)
                if not reason:
                    objects[role] = thing
                    break
                refused[reason] += 1
            else:
                break
        else:
            return objects
    (worst, _), *_ = refused.most_common(1)
    raise TaskError(
        f"no objects for {context.config.skill}: {worst} refused most of {refused.total()} draws, the last one a "
        f"{description(thing)} as {role}; give objects.{role} other models or more modifiers, or exclude less",
        ErrorCode.RESET_INFEASIBLE,
    )


def _refusal(
    context: GenerationContext,
    objects: Mapping[str, PhysicalObject],
    another: Mapping[str, PhysicalObject],
    suits: Callable[[Mapping[str, ObjectModel]], bool],
) -> str:
    """Return why an object cannot join those drawn before it, or nothing."""
    library = context.library
    drawn = {**objects, **another}
    for thing, other in itertools.product(another.values(), objects.values()):
        if fits_description(thing, other, library) or fits_description(other, thing, library):
            return "objects_distinct"
    if any(_matches(drawn, combination) for combination in context.config.exclude):
        return "excluded"
    complete = len(drawn) == len(context.config.objects)
    if complete and not suits({role: library.object(t.model, t.modifiers) for role, t in drawn.items()}):
        return "objects_suit"
    return ""


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
    distractors = {}
    for number in range(1, count + 1):
        role = distractor_role(number)
        for attempt in range(MAX_TRIES):
            thing = generate_object(context, role, config.models, config.modifiers, attempt)
            if not any(fits_description(thing, named, context.library) for named in objects.values()):
                distractors[role] = thing
                break
        else:
            raise TaskError(
                f"no distractor can be told from {sorted(description(thing) for thing in objects.values())}: "
                f"distractor_distinct refused {MAX_TRIES} draws; "
                "give distractors.modifiers.color or distractors.models more values",
                ErrorCode.RESET_INFEASIBLE,
            )
    return distractors


def generate_instruction(
    context: GenerationContext, objects: Mapping[str, PhysicalObject], words: Mapping[str, str]
) -> str:
    """Draw a template and fill in the objects' descriptions.

    Args:
        context: What to draw from.
        objects: The task's objects by role.
        words: What else a template may name, e.g. an angle.
    """
    assert context.config.templates is not None
    template = str(context.config.templates.draw(context.seed.rng("instruction"), context.index))
    return template.format_map({role: description(thing) for role, thing in objects.items()} | dict(words))


def generate_task(
    context: GenerationContext,
    *,
    arguments: Any = None,
    words: Mapping[str, str] | None = None,
    suits: Callable[[Mapping[str, ObjectModel]], bool] = lambda _: True,
) -> TaskSpec:
    """Compose a task: an object per role, distractors, the instruction, and the skill's parameters as arguments.

    Args:
        context: What to draw from.
        arguments: Frozen dataclass of scalars: what the skill's evaluator needs to know; none: the parameters.
        words: What else than roles a template may name.
        suits: Whether models by role make sense together.

    Raises:
        TaskError: With code ``RESET_INFEASIBLE`` when no objects suit or no distinct distractor can be drawn.
        ConfigError: When the configuration names what does not exist.
    """
    objects = generate_objects(context, suits)
    stay_m = context.config.distractors.stay_m
    return TaskSpec(
        skill=context.config.skill,
        objects=objects | generate_distractors(context, objects),
        arguments=asdict(arguments if arguments is not None else context.parameters)
        | ({STAY: stay_m} if stay_m else {}),
        instruction=generate_instruction(context, objects, words or {}),
    )


def _matches(objects: Mapping[str, PhysicalObject], combination: Mapping[str, Mapping[str, Scalar]]) -> bool:
    """Tell whether objects by role are an excluded combination; a role that is not drawn yet is not."""
    return all(
        role in objects and wanted.items() <= {**objects[role].modifiers, "model": objects[role].model}.items()
        for role, wanted in combination.items()
    )
