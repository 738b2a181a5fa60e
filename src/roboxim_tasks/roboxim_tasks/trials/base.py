"""Trials of a skill's evaluator: scripted cheats that must fail, and other honest ways that must succeed.

A trial is a function like a skill's `stages`: it gets the scene and yields candidates, each the stages of a `Script`.
What it yields is executed through the delta controller, as a policy's actions are::

    @cheat("place_on", reason="dropped")
    def drop(scene):
        \"\"\"Let go of it 30 cm above the support.\"\"\"
        for grasp, goal in own_ways(scene):
            script = Script(scene)
            script.pick("target", grasp)
            script.place(goal, onto="support", drop_m=0.3)
            yield script.stages
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import yaml

from roboxim_core.config import config_dirs
from roboxim_core.plain_data import yaml_text
from roboxim_core.plain_data.documents import read_text
from roboxim_core.plain_data.merging import merged
from roboxim_core.registry import Registry
from roboxim_tasks.motion import ExpertScene, Stage

Stages = Callable[[ExpertScene], Iterable[tuple[Stage, ...]]]
MIN_TRIALS = 3
"""Least number of cheats, and of honest ways, per skill."""
ALONE: Mapping[str, Any] = {"distractors": {"minimum": 0, "maximum": 0}}
"""Changes to a skill's own task in every trial, in addition to the removal of cameras."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """A scripted way to act in a skill's scenes, and the verdict that the evaluator must give."""

    skill: str
    """The skill."""
    name: str
    """Name, unique for the skill."""
    does: str
    """Description in a sentence."""
    stages: Stages
    """Generator of the candidates, best first."""
    reason: str = ""
    """Reason of a cheat's failure; empty: the trial is honest and must succeed."""
    change: Mapping[str, Any] = field(default_factory=dict)
    """Changes to the skill's own task."""

    @property
    def honest(self) -> bool:
        """Whether the trial must succeed."""
        return not self.reason

    def config(self) -> str:
        """Return the task configuration of its scenes as YAML text."""
        files = (folder / "tasks" / f"{self.skill}.yaml" for folder in config_dirs())
        own: dict[str, Any] = next(
            (yaml_text.parse(read_text(file), source=str(file)) for file in files if file.is_file()),
            {"skill": self.skill},
        )
        own["reset"] = {**own.get("reset", {}), "cameras": {"names": []}}
        return str(yaml.safe_dump(merged(merged(own, ALONE), self.change)))


TRIALS: Registry[Trial] = Registry("trial")
"""``<skill>/<name>`` to the trial; skills outside of RoboXim add theirs by the entry point ``roboxim.trial``."""


def cheat(*skills: str, reason: str, change: Mapping[str, Any] | None = None) -> Callable[[Stages], Stages]:
    """Register a function as a cheat for some skills.

    Args:
        skills: The skills.
        reason: The verdict's reason for at least half of the episodes; all must fail.
        change: Changes to the skill's own task.
    """
    return _register(skills, reason, change or {})


def honest(*skills: str, change: Mapping[str, Any] | None = None) -> Callable[[Stages], Stages]:
    """Register a function as an honest way to solve some skills.

    Args:
        skills: The skills.
        change: Changes to the skill's own task.
    """
    return _register(skills, "", change or {})


def _register(skills: Iterable[str], reason: str, change: Mapping[str, Any]) -> Callable[[Stages], Stages]:
    def add(stages: Stages) -> Stages:
        name, does = stages.__name__, (stages.__doc__ or "").splitlines()[0]
        for skill in skills:
            trial = Trial(skill=skill, name=name, does=does, stages=stages, reason=reason, change=change)
            TRIALS.register(f"{skill}/{name}")(trial)
        return stages

    return add


def trials_of(skill: str) -> list[Trial]:
    """Return the trials of a skill, cheats first."""
    found = (TRIALS[key] for key in TRIALS)
    return sorted((t for t in found if t.skill == skill), key=lambda t: (t.honest, t.name))


def missing_trials(skill: str) -> str:
    """Return which of the three cheats and three honest ways a skill lacks, or an empty text."""
    trials = trials_of(skill)
    lacks = [
        f"{MIN_TRIALS - count} more {kind}"
        for kind, count in (
            ("cheats (@cheat)", sum(not trial.honest for trial in trials)),
            ("honest ways (@honest)", sum(trial.honest for trial in trials)),
        )
        if count < MIN_TRIALS
    ]
    return f"skill '{skill}' needs {' and '.join(lacks)} in roboxim_tasks.trials" if lacks else ""
