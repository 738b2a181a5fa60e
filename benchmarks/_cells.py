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

    @property
    def name(self) -> str:
        """Name in tables and files."""
        return f"{self.skill}/{self.thing}/{self.clutter}"

    def config(self) -> str:
        """Return the task configuration as YAML text, with the workspace camera alone."""
        plain = yaml.safe_load(task_text(skill=self.skill))
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
        models = yaml.safe_load(task_text(skill=skill))["objects"]["target"]["models"]["values"]
        if skill in ANY_OBJECT:
            models = [
                model for model in library.object_ids if SKILLS[skill].roles["target"].suits(library.object(model))
            ]
        for model in models:
            if (skill, model) not in done:
                yield {"skill": skill, "thing": model, "core": False, "change": _objects(target=model)}


def _objects(**models: str) -> dict[str, Any]:
    return {"objects": {role: {"models": {"values": [model]}} for role, model in models.items()}}


def _drawer(name: str) -> dict[str, Any]:
    return {"arguments": {"drawer": {"values": [name]}}}
