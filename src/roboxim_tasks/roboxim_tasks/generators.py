"""Task generators: one per property, composed by a skill into a task.

Every property draws from a stream of its own, so two datasets that differ in one property stay paired in the rest.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, TypeVar

from roboxim_core.errors import ErrorCode, TaskError
from roboxim_core.models.description import ObjectModel
from roboxim_core.models.library import ModelLibrary
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import PhysicalObject, TaskSpec
from roboxim_tasks.choices import Choice
from roboxim_tasks.exclusions import MODEL, matches, taken
from roboxim_tasks.roles import STAY, Role, Wording, description, distractor_role
from roboxim_tasks.task_config import DistractorConfig, ObjectConfig, TaskConfig

MAX_TRIES = 1000
ROUNDS = 50
TRIES_A_ROUND = 20
TRIES_A_STEP = 100
"""Draws of a distractor after which an ordered list steps on."""
ENOUGH_DRAWS = 20_000
"""Refused draws of an episode after which ordered lists do not step on any more."""

K = TypeVar("K")


@dataclass(frozen=True, kw_only=True)
class GenerationContext:
    """What generators draw from."""

    seed: SeedPath
    """Address of the episode's randomness."""
    config: TaskConfig
    """Task configuration."""
    library: ModelLibrary
    """Where the objects' nouns come from."""
    roles: Mapping[str, Role]
    """Roles of the skill, and what may fill them."""
    mismatch: Callable[[Any, Mapping[str, ObjectModel]], str] = lambda parameters, models: ""
    """Tells why models by role make no sense together with the skill's parameters; empty if they do."""
    ordinal: int | None = None
    """Number of the episode in its cell of a mix, which ordered lists go by; none: the seed's index."""

    @property
    def index(self) -> int:
        """Number that ordered lists go by."""
        return self.seed.index if self.ordinal is None else self.ordinal

    @cached_property
    def template(self) -> str:
        """The instruction's template, drawn."""
        assert self.config.templates is not None
        return str(self.config.templates.draw(self.seed.rng("instruction"), self.index))

    @cached_property
    def wording(self) -> Wording:
        """What the instruction names."""
        return Wording.of_template(self.template, self.roles, self.library)

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
    context: GenerationContext,
    entity: str,
    models: Choice,
    modifiers: Mapping[str, Choice],
    attempt: int = 0,
    steps: Mapping[str, int] | None = None,
) -> PhysicalObject:
    """Draw an object: its model, then each modifier that the model takes, of the values that it allows.

    Args:
        context: What to draw from.
        entity: Name of the entity, which also names the streams.
        models: Ids of object models.
        modifiers: Modifier name to its values.
        attempt: How often this object was drawn before, for a fresh draw.
        steps: ``model`` or modifier to how far its ordered list steps on from the episode's place in it.

    Raises:
        ConfigError: When a model, a modifier or its value is unknown.
    """
    suffix, steps = f"/{attempt}" if attempt else "", steps or {}
    model = str(models.draw(context.seed.rng(f"{entity}/model{suffix}"), context.index + steps.get(MODEL, 0)))
    allowed = context.library.object_modifiers(model)
    drawn = {}
    for name, choice in modifiers.items():
        mine = taken(name, choice, allowed)
        if mine is not None:
            drawn[name] = mine.draw(context.seed.rng(f"{entity}/{name}{suffix}"), context.index + steps.get(name, 0))
    noun = context.library.object(model, drawn).name
    return PhysicalObject(entity=entity, model=model, name=noun, modifiers=drawn)


def generate_objects(context: GenerationContext) -> dict[str, PhysicalObject]:
    """Draw the objects that the instruction speaks of: each can be told from the others, and together they suit.

    Lists in order step on, the last one first, where what is at random cannot help: with one list of colours for both
    roles of a tower its cubes are red and green, then green and blue.

    Args:
        context: What to draw from.

    Returns:
        Role to object.

    Raises:
        TaskError: With code ``RESET_INFEASIBLE`` when none of many draws does.
    """
    refused: Counter[str] = Counter()
    configs = context.config.objects
    ordered = {(role, name): count for role, config in configs.items() for name, count in _ordered(config).items()}
    for steps in _steps(ordered):
        by_role = {role: {name: step for (other, name), step in steps.items() if other == role} for role in configs}
        objects, last = _together(context, by_role, refused)
        if objects:
            return objects
        if refused.total() >= ENOUGH_DRAWS:
            break
    (worst, _), *_ = refused.most_common(1)
    raise TaskError(
        f"no objects for {context.config.skill}: {worst} refused most of {refused.total()} draws, the last one a "
        f"{description(last)} as {last.entity}; give objects.{last.entity} other models or more modifiers, or exclude "
        "less",
        ErrorCode.RESET_INFEASIBLE,
    )


def _together(
    context: GenerationContext,
    steps: Mapping[str, Mapping[str, int]],
    refused: Counter[str],
) -> tuple[dict[str, PhysicalObject], PhysicalObject]:
    """Draw an object for each role, with ordered lists where they are.

    Args:
        context: What to draw from.
        steps: Role to how far each of its ordered lists steps on.
        refused: Counts why draws were refused.

    Returns:
        Role to object, empty if no draw will do; and the object that was drawn last.
    """
    configs = context.config.objects
    rounds = ROUNDS if any(map(_varies, configs.values())) else 1
    for start in range(rounds):
        objects: dict[str, PhysicalObject] = {}
        for role, config in configs.items():
            tries = TRIES_A_ROUND if _varies(config) else 1
            for attempt in range(start * TRIES_A_ROUND, start * TRIES_A_ROUND + tries):
                thing = generate_object(context, role, config.models, config.modifiers, attempt, steps[role])
                reason = _refusal(context, objects, {role: thing})
                if not reason:
                    objects[role] = thing
                    break
                refused[reason] += 1
            else:
                break
        else:
            return objects, thing
    return {}, thing


def _ordered(config: ObjectConfig | DistractorConfig) -> dict[str, int]:
    """Return the lists that come in order, ``model`` or a modifier, and how many values each has."""
    choices = {MODEL: config.models, **config.modifiers}
    return {name: choice.ordered for name, choice in choices.items() if choice.ordered}


def _varies(config: ObjectConfig | DistractorConfig) -> bool:
    """Tell whether another draw, with ordered lists where they are, may give another object."""
    return any(choice.varies for choice in (config.models, *config.modifiers.values()))


def _steps(counts: Mapping[K, int]) -> Iterator[dict[K, int]]:
    """Yield how far each of some ordered lists steps on: first none, then the last one, all combinations in the end."""
    for steps in itertools.product(*map(range, counts.values())):
        yield dict(zip(counts, steps, strict=True))


def _refusal(
    context: GenerationContext,
    objects: Mapping[str, PhysicalObject],
    another: Mapping[str, PhysicalObject],
) -> str:
    """Return why an object cannot join those drawn before it, or nothing."""
    library = context.library
    drawn = {**objects, **another}
    wording = context.wording
    for mine, other in itertools.product(another.items(), objects.items()):
        if not wording.distinct(mine, other):
            return "objects_distinct"
    if not all(wording.true_to(role, thing, thing) for role, thing in another.items()):
        return "size_true"
    if any(matches(drawn, combination, library) for combination in context.config.exclude):
        return "excluded"
    complete = len(drawn) == len(context.config.objects)
    models = {role: library.object(thing.model, thing.modifiers) for role, thing in drawn.items()}
    if complete and context.mismatch(context.parameters, models):
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
    distractors: dict[str, PhysicalObject] = {}
    begin = 0
    for number in range(1, count + 1):
        role = distractor_role(number)
        thing, begin = _distractor(context, role, begin, objects)
        distractors[role] = thing
    return distractors


def _distractor(
    context: GenerationContext, role: str, begin: int, objects: Mapping[str, PhysicalObject]
) -> tuple[PhysicalObject, int]:
    """Draw a distractor.

    Args:
        context: What to draw from.
        role: Its role.
        begin: How far ordered lists have stepped on already.
        objects: The task's objects by role.

    Returns:
        The distractor, and how far ordered lists are then.

    Raises:
        TaskError: With code ``RESET_INFEASIBLE`` when everything that may be drawn fits.
    """
    config = context.config.distractors
    ordered = _ordered(config)
    tries = 1 if not _varies(config) else TRIES_A_STEP if ordered else MAX_TRIES
    drawn = 0
    for steps in _steps(ordered):
        forward = {name: begin + step for name, step in steps.items()}
        for attempt in range(tries):
            thing = generate_object(context, role, config.models, config.modifiers, attempt, forward)
            if not context.wording.could_be_any(thing, objects):
                return thing, next(iter(forward.values()), begin) + 1
            drawn += 1
        if drawn >= ENOUGH_DRAWS:
            break
    unnamed = sorted(objects.keys() - context.wording.named)
    raise TaskError(
        f"no distractor can be told from {sorted(description(thing) for thing in objects.values())}: "
        f"distractor_distinct refused all of {drawn} draws; "
        "give distractors.modifiers.color or distractors.models more values"
        + "".join(f"; '{context.template}' does not name the {r}, so nothing else may be one" for r in unnamed),
        ErrorCode.RESET_INFEASIBLE,
    )


def generate_instruction(
    context: GenerationContext, objects: Mapping[str, PhysicalObject], words: Mapping[str, str]
) -> str:
    """Draw a template and fill in the objects' descriptions.

    Args:
        context: What to draw from.
        objects: The task's objects by role.
        words: What else a template may name, e.g. an angle.
    """
    return context.template.format_map({role: description(thing) for role, thing in objects.items()} | dict(words))


def generate_task(
    context: GenerationContext,
    *,
    arguments: Any = None,
    words: Mapping[str, str] | None = None,
) -> TaskSpec:
    """Compose a task: an object per role, distractors, the instruction, and the skill's parameters as arguments.

    Args:
        context: What to draw from.
        arguments: Frozen dataclass of scalars: what the skill's evaluator needs to know; none: the parameters.
        words: What else than roles a template may name.

    Raises:
        TaskError: With code ``RESET_INFEASIBLE`` when no objects suit or no distinct distractor can be drawn.
        ConfigError: When the configuration names what does not exist.
    """
    objects = generate_objects(context)
    stay_m = context.config.distractors.stay_m
    return TaskSpec(
        skill=context.config.skill,
        objects=objects | generate_distractors(context, objects),
        arguments=asdict(arguments if arguments is not None else context.parameters)
        | ({STAY: stay_m} if stay_m else {}),
        instruction=generate_instruction(context, objects, words or {}),
    )
