"""The meaning of an instruction's text in a scene: the tasks that it may mean, to be judged.

A text is matched with every skill's templates. The words in place of a role are matched with the descriptions of the
scene's objects, those in place of another word with the skill's parameters. The skill's own generator then makes the
task, so that it has every argument that the evaluator needs.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from string import Formatter
from typing import Any

from roboxim_core.config import from_plain
from roboxim_core.errors import RoboximError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.modifiers import color_word
from roboxim_core.plain_data.wordings import english_wordings
from roboxim_core.specs import PhysicalObject, SceneSpec, TaskSpec
from roboxim_tasks.fixed_scene import FixedScene, FixedTaskConfig
from roboxim_tasks.roles import SPOKEN, task_objects
from roboxim_tasks.sequences.steps import is_sequence, own_objects, sentences_of, steps_of, task_of
from roboxim_tasks.skills import SKILLS, Skill

DRAWER = re.compile(r"(?P<drawer>\w+) drawer of the (?P<whole>.+)")


@dataclass(frozen=True, kw_only=True)
class Reading:
    """Meaning of a text in a scene."""

    understood: bool
    """Whether the text follows a template of a known skill."""
    tasks: tuple[TaskSpec, ...] = ()
    """Tasks that it may mean; empty: the scene allows none."""
    absent: tuple[str, ...] = ()
    """Descriptions in the text that fit no object of the scene."""


def read_instruction(
    text: str, scene: SceneSpec, library: ModelLibrary, templates: Mapping[str, Iterable[str]] | None = None
) -> Reading:
    """Return the meaning of an instruction in a scene.

    Args:
        text: The instruction.
        scene: The scene.
        library: The models.
        templates: Skill to further templates, beside the skill's own.
    """
    parts, order = sentences_of(text)
    if len(parts) > 1:
        readings = [read_instruction(part, scene, library, templates) for part in parts]
        if all(reading.understood for reading in readings):
            chosen = itertools.product(*(reading.tasks for reading in readings))
            absent = dict.fromkeys(thing for reading in readings for thing in reading.absent)
            tasks = tuple(task_of(steps, text, order) for steps in chosen)
            return Reading(understood=True, tasks=tasks, absent=tuple(absent))
    return _read_one(text, scene, library, templates)


def _read_one(
    text: str, scene: SceneSpec, library: ModelLibrary, templates: Mapping[str, Iterable[str]] | None
) -> Reading:
    """Return the meaning of an instruction of one step."""
    tasks: list[TaskSpec] = []
    absent: list[str] = []
    understood = False
    nouns = _nouns(library, (library.entity_model(entity).name for entity in scene.entities))
    for name in SKILLS:
        skill = SKILLS[name]
        for template in dict.fromkeys((*_templates(name), *(templates or {}).get(name, ()))):
            words = _match(template, text, skill, nouns)
            if words is None or not _roles(skill, words):
                continue
            understood = True
            missing, parameters, choices = _objects(skill, words, scene, library)
            absent += missing
            for chosen in choices:
                task = _task(skill, text, parameters, chosen, scene, library)
                if task is not None and task not in tasks:
                    tasks.append(task)
    return Reading(understood=understood, tasks=tuple(tasks), absent=tuple(dict.fromkeys(absent)) if not tasks else ())


def canonical_instruction(task: TaskSpec, library: ModelLibrary) -> str:
    """Return a task's instruction in its skill's first wording; empty: the instruction follows none of the wordings.

    Args:
        task: The task; one of an unknown skill has no other wording.
        library: Library of the nouns.
    """
    if task.skill not in SKILLS:
        return ""
    skill = SKILLS[task.skill]
    first = next(iter(skill.templates), "")
    names = {name for _, name, _, _ in Formatter().parse(first) if name}
    nouns = _nouns(library, (thing.name for thing in task.objects.values()))
    for template in _templates(task.skill):
        words = _match(template, task.instruction, skill, nouns)
        if words is not None and names <= words.keys():
            return first.format_map(words)
    return ""


def _templates(skill: str) -> tuple[str, ...]:
    """Return the wordings of a skill that are known: its own, and those of ``config/wordings``."""
    return tuple(dict.fromkeys((*SKILLS[skill].templates, *english_wordings(skill))))


def asks_for_same(first: TaskSpec, second: TaskSpec) -> bool:
    """Return whether two tasks are of the same skill, objects and words, thresholds aside."""
    if first.skill != second.skill:
        return False
    if is_sequence(first.skill):
        return all(map(asks_for_same, map(_alone, steps_of(first)), map(_alone, steps_of(second))))
    texts = {n for n, v in first.arguments.items() if isinstance(v, str)} | {"angle_deg"}
    return {t.entity for t in task_objects(first)} == {t.entity for t in task_objects(second)} and all(
        first.arguments.get(name) == second.arguments.get(name) for name in texts
    )


def _alone(step: TaskSpec) -> TaskSpec:
    """Return a step of a task without the objects that only other steps name."""
    own = own_objects(step)
    return replace(step, objects={role: thing for role, thing in step.objects.items() if role in own})


def _nouns(library: ModelLibrary, present: Iterable[str]) -> list[str]:
    """Return the nouns that a text may have, the longest first: of the library without its sets, and of what is there.

    Args:
        library: The models.
        present: Nouns of the objects that are there.
    """
    return sorted({*present, *(library.object(model).name for model in library.object_ids)}, key=len, reverse=True)


def _match(template: str, text: str, skill: Skill, nouns: Sequence[str]) -> dict[str, str] | None:
    """Return the words in place of a template's names; none: the text does not follow it.

    A role's words end with one of the nouns if possible, so that "Push the soda can back" is parsed correctly.
    """
    thing = rf"(?:[\w-]+ )*?(?:{'|'.join(map(re.escape, nouns))})|.+?"
    pattern = ""
    for literal, name, _, _ in Formatter().parse(template):
        pattern += re.escape(literal)
        if name:
            expression = f"(?P<{name}>{thing if name in skill.roles else '.+?'})"
            pattern += f"(?P={name})" if f"(?P<{name}>" in pattern else expression
    found = re.fullmatch(pattern, text.strip().rstrip("."), re.IGNORECASE)
    return found.groupdict() if found else None


def _roles(skill: Skill, words: Mapping[str, str]) -> bool:
    """Return whether the words for placeholders other than roles fit the skill's parameters."""
    return all(name in skill.roles or _parameter(skill, name, word) for name, word in words.items())


def _parameter(skill: Skill, name: str, word: str) -> dict[str, Any]:
    """Return the skill's parameter that a word of the instruction sets, by name; empty: it sets none."""
    for field in fields(skill.Parameters):
        if field.name == name or field.name.startswith(f"{name}_"):
            default = getattr(skill.Parameters(), field.name)
            if isinstance(default, str):
                return {field.name: word.lower()}
            try:
                return {field.name: float(word)}
            except ValueError:
                return {}
    return {}


def _objects(
    skill: Skill, words: Mapping[str, str], scene: SceneSpec, library: ModelLibrary
) -> tuple[list[str], dict[str, Any], Iterator[dict[str, PhysicalObject]]]:
    """Return descriptions that fit nothing, parameters, and the possible objects by role."""
    parameters: dict[str, Any] = {}
    fitting: dict[str, list[PhysicalObject]] = {}
    missing = []
    for name, word in words.items():
        if name not in skill.roles:
            parameters |= _parameter(skill, name, word)
    for role in skill.roles:
        phrase = words.get(role)
        drawer = DRAWER.fullmatch(phrase) if phrase else None
        if drawer and "drawer" in {field.name for field in fields(skill.Parameters)}:
            parameters["drawer"], phrase = drawer["drawer"].lower(), drawer["whole"]
        things = [_thing(entity.name, scene, library) for entity in scene.entities]
        suited = [t for t in things if skill.roles[role].suits(library.object(t.model, t.modifiers))]
        fitting[role] = [t for t in suited if phrase is None or phrase.lower() in _descriptions(t, library)]
        if phrase is not None and not fitting[role]:
            missing.append(phrase)
    combined = (dict(zip(fitting, chosen, strict=True)) for chosen in itertools.product(*fitting.values()))
    return missing, parameters, (c for c in combined if len({t.entity for t in c.values()}) == len(c))


def _thing(entity: str, scene: SceneSpec, library: ModelLibrary) -> PhysicalObject:
    spec = scene.entity(entity)
    return PhysicalObject(
        entity=entity, model=spec.model, name=library.entity_model(spec).name, modifiers=spec.modifiers
    )


def _descriptions(thing: PhysicalObject, library: ModelLibrary) -> set[str]:
    """Return every true description of an object: its noun with any of the words for its modifiers."""
    known = library.object_modifiers(thing.model)
    defaults = {kind: known[kind].default for kind in SPOKEN if kind in known}
    true = {**defaults, "color": color_word(known, thing.modifiers), **thing.modifiers}
    values = [str(true.get(kind, "")) for kind in SPOKEN]  # a modifier that is not given has the model's default
    return {
        " ".join((*(value for value, named in zip(values, chosen, strict=True) if named and value), thing.name)).lower()
        for chosen in itertools.product((False, True), repeat=len(values))
    }


def _task(
    skill: Skill, text: str, parameters: Mapping[str, Any], chosen: Mapping[str, PhysicalObject], scene: SceneSpec,
    library: ModelLibrary,
) -> TaskSpec | None:  # fmt: skip
    """Make the task of a text about certain objects of a scene; none: the skill refuses it."""
    models = {role: library.entity_model(scene.entity(thing.entity)) for role, thing in chosen.items()}
    fixed = FixedScene(instruction=text, roles={role: thing.entity for role, thing in chosen.items()}, scene=scene)
    try:
        values: Any = from_plain(dict(parameters), skill.Parameters, source="an instruction")
        skill.check(values, {role: (model,) for role, model in models.items()})
        if skill.mismatch(values, models):
            return None
        return FixedTaskConfig(skill=skill.name, parameters=values, lenient=values, fixed=fixed).task("test", library)
    except RoboximError:
        return None
