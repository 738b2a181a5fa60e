"""Base class of reset components, and the context that they work with.

A component is a function of a scene, its configuration and its own random stream. The skill's resetter chains
components. A new component takes one new file here and one entry in a task's YAML.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass, replace
from typing import Any, ClassVar

import numpy as np

from roboxim_core.errors import ConfigError, one_of
from roboxim_core.kinematics import ArmKinematics
from roboxim_core.models.library import ModelLibrary
from roboxim_core.registry import Registry
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_tasks.choices import Choice, VectorChoice, choice_text
from roboxim_tasks.task_config import TaskConfig


@dataclass(frozen=True, kw_only=True)
class Constraint:
    """A skill's requirement of a drawn scene."""

    name: str
    """Name for messages and statistics, e.g. ``target_reachable``."""
    holds: Callable[[SceneSpec], bool]
    """Return whether a scene meets the constraint."""
    room: bool = False
    """Whether the constraint is a quick check of free space: distractors are then placed so that it still holds."""
    each: bool = False
    """Whether the check is quick and concerns each object alone: it then runs while objects are being placed."""
    why: Callable[[SceneSpec], str] | None = None
    """Return why a refused scene violates the constraint, with a number; none: its name says it."""


@dataclass(kw_only=True)
class ResetContext:
    """One reset: its source of randomness, its inputs and its counters."""

    seed: SeedPath
    """Seed path of the episode."""
    config: TaskConfig
    """Task configuration."""
    task: TaskSpec
    """The task to prepare."""
    library: ModelLibrary
    """Robots and objects."""
    arm: ArmKinematics
    """Kinematics of the scene's robot."""
    ordinal: int | None = None
    """Number of the episode in its cell of a mix, the index into ordered lists; none: the seed's index."""
    constraints: Sequence[Constraint] = ()
    """The skill's constraints; set before the components run."""
    way_blocked: Callable[[SceneSpec], bool] | None = None
    """Return whether distractors collide with straight paths that would solve the task; none: no planning."""
    areas: dict[str, VectorChoice] = field(default_factory=dict)
    """Entity to the area it is placed in, which overrides the configuration of the placing component."""
    drawn: dict[str, str] = field(default_factory=dict)
    """Name of a choice to its drawn value; see `record`."""
    draws: int = 0
    """Placements drawn so far."""
    rejections: Counter[str] = field(default_factory=Counter)
    """Constraint to the number of placements that it has refused."""
    refused: dict[str, SceneSpec] = field(default_factory=dict)
    """Constraint to the newest scene that it has refused."""
    causes: dict[str, Counter[str]] = field(default_factory=dict)
    """Constraint to the causes of its refusals."""
    _streams: dict[str, np.random.Generator] = field(default_factory=dict)

    @property
    def index(self) -> int:
        """Index into ordered lists."""
        return self.seed.index if self.ordinal is None else self.ordinal

    def rng(self, component: str) -> np.random.Generator:
        """Return a component's own random stream; repeated calls continue the same stream."""
        if component not in self._streams:
            self._streams[component] = self.seed.rng(component)
        return self._streams[component]

    def record(self, name: str, choice: Choice | VectorChoice | None, value: object, *, always: bool = False) -> None:
        """Record a drawn value in the task's ``drawn``, if the choice leaves a choice.

        A list of one value is not recorded, nor is a vector of a range, which the scene has.

        Args:
            name: Name of the value; begins with the component's name, e.g. ``lights.intensity``.
            choice: The choice; none: nothing was drawn.
            value: The drawn value.
            always: Whether to record the value of a list of one value too.
        """
        if choice is None:
            return
        if choice.values:
            varies = len(choice.values) > 1
        else:
            varies = isinstance(choice, Choice) and choice.lower != choice.upper
        if varies or always:
            self.drawn[name] = choice_text(value)

    def vary(self, config: object, rng: np.random.Generator, names: Mapping[str, str]) -> dict[str, Any]:
        """Draw the properties that a configuration varies, and record them.

        Args:
            config: Has a choice, or none, for each property.
            rng: Random stream of the draws.
            names: Property to its name in the record, in the order of the draws.

        Returns:
            Varied property to its value: a number, a text or a tuple of numbers.
        """
        values: dict[str, Any] = {}
        for key, name in names.items():
            choice: Choice | VectorChoice | None = getattr(config, key)
            if choice is not None:
                drawn = choice.draw(rng, self.index)
                if isinstance(drawn, np.ndarray):
                    values[key] = tuple(drawn.tolist())
                else:
                    values[key] = drawn if isinstance(drawn, str) else float(drawn)
                self.record(name, choice, "none" if values[key] == "" else values[key])
        return values

    def room_taken(self, scene: SceneSpec) -> str:
        """Return the first constraint whose free space is taken in a scene with all objects, or an empty text."""
        taken = next((c.name for c in self.constraints if c.room and not c.holds(scene)), "")
        return taken or self.newest_refused(scene)

    def newest_refused(self, scene: SceneSpec) -> str:
        """Return the first constraint that the object placed last does not meet, or an empty text."""
        alone = replace(scene, entities=scene.entities[-1:])
        return next((c.name for c in self.constraints if c.each and not c.holds(alone)), "")


@dataclass(frozen=True, kw_only=True)
class NoConfig:
    """Configuration of a component that has no options."""


class ResetComponent(ABC):
    """A component that draws one property of a scene. Subclasses register under the name that task YAML uses."""

    name: ClassVar[str] = ""
    """Name in the registry, in task YAML and of the random stream."""
    Config: ClassVar[type] = NoConfig
    """Frozen dataclass of the configuration; every field has a default."""
    before: ClassVar[str] = ""
    """Component before which it acts, regardless of the order in the task; empty: in the order of the task."""
    places: ClassVar[bool] = False
    """Whether the component places objects: it is then drawn again when a constraint refuses the scene."""

    def __init__(self, config: Any) -> None:
        """Keep the configuration, an instance of `Config`."""
        self.config = config

    @classmethod  # noqa: B027
    def check(cls, config: Any, roles: Sequence[str], task: TaskConfig) -> None:
        """Refuse a configuration that does not suit the task. Called when a task is loaded.

        The message of an error begins with the key.

        Args:
            config: Instance of `Config`.
            roles: Roles of the task's skill.
            task: The task's configuration.

        Raises:
            ConfigError: When the configuration does not suit; names the key and the allowed values.
        """

    @abstractmethod
    def reset(self, scene: SceneSpec, context: ResetContext) -> SceneSpec:
        """Return the scene with a drawn value of this component's property.

        Raises:
            RejectedError: When the draw violates a constraint of the component.
        """


def require_roles(given: Iterable[str], roles: Sequence[str]) -> None:
    """Refuse values of roles that a skill lacks.

    Raises:
        ConfigError: Naming the role and the skill's.
    """
    for role in given:
        if role not in roles:
            raise ConfigError(f"roles.{role}: no such role; {one_of(roles, role)}")


COMPONENTS: Registry[type[ResetComponent]] = Registry("reset component")


@COMPONENTS.conformance
def has_a_configuration_with_defaults(name: str, item: type[ResetComponent]) -> None:
    """Refuse a component whose name or configuration cannot be used in a task's YAML."""
    assert issubclass(item, ResetComponent), "it does not derive from ResetComponent"
    assert item.name == name, f"its name is '{item.name}'"
    assert is_dataclass(item.Config), "Config is no dataclass"
    item(item.Config())


def register(cls: type[ResetComponent]) -> type[ResetComponent]:
    """Register a component under its ``name``."""
    return COMPONENTS.register(cls.name)(cls)
