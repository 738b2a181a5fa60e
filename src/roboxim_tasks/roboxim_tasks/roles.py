"""Roles of a task's objects, and the words that distinguish objects: an instruction must fit only one solution."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from string import Formatter

from roboxim_core.models.description import ObjectModel
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.modifiers import color_word
from roboxim_core.specs import PhysicalObject, SceneSpec, TaskSpec

DISTRACTOR = "distractor"
STAY = "distractors_stay_m"
"""Argument that a task of any skill may have: the largest displacement of its distractors [m]."""
UPRIGHT = "target_upright"
"""Argument of tasks whose target has a right way up and has to keep it; set by generators."""
LIMITS = "limits"
"""Argument with the limits of a task (`roboxim_tasks.limits`), JSON."""
GENERAL = frozenset({STAY, UPRIGHT, LIMITS})
"""Arguments that are no parameters of a skill."""
SIZE_SLACK = 0.1
"""Largest relative deviation of an object's ``scale`` from a size word's factor at which the word may name it."""


@dataclass(frozen=True, kw_only=True)
class Role:
    """Role of an object in a skill's instruction."""

    affordance: str = ""
    """Affordance that the model must have, e.g. ``graspable``; empty: any model."""
    models: tuple[str, ...] = ("cube",)
    """Default models of the role."""
    max_width_m: float = 0.0
    """Largest allowed length of the longest side of the object's base [m]; 0: any."""

    def suits(self, model: ObjectModel) -> bool:
        """Return whether a model can fill the role."""
        fits = not self.max_width_m or max(model.size[:2]) <= self.max_width_m
        return fits and (not self.affordance or self.affordance in model.affordances)


def distractor_role(number: int) -> str:
    """Return the role, and entity name, of the distractor with a number from 1."""
    return f"{DISTRACTOR}_{number}"


def task_objects(task: TaskSpec) -> tuple[PhysicalObject, ...]:
    """Return the objects in the instruction, in the order of their roles."""
    return tuple(thing for role, thing in task.objects.items() if not role.startswith(f"{DISTRACTOR}_"))


def task_distractors(task: TaskSpec) -> tuple[PhysicalObject, ...]:
    """Return the distractors, in order."""
    return tuple(thing for role, thing in task.objects.items() if role.startswith(f"{DISTRACTOR}_"))


SPOKEN = ("size", "color", "material")
"""Modifiers that instructions name, in the order of the words."""


def description(thing: PhysicalObject) -> str:
    """Return how an instruction names an object, e.g. ``small red cube``."""
    return " ".join((*(str(thing.modifiers[kind]) for kind in SPOKEN if kind in thing.modifiers), thing.name))


def fits_description(thing: PhysicalObject, named: PhysicalObject, library: ModelLibrary) -> bool:
    """Return whether an object fits the description of another one.

    A modifier that the object was drawn without has its model's default value: an apple is red even if its description
    does not say so, and a rubber cube without a colour is black. For an object with a ``scale``, the scale counts and
    not its size word.
    """
    if thing.name != named.name:
        return False
    defaults = library.object_modifiers(thing.model)

    def fits(kind: str) -> bool:
        wanted = named.modifiers[kind]
        if kind == "size" and thing.modifiers.get("scale", 1.0) != 1.0:
            return _as_large_as(thing, named, library)
        if kind == "color":
            return color_word(defaults, thing.modifiers) == wanted
        default = defaults[kind].default if kind in defaults else None
        return thing.modifiers.get(kind, default) == wanted

    return all(fits(kind) for kind in SPOKEN if kind in named.modifiers)


def _as_large_as(thing: PhysicalObject, named: PhysicalObject, library: ModelLibrary) -> bool:
    """Return whether another's size word fits an object with a scale: the scale is near its factor, or beyond it."""
    factors = library.object_modifiers(named.model)["size"].factors
    own = library.object_modifiers(thing.model).get("size")
    word = str(thing.modifiers.get("size", own.default if own else ""))
    factor = float(thing.modifiers["scale"]) * (own.factors[word] if own else 1.0)
    wanted = factors[str(named.modifiers["size"])]
    small_enough, large_enough = factor <= wanted * (1 + SIZE_SLACK), factor >= wanted * (1 - SIZE_SLACK)
    if wanted == 1.0:
        return small_enough and large_enough
    return small_enough if wanted < 1.0 else large_enough


@dataclass(frozen=True, kw_only=True)
class Wording:
    """The objects that an instruction names, and the check which other objects could be meant."""

    library: ModelLibrary
    """Library of the objects' default modifiers."""
    roles: Mapping[str, Role]
    """Roles of the skill, and the objects that may fill them."""
    named: frozenset[str]
    """Roles that the instruction names."""

    @staticmethod
    def of_template(template: str, roles: Mapping[str, Role], library: ModelLibrary) -> Wording:
        """Return the wording of an instruction template, e.g. ``Pick up the {target}``."""
        fields = {name for _, name, _, _ in Formatter().parse(template) if name}
        return Wording(library=library, roles=roles, named=frozenset(fields & roles.keys()))

    @staticmethod
    def of_task(task: TaskSpec, roles: Mapping[str, Role], library: ModelLibrary) -> Wording:
        """Return the wording of a task's instruction, from a template or written by the skill."""
        text, named = task.instruction.lower(), set()
        described: dict[str, set[str]] = {}
        for role in roles.keys() & task.objects.keys():
            described.setdefault(description(task.objects[role]).lower(), set()).add(role)
        for words in sorted(described, key=len, reverse=True):  # a cube is not named by "red cube" if that is another
            text, count = re.subn(rf"(?<!\w){re.escape(words)}(?!\w)", "|", text)
            named |= described[words] if count else set()
        return Wording(library=library, roles=roles, named=frozenset(named))

    def could_be_meant(self, thing: PhysicalObject, own: str, role: str, meant: PhysicalObject) -> bool:
        """Return whether an object could be taken for the object of a role.

        A named object is distinguished by its description. A role that is not named ("Pick it up", "Open the top
        drawer") may be any object that can fill it, except those that the instruction names.

        Args:
            thing: An object in the scene.
            own: The object's role; any other text if it has none.
            role: The other role.
            meant: The object of that role.
        """
        if role in self.named:
            return fits_description(thing, meant, self.library)
        model = self.library.object(thing.model, thing.modifiers)
        return own not in self.named and (
            thing.name == meant.name or role in self.roles and self.roles[role].suits(model)
        )

    def distinct(self, first: tuple[str, PhysicalObject], second: tuple[str, PhysicalObject]) -> bool:
        """Return whether the objects of two roles cannot be taken for each other."""
        (role, thing), (other_role, other) = first, second
        return not (
            self.could_be_meant(thing, role, other_role, other) or self.could_be_meant(other, other_role, role, thing)
        )

    def could_be_any(self, thing: PhysicalObject, objects: Mapping[str, PhysicalObject]) -> bool:
        """Return whether an object without a role could be taken for the object of a role."""
        return any(self.could_be_meant(thing, "", role, meant) for role, meant in objects.items())

    def true_to(self, role: str, thing: PhysicalObject, meant: PhysicalObject) -> bool:
        """Return whether the instruction's description of a role's object is true; a "small" one may be scaled up."""
        return role not in self.named or fits_description(thing, meant, self.library)

    def mistakable(self, scene: SceneSpec, task: TaskSpec) -> Iterator[PhysicalObject]:
        """Yield the objects of a scene that make an instruction ambiguous or untrue."""
        own = {thing.entity: role for role, thing in task.objects.items()}
        objects = {role: thing for role, thing in task.objects.items() if thing in task_objects(task)}
        for entity in scene.entities:
            noun, role = self.library.entity_model(entity).name, own.get(entity.name, "")
            thing = PhysicalObject(entity=entity.name, model=entity.model, name=noun, modifiers=entity.modifiers)
            others = {name: meant for name, meant in objects.items() if name != role}
            if any(self.could_be_meant(thing, role, name, meant) for name, meant in others.items()) or (
                role in objects and not self.true_to(role, thing, objects[role])
            ):
                yield thing
