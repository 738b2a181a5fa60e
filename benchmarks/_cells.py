"""What the expert is measured on: cells of skill and object, each a task configuration."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import yaml

from roboxim_bringup.task_choice import task_text
from roboxim_core.models.library import ModelLibrary
from roboxim_tasks.config import merged
from roboxim_tasks.skills import SKILLS

OBJECTS = ("cube", "apple", "soda_can", "onion", "cucumber", "knife")
RELATIONS = ("place_left_of", "place_right_of", "place_in_front_of", "place_behind")
ANY_OBJECT = ("pick_up", "place_on", *RELATIONS, "rotate")
"""Skills that make sense for whatever can be grasped; the others for what their configuration lists."""
DRAWERS = ("top", "middle", "bottom")
NOT_AS_CONTAINER = ("cabinet", "mug")
"""A cabinet's top drawer has a cell of its own; nothing fits into a mug."""


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One combination of skill and object, among a number of distractors."""

    skill: str
    """The skill."""
    thing: str
    """Object or part that the cell is about, e.g. ``apple`` or ``top``."""
    clutter: int
    """Distractors."""
    core: bool
    """Whether it is one of the combinations that every robot-learning suite has; they are measured more often."""
    change: dict[str, Any] = field(default_factory=dict)
    """What differs from the skill's own configuration."""
    task: str = ""
    """Task of ``config/tasks`` that it is, if not the skill's own."""

    @property
    def name(self) -> str:
        """Name in tables and files."""
        return f"{self.skill}/{self.thing}/{self.clutter}"

    def config(self) -> str:
        """Return the task configuration as YAML text, with the workspace camera alone."""
        plain = yaml.safe_load(task_text(self.task) if self.task else task_text(skill=self.skill))
        cameras = {"reset": {"cameras": {**plain["reset"].get("cameras", {}), "names": ["workspace"]}}}
        clutter = {"distractors": {"minimum": self.clutter, "maximum": self.clutter}}
        return yaml.safe_dump(merged(merged(merged(plain, cameras), clutter), self.change))


def cells(clutter: int) -> list[Cell]:
    """Return every combination of a skill and an object that it makes sense for."""
    return [Cell(clutter=clutter, **values) for values in (*_core_cells(), *_other_cells())]


def _core_cells() -> Iterator[dict[str, Any]]:
    for skill in ("pick_up", "place_on", *RELATIONS, "rotate"):
        for model in OBJECTS:
            change: dict[str, Any] = _objects(target=model)
            if skill == "place_on":
                change = _objects(target=model, support="plate")
            yield {"skill": skill, "thing": model, "core": True, "change": change}
    yield {"skill": "push_button", "thing": "button", "core": True}
    for drawer in DRAWERS:
        yield {"skill": "open_drawer", "thing": drawer, "core": True, "change": _drawer(drawer)}


def _other_cells() -> Iterator[dict[str, Any]]:
    done = {(values["skill"], values["thing"]) for values in _core_cells()}
    library = ModelLibrary()
    for drawer in DRAWERS:
        yield {"skill": "close_drawer", "thing": drawer, "core": False, "change": _drawer(drawer)}
    for skill in sorted(set(SKILLS) - {"open_drawer", "close_drawer", "push_button"}):
        role = SKILLS[skill].roles["target"]
        models = [model for model in library.object_ids if role.suits(library.object(model))]
        if skill == "put_into":
            task, bowl = SKILLS[skill], library.object("bowl")
            apart = {model: {"container": bowl, "target": library.object(model)} for model in models}
            models = [model for model in models if not task.mismatch(task.Parameters(), apart[model])]
        elif skill not in ANY_OBJECT:
            models = yaml.safe_load(task_text(skill=skill))["objects"]["target"]["models"]["values"]
        for model in models:
            if (skill, model) not in done:
                yield {"skill": skill, "thing": model, "core": False, "change": _objects(target=model)}
    yield from _other_places(library)


def _other_places(library: ModelLibrary) -> Iterator[dict[str, Any]]:
    """Yield the cells of what a thing is put on or into, with the targets of the skill's own task."""
    for skill, role in (("place_on", "support"), ("stack", "support"), ("put_into", "container")):
        configured = yaml.safe_load(task_text(skill=skill))["objects"][role]["models"]["values"]
        for model in library.object_ids:
            known = configured + list(NOT_AS_CONTAINER if role == "container" else ())
            if SKILLS[skill].roles[role].suits(library.object(model)) and model not in known:
                change = yaml.safe_load(task_text(skill=skill, objects=(f"{role}={model}",)))
                yield {"skill": skill, "thing": f"{role}_{model}", "core": False, "change": change}
    yield {"skill": "put_into", "thing": "top_drawer", "core": False, "task": "put_into_drawer"}


def _objects(**models: str) -> dict[str, Any]:
    return {"objects": {role: {"models": {"values": [model]}} for role, model in models.items()}}


def _drawer(name: str) -> dict[str, Any]:
    return {"arguments": {"drawer": {"values": [name]}}}
