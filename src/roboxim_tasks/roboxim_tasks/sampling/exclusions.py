"""Excluded combinations of objects: matching them, and checking that they leave something to draw."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence

from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.modifiers import PHYSICAL, ModifierModel, color_word
from roboxim_core.specs import PhysicalObject, Scalar
from roboxim_tasks.choices import Choice
from roboxim_tasks.roles import SPOKEN
from roboxim_tasks.task_config import ObjectConfig

MODEL = "model"
"""Key of an excluded combination besides the modifiers."""
Combination = Mapping[str, Mapping[str, Scalar]]
"""Role to ``model`` and modifiers."""
ENOUGH = 20_000
"""Number of different draws above which the check for complete exclusion is skipped."""


def taken(name: str, choice: Choice, allowed: Mapping[str, ModifierModel]) -> Choice | None:
    """Return the choice that a model draws a modifier from; none if the model is drawn without the modifier.

    Args:
        name: The modifier.
        choice: The task's choice.
        allowed: Values that the model allows.
    """
    remaining = choice.only(allowed[name].words(name)) if name in allowed and name in SPOKEN else choice
    return remaining if name in allowed or name in PHYSICAL else None


def matches(objects: Mapping[str, PhysicalObject], combination: Combination, library: ModelLibrary) -> bool:
    """Return whether objects by role are an excluded combination. A role that is not yet drawn never matches.

    A modifier that an object was drawn without has its model's default value.
    """
    return all(
        role in objects
        and wanted.items() <= _true_of(objects[role], library).items()
        for role, wanted in combination.items()
    )  # fmt: skip


def all_excluded(objects: Mapping[str, ObjectConfig], exclude: Sequence[Combination], library: ModelLibrary) -> bool:
    """Return whether every draw is excluded, as far as counting can show: values of ranges are not counted."""
    kinds: dict[str, set[str]] = {}
    for role, wanted in itertools.chain.from_iterable(combination.items() for combination in exclude):
        kinds.setdefault(role, set()).update(wanted)
    drawn = {role: _possible(objects[role], wanted, library) for role, wanted in kinds.items()}
    if math.prod(map(len, drawn.values())) > ENOUGH:
        return False
    return bool(exclude) and all(
        any(matches(dict(zip(drawn, things, strict=True)), combination, library) for combination in exclude)
        for things in itertools.product(*drawn.values())
    )


def _possible(config: ObjectConfig, kinds: Iterable[str], library: ModelLibrary) -> list[PhysicalObject]:
    """Return the objects that may fill a role and differ in the given kinds of modifiers."""
    things = []
    for model in map(str, config.models.drawable):
        allowed = library.object_modifiers(model)
        choices = {kind: taken(kind, config.modifiers[kind], allowed) for kind in kinds if kind in config.modifiers}
        values = {kind: choice.drawable or (math.nan,) for kind, choice in choices.items() if choice is not None}
        for drawn in itertools.product(*values.values()):
            modifiers = dict(zip(values, drawn, strict=True))
            things.append(PhysicalObject(entity="", model=model, name="", modifiers=modifiers))
    return things


def _true_of(thing: PhysicalObject, library: ModelLibrary) -> dict[str, Scalar]:
    known = library.object_modifiers(thing.model)
    defaults = {kind: modifier.default for kind, modifier in {**PHYSICAL, **known}.items()}
    return {**defaults, "color": color_word(known, thing.modifiers), **thing.modifiers, MODEL: thing.model}
