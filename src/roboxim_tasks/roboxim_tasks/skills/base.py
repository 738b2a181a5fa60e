"""What a skill is: its generator, resetter, executor and evaluator side by side in one file.

Adding a skill touches one new file here and one task YAML.
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
from roboxim_tasks.generators import GenerationContext, generate_task
from roboxim_tasks.motion import ExpertScene, Stage
from roboxim_tasks.predicates import Assessment, Evaluator
from roboxim_tasks.roles import STAY, Role


class Skill(ABC):
    """A skill with its four sides, a method each."""

    name: ClassVar[str] = ""
    """Registered name."""
    roles: ClassVar[Mapping[str, Role]] = {"target": Role(affordance="graspable")}
    """Objects that the instruction speaks of, in the order in which they are placed."""
    templates: ClassVar[tuple[str, ...]] = ()
    """Instruction templates with roles and parameters in braces; the first is the canonical one, others paraphrase."""
    words: ClassVar[tuple[str, ...]] = ()
    """What else than roles the templates may name; the generator says the words."""
    components: ClassVar[tuple[str, ...]] = ("robot", "objects", "distractors", "cameras", "lights")
    """Reset components that it always uses, in order."""
    reset: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    """Reset component to those of its keys whose defaults this skill changes; a task's configuration goes before."""
    max_steps: ClassVar[int] = 100
    """Actions after which an episode has failed, at the default control rate; at others it is the same time."""
    Parameters: ClassVar[type]
    """Frozen dataclass of scalars with defaults: the ``parameters`` of the YAML, the ``arguments`` of the task."""

    def check(self, parameters: Any, models: Mapping[str, Sequence[ObjectModel]]) -> None:  # noqa: B027
        """Refuse, when a task is loaded, parameters that do not suit its objects.

        Args:
            parameters: Instance of `Parameters`.
            models: Role to the models that may fill it.

        Raises:
            ConfigError: Naming the parameter and what is allowed.
        """

    def mismatch(self, parameters: Any, models: Mapping[str, ObjectModel]) -> str:
        """Return why models make no sense together, e.g. that one does not fit into another; empty if they do.

        Args:
            parameters: Instance of `Parameters`.
            models: Role to model.
        """
        return ""

    def suited(self, models: Mapping[str, ObjectModel], fixed: Mapping[str, str] | None = None) -> dict[str, list[str]]:
        """Return the models that suit each role together with some models of the other roles.

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
        """Return what a drawn scene must meet: reachable, not solved already (resetter)."""

    @abstractmethod
    def stages(self, scene: ExpertScene) -> Iterable[tuple[Stage, ...]]:
        """Yield the candidate ways to solve the task, best first, each as stages (executor).

        Called again when the expert plans anew within an episode, see `roboxim_tasks.script`. The expert times,
        verifies and executes the first candidate that holds; the others are never made.
        """

    @abstractmethod
    def evaluator(self, task: TaskSpec, initial: StateRecord) -> Evaluator:
        """Return the fold that tells whether the task is solved (evaluator).

        Args:
            task: The task.
            initial: State record of tick 0.
        """


SKILLS: Registry[Skill] = Registry("skill")


@SKILLS.conformance
def says_what_it_is(name: str, item: Skill) -> None:
    """Refuse a skill whose name, roles, templates or parameters a task could not use."""
    assert isinstance(item, Skill), "it is no instance of Skill"
    assert item.name == name, f"its name is '{item.name}'"
    assert item.templates, "it has no instruction template"
    assert item.max_steps > 0, f"max_steps must be positive, got {item.max_steps}"
    assert is_dataclass(item.Parameters), "Parameters is no dataclass"
    item.Parameters()


@SKILLS.conformance
def draws_the_same_task_again(name: str, item: Skill) -> None:
    """Refuse a skill whose task cannot be drawn, or that a second draw gives otherwise.

    The task is the first one of the configuration's folders that is of the skill; without any, that of all defaults.
    """
    from roboxim_core.config import config_dirs, load_yaml
    from roboxim_core.models.library import ModelLibrary
    from roboxim_core.seeds import SeedPath
    from roboxim_tasks.config import task_config
    from roboxim_tasks.episodes import EpisodeGenerator

    files = [path for folder in config_dirs() for path in sorted((folder / "tasks").glob("*.yaml"))]
    shipped = (data for path in files if (data := load_yaml(path)) and data.get("skill") == name)
    config = task_config(next(shipped, {"skill": name}))
    seed = SeedPath(run_seed=1, purpose="test", index=0)
    first, second = (EpisodeGenerator(ModelLibrary(), None, None).draw(seed, config) for _ in range(2))
    assert first.task == second.task, "two draws of one seed give different tasks"
    assert first.scene == second.scene, "two draws of one seed give different scenes"
    assert first.task.instruction, "its instruction is empty"


def register(cls: type[Skill]) -> type[Skill]:
    """Register a skill under its ``name``."""
    SKILLS.register(cls.name)(cls())
    return cls


def parameters_of(task: TaskSpec, cls: type[Any]) -> Any:
    """Return a task's arguments as the skill's parameters.

    Raises:
        ConfigError: When an argument is unknown or of a wrong kind.
    """
    own = {name: value for name, value in task.arguments.items() if name != STAY}
    return from_plain(own, cls, source=f"arguments of task '{task.instruction}'")


__all__ = ["SKILLS", "Assessment", "Evaluator", "Role", "Skill", "parameters_of", "register"]
