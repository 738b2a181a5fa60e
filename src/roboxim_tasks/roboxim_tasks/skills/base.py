"""Base class of skills: generator, resetter, executor and evaluator side by side in one file.

A new skill takes one new file here and one task YAML.
"""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import is_dataclass
from typing import Any, ClassVar

from roboxim_core.config import from_plain
from roboxim_core.models.description import ObjectModel
from roboxim_core.registry import Registry
from roboxim_core.specs import TaskSpec
from roboxim_core.state import StateRecord
from roboxim_tasks.components import Constraint, ResetContext
from roboxim_tasks.measures import Assessment, Evaluator
from roboxim_tasks.motion import ExpertScene, Stage
from roboxim_tasks.roles import GENERAL, Role
from roboxim_tasks.sampling.generators import GenerationContext, generate_task


class Skill(ABC):
    """A skill with its four sides: generator, resetter, executor and evaluator."""

    name: ClassVar[str] = ""
    """Registered name."""
    roles: ClassVar[Mapping[str, Role]] = {"target": Role(affordance="graspable")}
    """Objects in the instruction, in the order of their placement."""
    templates: ClassVar[tuple[str, ...]] = ()
    """Instruction templates with roles and parameters in braces. The first is canonical, the others paraphrase it."""
    words: ClassVar[tuple[str, ...]] = ()
    """Names in templates besides the roles; the generator supplies their words."""
    components: ClassVar[tuple[str, ...]] = ("robot", "objects", "distractors", "cameras", "lights")
    """Reset components that the skill always uses, in order."""
    reset: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    """Reset component to the keys whose defaults this skill changes; a task's configuration takes precedence."""
    max_steps: ClassVar[int] = 100
    """Actions after which an episode has failed, at the default control rate; other rates keep the same duration."""
    rotations: ClassVar[int] = 2
    """Directions in which the skill turns the tool beside moving it: 2 if the tool points down at any yaw, 3 if it
    leans to any side. Arms of five joints have 2, see `RobotModel.rotations`."""
    event: ClassVar[bool] = False
    """Whether success is an event that need not last, such as a press; in a longer task it counts from its turn on."""
    moving_fingers: ClassVar[int] = 1
    """Fingers that must move: 1 if it only grasps or presses, 2 if it relies on both moving alike."""
    Parameters: ClassVar[type]
    """Frozen dataclass of scalars with defaults: the ``parameters`` of the YAML, the ``arguments`` of the task."""

    def check(self, parameters: Any, models: Mapping[str, Sequence[ObjectModel]]) -> None:  # noqa: B027
        """Refuse parameters that do not suit the objects. Called when a task is loaded.

        Args:
            parameters: Instance of `Parameters`.
            models: Role to the models that may fill it.

        Raises:
            ConfigError: When a parameter does not suit; names it and the allowed values.
        """

    def mismatch(self, parameters: Any, models: Mapping[str, ObjectModel]) -> str:
        """Return why models do not go together, e.g. because one does not fit into another; empty if they do.

        Args:
            parameters: Instance of `Parameters`.
            models: Role to model.
        """
        return ""

    def suited(self, models: Mapping[str, ObjectModel], fixed: Mapping[str, str] | None = None) -> dict[str, list[str]]:
        """Return the models of each role that go together with some models of the other roles.

        Args:
            models: Model id to model.
            fixed: Role to the id of the only model that may fill it.
        """
        fills = {
            role: [i for i, model in models.items() if wanted.suits(model) and i == (fixed or {}).get(role, i)]
            for role, wanted in self.roles.items()
        }
        found: dict[str, set[str]] = {role: set() for role in fills}
        for chosen in itertools.product(*fills.values()):
            by_role = dict(zip(fills, chosen, strict=True))
            if not self.mismatch(self.Parameters(), {role: models[i] for role, i in by_role.items()}):
                for role, model_id in by_role.items():
                    found[role].add(model_id)
        return {role: sorted(ids) for role, ids in found.items()}

    def generate(self, context: GenerationContext) -> TaskSpec:
        """Draw a task (generator)."""
        return generate_task(context)

    @abstractmethod
    def constraints(self, context: ResetContext) -> Sequence[Constraint]:
        """Return the constraints of a drawn scene, e.g. reachable and not already solved (resetter)."""

    @abstractmethod
    def stages(self, scene: ExpertScene) -> Iterable[tuple[Stage, ...]]:
        """Yield candidate solutions of the task, best first, each as stages (executor).

        The expert executes the first candidate that it can verify; later ones are never generated. The expert calls
        this method again when it replans within an episode, see `roboxim_tasks.script`.
        """

    @abstractmethod
    def evaluator(self, task: TaskSpec, initial: StateRecord) -> Evaluator:
        """Return the fold that judges whether the task is solved (evaluator).

        Args:
            task: The task.
            initial: State record of tick 0.
        """


SKILLS: Registry[Skill] = Registry("skill", checks="roboxim_tasks.sampling.conformance")


@SKILLS.conformance
def says_what_it_is(name: str, item: Skill) -> None:
    """Refuse a skill whose name, roles, templates or parameters cannot be used in a task."""
    assert isinstance(item, Skill), "it is no instance of Skill"
    assert item.name == name, f"its name is '{item.name}'"
    assert item.templates, "it has no instruction template"
    assert item.max_steps > 0, f"max_steps must be positive, got {item.max_steps}"
    assert is_dataclass(item.Parameters), "Parameters is no dataclass"
    item.Parameters()


def register(cls: type[Skill]) -> type[Skill]:
    """Register a skill under its ``name``."""
    SKILLS.register(cls.name)(cls())
    return cls


def parameters_of(task: TaskSpec, cls: type[Any]) -> Any:
    """Return a task's arguments as the skill's parameters.

    Raises:
        ConfigError: When an argument is unknown or has the wrong type.
    """
    own = {name: value for name, value in task.arguments.items() if name not in GENERAL}
    return from_plain(own, cls, source=f"arguments of task '{task.instruction}'")


__all__ = ["SKILLS", "Assessment", "Evaluator", "Role", "Skill", "parameters_of", "register"]
