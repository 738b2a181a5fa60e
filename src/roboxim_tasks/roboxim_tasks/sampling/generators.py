"""Task generators: one per property, composed by a skill into a task.

Every property has its own random stream, so that two datasets that differ in one property stay paired in all others.
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
from roboxim_core.seeds import EVALUATED, SeedPath
from roboxim_core.specs import PhysicalObject, TaskSpec
from roboxim_tasks.choices import Choice, choice_text
from roboxim_tasks.roles import STAY, Role, Wording, description, distractor_role
from roboxim_tasks.sampling.exclusions import MODEL, matches, taken
from roboxim_tasks.task_config import DistractorConfig, ObjectConfig, TaskConfig

MAX_TRIES = 1000
ROUNDS = 50
TRIES_A_ROUND = 20
TRIES_A_STEP = 100
"""Refused draws of a distractor after which an ordered list advances."""
ENOUGH_DRAWS = 20_000
"""Refused draws of an episode after which ordered lists no longer advance."""

K = TypeVar("K")


@dataclass(frozen=True, kw_only=True)
class GenerationContext:
    """Inputs of the generators."""

    seed: SeedPath
    """Seed path of the episode."""
    config: TaskConfig
    """Task configuration."""
    library: ModelLibrary
    """Library of the objects, the source of their nouns."""
    roles: Mapping[str, Role]
    """Roles of the skill, and the objects that may fill them."""
    mismatch: Callable[[Any, Mapping[str, ObjectModel]], str] = lambda parameters, models: ""
    """Return why models by role do not go together with the skill's parameters; empty if they do."""
    ordinal: int | None = None
    """Number of the episode in its cell of a mix, the index into ordered lists; none: the seed's index."""
    given: Mapping[str, PhysicalObject] | None = None
    """Objects by role that are drawn already, as for a step of a sequence; none: they are drawn here."""
    text: str = ""
    """Template that stands for the drawn one, where it says more of what the instruction names; empty: none."""

    @property
    def index(self) -> int:
        """Index into ordered lists."""
        return self.seed.index if self.ordinal is None else self.ordinal

    @cached_property
    def template(self) -> str:
        """The drawn template of the instruction."""
        if self.text:
            return self.text
        assert self.config.templates is not None
        return str(self.config.templates.draw(self.seed.rng("instruction"), self.index))

    def step_template(self, number: int) -> str:
        """Return the drawn template of a step's own sentence; each step has its own random stream.

        Args:
            number: Number of the step, from 1.
        """
        templates = self.config.steps[number - 1].templates
        assert templates is not None
        return str(templates.draw(self.seed.rng(f"step_{number}/instruction"), self.index))

    @cached_property
    def wording(self) -> Wording:
        """The objects that the instruction names."""
        return Wording.of_template(self.template, self.roles, self.library)

    def drawn(self, task: TaskSpec) -> dict[str, str]:
        """Return the recorded choices of a task: objects, their modifiers, arguments, template and distractors.

        Args:
            task: The task that was drawn with these inputs.
        """
        named = {role: thing for role, thing in task.objects.items() if role in self.roles}
        drawn = {role: thing.model for role, thing in named.items()}
        for role, thing in named.items():
            drawn |= {f"{role}.{name}": choice_text(value) for name, value in thing.modifiers.items()}
        steps = list(enumerate(self.config.steps, start=1))
        varied = [
            *self.config.arguments,
            *(f"step_{number}.{name}" for number, step in steps for name in step.arguments),
        ]
        drawn |= {name: choice_text(task.arguments[name]) for name in varied if name in task.arguments}
        for number, step in steps:
            if step.templates is not None and len(step.templates.values) > 1:
                drawn[f"step_{number}.template"] = self.step_template(number)
        if self.config.templates is not None and len(self.config.templates.values) > 1:
            drawn["template"] = self.template
        if self.config.steps:
            drawn["length"] = str(len(self.config.steps))
        if self.config.distractors.maximum:
            drawn["distractors"] = str(len(task.objects) - len(named))
        return drawn

    @property
    def parameters(self) -> Any:
        """The skill's parameters, with drawn values where they vary and lenient ones where a policy is evaluated."""
        base = self.config.lenient if self.seed.purpose in EVALUATED else self.config.parameters
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
    """Draw an object: its model, then a value for each modifier that the model takes, from those that it allows.

    Args:
        context: Inputs of the draw.
        entity: Name of the entity, which also names the random streams.
        models: Ids of object models.
        modifiers: Modifier name to its values.
        attempt: Number of previous draws of this object, for a fresh draw.
        steps: ``model`` or modifier to the steps by which its ordered list advances from the episode's place in it.

    Raises:
        ConfigError: When a model, a modifier or its value is unknown.
    """
    suffix, steps = f"/{attempt}" if attempt else "", steps or {}
    model = str(models.draw(context.seed.rng(f"{entity}/model{suffix}"), context.index + steps.get(MODEL, 0)))
    allowed = context.library.object_modifiers(model)
    drawn = {}
    for name, choice in modifiers.items():
        remaining = taken(name, choice, allowed)
        if remaining is not None:
            drawn[name] = remaining.draw(
                context.seed.rng(f"{entity}/{name}{suffix}"), context.index + steps.get(name, 0)
            )
    noun = context.library.object(model, drawn).name
    return PhysicalObject(entity=entity, model=model, name=noun, modifiers=drawn)


def generate_objects(context: GenerationContext) -> dict[str, PhysicalObject]:
    """Draw the objects in the instruction: all can be distinguished, and they go together.

    Ordered lists advance, the last one first, where random draws cannot help. With one list of colours for both roles
    of a tower, its cubes are red and green, then green and blue.

    Args:
        context: Inputs of the draw.

    Returns:
        Role to object.

    Raises:
        TaskError: With code ``RESET_INFEASIBLE`` when all of many draws are refused.
    """
    if context.given is not None:
        return dict(context.given)
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
    """Draw an object for each role, with ordered lists at fixed places.

    Args:
        context: Inputs of the draw.
        steps: Role to the steps by which each of its ordered lists advances.
        refused: Counter of the reasons for refused draws; updated.

    Returns:
        Role to object, empty if every draw was refused; and the object that was drawn last.
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
    """Return the ordered lists, by ``model`` or modifier, and the number of values of each."""
    choices = {MODEL: config.models, **config.modifiers}
    return {name: choice.ordered for name, choice in choices.items() if choice.ordered}


def _varies(config: ObjectConfig | DistractorConfig) -> bool:
    """Return whether another draw, with ordered lists at fixed places, may give another object."""
    return any(choice.varies for choice in (config.models, *config.modifiers.values()))


def _steps(counts: Mapping[K, int]) -> Iterator[dict[K, int]]:
    """Yield the steps of some ordered lists: first none advances, then the last one, finally all combinations."""
    for steps in itertools.product(*map(range, counts.values())):
        yield dict(zip(counts, steps, strict=True))


def _refusal(
    context: GenerationContext,
    objects: Mapping[str, PhysicalObject],
    another: Mapping[str, PhysicalObject],
) -> str:
    """Return why an object cannot join those drawn before it, or an empty text."""
    library = context.library
    drawn = {**objects, **another}
    wording = context.wording
    for first, second in itertools.product(another.items(), objects.items()):
        if not wording.distinct(first, second):
            return "objects_distinct"
    if not all(wording.true_to(role, thing, thing) for role, thing in another.items()):
        return "size_true"
    if not all(context.roles[role].suits(library.object(t.model, t.modifiers)) for role, t in another.items()):
        return "role_suited"
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
    """Draw distractors that do not fit the description of any object of the task.

    Args:
        context: Inputs of the draw.
        objects: The task's objects by role.

    Returns:
        Role to object.

    Raises:
        TaskError: With code ``RESET_INFEASIBLE`` when every possible distractor fits one.
    """
    config = context.config.distractors
    count = int(context.seed.rng("distractors/count").integers(config.minimum, config.maximum + 1))
    distractors: dict[str, PhysicalObject] = {}
    begin = 0
    for number in range(1, count + 1):
        role = distractor_role(number)
        if number <= len(config.always):
            distractors[role] = _fixed_distractor(context, role, config.always[number - 1], objects)
        else:
            distractors[role], begin = _distractor(context, role, begin, objects)
    return distractors


def _fixed_distractor(
    context: GenerationContext, role: str, model: str, objects: Mapping[str, PhysicalObject]
) -> PhysicalObject:
    """Return a distractor of a model that every scene has.

    Raises:
        TaskError: With code ``RESET_INFEASIBLE`` when the instruction could mean it.
    """
    thing = generate_object(context, role, Choice(values=(model,)), {})
    if context.wording.could_be_any(thing, objects):
        raise TaskError(
            f"the instruction could mean the {description(thing)} that distractors.always puts into every scene",
            ErrorCode.RESET_INFEASIBLE,
        )
    return thing


def _distractor(
    context: GenerationContext, role: str, begin: int, objects: Mapping[str, PhysicalObject]
) -> tuple[PhysicalObject, int]:
    """Draw a distractor.

    Args:
        context: Inputs of the draw.
        role: The distractor's role.
        begin: Steps by which ordered lists have already advanced.
        objects: The task's objects by role.

    Returns:
        The distractor, and the steps by which ordered lists have advanced then.

    Raises:
        TaskError: With code ``RESET_INFEASIBLE`` when every possible distractor fits one.
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
        f"no distractor can be distinguished from {sorted(description(thing) for thing in objects.values())}: "
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
        context: Inputs of the draw.
        objects: The task's objects by role.
        words: Texts for the other names in a template, e.g. an angle.
    """
    return context.template.format_map({role: description(thing) for role, thing in objects.items()} | dict(words))


def generate_task(context: GenerationContext, *, words: Mapping[str, str] | None = None) -> TaskSpec:
    """Compose a task: an object per role, distractors, the instruction, and the skill's parameters as arguments.

    Args:
        context: Inputs of the draw.
        words: Texts for names in a template that are not roles.

    Raises:
        TaskError: With code ``RESET_INFEASIBLE`` when no suitable objects or no distinct distractor can be drawn.
        ConfigError: When the configuration names what does not exist.
    """
    objects = generate_objects(context)
    stay_m = context.config.distractors.stay_m
    return TaskSpec(
        skill=context.config.skill,
        objects=objects | generate_distractors(context, objects),
        arguments=asdict(context.parameters) | ({STAY: stay_m} if stay_m else {}),
        instruction=generate_instruction(context, objects, words or {}),
    )
