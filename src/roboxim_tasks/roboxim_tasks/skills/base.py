"""What a skill is: its generator, resetter, executor and evaluator side by side in one file.

Adding a skill touches one new file here and one task YAML.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

from roboxim_core.config import from_plain
from roboxim_core.registry import Registry
from roboxim_core.specs import TaskSpec
from roboxim_core.state import StateRecord
from roboxim_tasks.components import Constraint, ResetContext
from roboxim_tasks.generators import GenerationContext, generate_task
from roboxim_tasks.motion import ExpertScene, Stage


@dataclass(frozen=True, kw_only=True)
class Assessment:
    """What an evaluator says of one tick; `roboxim_tasks.judging.Judge` makes a verdict of it."""

    solved: bool
    """Whether everything that the skill demands holds at this tick."""
    failed: bool = False
    """Whether the task can no longer be solved."""
    reason: str = ""
    """What is missing or why it failed, in snake case; empty when solved."""
    predicates: dict[str, float] = field(default_factory=dict)
    """Predicate name to 0, 1, or a measure with its unit in the name."""


class Evaluator(Protocol):
    """A fold over an episode's ticks; it sees nothing but state records."""

    hold_s: float
    """How long the task must stay solved without a break before it counts [s]."""

    def assess(self, state: StateRecord) -> Assessment:
        """Assess the next tick."""
        ...


class Skill(ABC):
    """A skill with its four sides."""

    name: ClassVar[str] = ""
    """Registered name."""
    roles: ClassVar[tuple[str, ...]] = ("target",)
    """Roles of the objects that the instruction speaks of."""
    templates: ClassVar[tuple[str, ...]] = ()
    """Instruction templates with roles in braces."""
    components: ClassVar[tuple[str, ...]] = ("robot", "objects", "distractors", "cameras", "lights")
    """Reset components that it always uses, in order."""
    max_steps: ClassVar[int] = 100
    """Actions after which an episode has failed."""
    Parameters: ClassVar[type]
    """Frozen dataclass of scalars with defaults: the ``parameters`` of the YAML, the ``arguments`` of the task."""

    def generate(self, context: GenerationContext) -> TaskSpec:
        """Draw a task (generator)."""
        return generate_task(context, arguments=context.config.parameters)

    @abstractmethod
    def constraints(self, context: ResetContext) -> Sequence[Constraint]:
        """Return what a drawn scene must meet: reachable, not solved already (resetter)."""

    @abstractmethod
    def stages(self, scene: ExpertScene) -> Sequence[tuple[Stage, ...]]:
        """Return the candidate ways to solve the task, best first, each as stages (executor).

        The expert times, verifies and executes the first candidate that holds.
        """

    @abstractmethod
    def evaluator(self, task: TaskSpec, initial: StateRecord) -> Evaluator:
        """Return the fold that tells whether the task is solved (evaluator).

        Args:
            task: The task.
            initial: State record of tick 0.
        """


SKILLS: Registry[Skill] = Registry("skill")


def register(cls: type[Skill]) -> type[Skill]:
    """Register a skill under its ``name``."""
    SKILLS.register(cls.name)(cls())
    return cls


def parameters_of(task: TaskSpec, cls: type[Any]) -> Any:
    """Return a task's arguments as the skill's parameters.

    Raises:
        ConfigError: When an argument is unknown or of a wrong kind.
    """
    return from_plain(dict(task.arguments), cls, source=f"arguments of task '{task.instruction}'")
