"""What a reset component is, and what it works with.

A component is a function of a scene, its configuration and its own random stream; the skill's resetter chains
components. Adding one touches one new file here and one entry in a task's YAML.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, is_dataclass, replace
from typing import Any, ClassVar

import numpy as np

from roboxim_core.kinematics import ArmKinematics
from roboxim_core.models.library import ModelLibrary
from roboxim_core.registry import Registry
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_tasks.choices import VectorChoice
from roboxim_tasks.task_config import TaskConfig


@dataclass(frozen=True, kw_only=True)
class Constraint:
    """Something that a skill demands of a drawn scene."""

    name: str
    """Name for messages and statistics, e.g. ``target_reachable``."""
    holds: Callable[[SceneSpec], bool]
    """Whether a scene meets it."""
    room: bool = False
    """Whether it asks for free room, quickly: then distractors are placed so that they leave it."""
    each: bool = False
    """Whether a scene meets it if each object alone does, quickly: then it is asked while objects are placed."""


@dataclass(kw_only=True)
class ResetContext:
    """One reset: where its randomness comes from, and what it counts."""

    seed: SeedPath
    """Address of the episode's randomness."""
    config: TaskConfig
    """Task configuration."""
    task: TaskSpec
    """The task to prepare."""
    library: ModelLibrary
    """Robots and objects."""
    arm: ArmKinematics
    """Kinematics of the scene's robot."""
    ordinal: int | None = None
    """Number of the episode in its cell of a mix, which ordered lists go by; none: the seed's index."""
    constraints: Sequence[Constraint] = ()
    """What the skill demands of the scene; known once the components run."""
    way_blocked: Callable[[SceneSpec], bool] | None = None
    """Tells whether distractors collide with the straight lines that would solve the task; none: nothing is planned."""
    areas: dict[str, VectorChoice] = field(default_factory=dict)
    """Entity to where it is to be placed, instead of where the component that places it is configured to."""
    drawn: dict[str, str] = field(default_factory=dict)
    """Component to the name of what it has drawn, for those whose results are grouped by it."""
    draws: int = 0
    """Placements drawn so far."""
    rejections: Counter[str] = field(default_factory=Counter)
    """Constraint to the number of placements that it refused."""
    _streams: dict[str, np.random.Generator] = field(default_factory=dict)

    @property
    def index(self) -> int:
        """Number that ordered lists go by."""
        return self.seed.index if self.ordinal is None else self.ordinal

    def rng(self, component: str) -> np.random.Generator:
        """Return a component's own stream; a second draw goes on where the first ended."""
        if component not in self._streams:
            self._streams[component] = self.seed.rng(component)
        return self._streams[component]

    def room_taken(self, scene: SceneSpec) -> str:
        """Return the name of the first constraint whose room is taken in a scene with all objects, or nothing."""
        taken = next((c.name for c in self.constraints if c.room and not c.holds(scene)), "")
        return taken or self.newest_refused(scene)

    def newest_refused(self, scene: SceneSpec) -> str:
        """Return the name of a constraint that the object placed last does not meet, or nothing."""
        alone = replace(scene, entities=scene.entities[-1:])
        return next((c.name for c in self.constraints if c.each and not c.holds(alone)), "")


@dataclass(frozen=True, kw_only=True)
class NoConfig:
    """A component without configuration."""


class ResetComponent(ABC):
    """One property of a scene. Subclasses register under the name that task YAML uses."""

    name: ClassVar[str] = ""
    """Registered name, and the name of the random stream."""
    Config: ClassVar[type] = NoConfig
    """Frozen dataclass of its configuration; every field has a default."""
    places: ClassVar[bool] = False
    """Whether it places objects: then it is drawn again when a constraint refuses the scene."""

    def __init__(self, config: Any) -> None:
        """Keep the configuration, an instance of `Config`."""
        self.config = config

    @classmethod  # noqa: B027
    def check(cls, config: Any, roles: Sequence[str], task: TaskConfig) -> None:
        """Refuse, when a task is loaded, a configuration that does not suit it; the message begins with the key.

        Args:
            config: Instance of `Config`.
            roles: Roles of the task's skill.
            task: The task's configuration.

        Raises:
            ConfigError: Naming the key and what is allowed.
        """

    @abstractmethod
    def reset(self, scene: SceneSpec, context: ResetContext) -> SceneSpec:
        """Return the scene with this component's property drawn.

        Raises:
            RejectedError: When the draw breaks a constraint of the component.
        """


COMPONENTS: Registry[type[ResetComponent]] = Registry("reset component")


@COMPONENTS.conformance
def has_a_configuration_with_defaults(name: str, item: type[ResetComponent]) -> None:
    """Refuse a component whose name or configuration a task's YAML could not use."""
    assert issubclass(item, ResetComponent), "it does not derive from ResetComponent"
    assert item.name == name, f"its name is '{item.name}'"
    assert is_dataclass(item.Config), "Config is no dataclass"
    item(item.Config())


def register(cls: type[ResetComponent]) -> type[ResetComponent]:
    """Register a component under its ``name``."""
    return COMPONENTS.register(cls.name)(cls)
