"""Combinations of objects that are never drawn: what matches one, and whether they leave anything to draw."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence

from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.modifiers import PHYSICAL, ModifierModel
from roboxim_core.specs import PhysicalObject, Scalar
from roboxim_tasks.choices import Choice
from roboxim_tasks.roles import SPOKEN
from roboxim_tasks.task_config import ObjectConfig

MODEL = "model"
"""Key of an excluded combination beside the modifiers."""
Combination = Mapping[str, Mapping[str, Scalar]]
"""Role to ``model`` and modifiers."""
ENOUGH = 20_000
"""Different draws after which nobody asks whether all of them are excluded."""


def taken(name: str, choice: Choice, allowed: Mapping[str, ModifierModel]) -> Choice | None:
    """Return what a model draws a modifier from; none if it is drawn without it.

    Args:
        name: The modifier.
        choice: What the task says.
        allowed: What the model takes.
    """
    mine = choice.only(allowed[name].words(name)) if name in allowed and name in SPOKEN else choice
    return mine if name in allowed or name in PHYSICAL else None


def matches(objects: Mapping[str, PhysicalObject], combination: Combination, library: ModelLibrary) -> bool:
    """Tell whether objects by role are an excluded combination; a role that is not drawn yet is not.

    Modifiers that an object was drawn without have the values that its model has by default.
    """
    return all(
        role in objects
        and wanted.items() <= {**_defaults(objects[role].model, library), **objects[role].modifiers,
                               MODEL: objects[role].model}.items()
        for role, wanted in combination.items()
    )  # fmt: skip


def all_excluded(objects: Mapping[str, ObjectConfig], exclude: Sequence[Combination], library: ModelLibrary) -> bool:
    """Tell whether every draw is excluded, as far as that can be told by counting: a value of a range is none."""
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
    """Return the objects that may fill a role, as far as they differ in some kinds of modifiers."""
    things = []
    for model in map(str, config.models.drawable):
        allowed = library.object_modifiers(model)
        choices = {kind: taken(kind, config.modifiers[kind], allowed) for kind in kinds if kind in config.modifiers}
        values = {kind: choice.drawable or (math.nan,) for kind, choice in choices.items() if choice is not None}
        for drawn in itertools.product(*values.values()):
            modifiers = dict(zip(values, drawn, strict=True))
            things.append(PhysicalObject(entity="", model=model, name="", modifiers=modifiers))
    return things


def _defaults(model: str, library: ModelLibrary) -> dict[str, Scalar]:
    return {kind: modifier.default for kind, modifier in {**PHYSICAL, **library.object_modifiers(model)}.items()}
