"""The cells that the expert is measured on: combinations of skill and object, each a task configuration."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import yaml

from roboxim_core.config import load_yaml, named_config
from roboxim_core.models.description import ObjectModel
from roboxim_core.models.library import ModelLibrary
from roboxim_runs.episodes.task_choice import task_text
from roboxim_tasks.config import merged
from roboxim_tasks.skills import SKILLS

OBJECTS = ("cube", "apple", "soda_can", "onion", "cucumber", "knife")
RELATIONS = ("place_left_of", "place_right_of", "place_in_front_of", "place_behind")
ANY_OBJECT = ("pick_up", "place_on", *RELATIONS, "rotate")
"""Skills that apply to every graspable object; other skills apply to the objects that their configuration lists."""
DRAWERS = ("top", "middle", "bottom")
ARTICULATED = {"flip_switch": "switch", "turn_knob": "knob", "open_door": "microwave", "close_door": "microwave"}
"""Skills of one object, whose configuration says it all."""
LONG = tuple(load_yaml(named_config("suites", "long"))["cells"][0]["tasks"])
"""Tasks of several steps."""


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One combination of skill and object, with a number of distractors."""

    skill: str
    """The skill."""
    thing: str
    """Object or part that the cell is about, e.g. ``apple`` or ``top``."""
    clutter: int | None
    """Distractors; none: as many as the task says."""
    core: bool
    """Whether every robot-learning suite has this combination; such cells are measured with more episodes."""
    change: dict[str, Any] = field(default_factory=dict)
    """Differences from the skill's default configuration."""
    task: str = ""
    """Task of ``config/tasks`` that the cell uses, if not the skill's default task."""
    robot: str = ""
    """Robot that acts; empty: the task's own."""

    @property
    def name(self) -> str:
        """Name in tables and files."""
        return f"{self.robot}/{self.label}" if self.robot else self.label

    @property
    def label(self) -> str:
        """Name without the robot."""
        name = f"{self.skill}/{self.thing}"
        return name if self.clutter is None else f"{name}/{self.clutter}"

    def config(self) -> str:
        """Return the task configuration as YAML text, with the workspace camera only."""
        plain = yaml.safe_load(task_text(self.task) if self.task else task_text(skill=self.skill))
        cameras = {"reset": {"cameras": {**plain["reset"].get("cameras", {}), "names": ["workspace"]}}}
        count = {"minimum": self.clutter, "maximum": self.clutter}
        clutter = {} if self.clutter is None else {"distractors": count}
        robot = {"robot": self.robot} if self.robot else {}
        return yaml.safe_dump(merged(merged(merged(plain, cameras), clutter), self.change | robot))


def cells(clutter: int) -> list[Cell]:
    """Return every combination of a skill and an object that the skill applies to."""
    return [Cell(clutter=clutter, **values) for values in (*_core_cells(), *_other_cells())]


def long_cells() -> list[Cell]:
    """Return the shipped tasks of several steps, with their own distractors."""
    return [Cell(skill="steps", thing=task, clutter=None, core=False, task=task) for task in LONG]


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
    known = {model: library.object(model) for model in library.object_ids}
    for drawer in DRAWERS:
        yield {"skill": "close_drawer", "thing": drawer, "core": False, "change": _drawer(drawer)}
    for skill, thing in ARTICULATED.items():
        yield {"skill": skill, "thing": thing, "core": False}
    for skill in sorted(set(SKILLS) - {"open_drawer", "close_drawer", "push_button", *ARTICULATED}):
        models = SKILLS[skill].suited(known, {"container": "bowl"})["target"]
        if skill not in (*ANY_OBJECT, "put_into"):
            models = yaml.safe_load(task_text(skill=skill))["objects"]["target"]["models"]["values"]
        for model in models:
            if (skill, model) not in done:
                yield {"skill": skill, "thing": model, "core": False, "change": _objects(target=model)}
    yield from _other_places(known)


def _other_places(models: Mapping[str, ObjectModel]) -> Iterator[dict[str, Any]]:
    """Yield the cells of the objects to put something on or into, with the targets of the skill's default task."""
    for skill, role in (("place_on", "support"), ("stack", "support"), ("put_into", "container")):
        configured = yaml.safe_load(task_text(skill=skill))["objects"][role]["models"]["values"]
        for model in SKILLS[skill].suited(models)[role]:
            if model not in configured and (skill, model) != ("put_into", "cabinet"):  # whose top drawer has its own
                change = yaml.safe_load(task_text(skill=skill, objects=(f"{role}={model}",)))
                yield {"skill": skill, "thing": f"{role}_{model}", "core": False, "change": change}
    yield {"skill": "put_into", "thing": "top_drawer", "core": False, "task": "put_into_drawer"}


def _objects(**models: str) -> dict[str, Any]:
    return {"objects": {role: {"models": {"values": [model]}} for role, model in models.items()}}


def _drawer(name: str) -> dict[str, Any]:
    return {"arguments": {"drawer": {"values": [name]}}}
