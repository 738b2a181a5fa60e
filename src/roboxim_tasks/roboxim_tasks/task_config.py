"""Dataclasses of a task's YAML file; `roboxim_tasks.config` reads and checks the file."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

from roboxim_core.config import to_json
from roboxim_core.errors import ConfigError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.rates import DEFAULT_RATE_HZ
from roboxim_core.specs import Scalar, SceneSpec
from roboxim_tasks.choices import Choice
from roboxim_tasks.files import named
from roboxim_tasks.limits import LimitsConfig
from roboxim_tasks.roles import LIMITS

MAX_DISTRACTORS = 8


@dataclass(frozen=True, kw_only=True)
class VisibleConfig:
    """Required visibility, in the cameras fixed in the world, of every object that the instruction names."""

    share: float = 0.5
    """Least visible share of the object's silhouette, 0..1; hidden parts and those out of the picture do not count."""
    pixels: int = 40
    """Least number of visible pixels, in an image whose longer side has 128 pixels."""
    cameras: tuple[str, ...] | None = None
    """Cameras that must see the objects; none: every camera fixed in the world; empty: no check."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: When a number is out of range.
        """
        if not 0.0 <= self.share <= 1.0 or self.pixels < 0:
            raise ConfigError(f"visible needs 0 <= share <= 1 and pixels >= 0, got {self.share:g} and {self.pixels}")


@dataclass(frozen=True, kw_only=True)
class ObjectConfig:
    """Objects that may fill a role."""

    models: Choice = Choice(values=("cube",))
    """Ids of object models."""
    modifiers: dict[str, Choice] = field(default_factory=dict)
    """Modifier name to its values, e.g. ``color`` or ``scale``; omitted modifiers have the model's default."""


@dataclass(frozen=True, kw_only=True)
class DistractorConfig:
    """Objects that the task is not about; none fits the description of an object of the task."""

    minimum: int = 0
    """Fewest distractors."""
    maximum: int = 0
    """Most distractors."""
    always: tuple[str, ...] = ()
    """Ids of the models of the first distractors, which every scene has; the others are drawn from ``models``."""
    models: Choice = Choice(values=("cube",))
    """Ids of object models."""
    modifiers: dict[str, Choice] = field(default_factory=dict)
    """Modifier name to its values."""
    stay_m: float = 0.0
    """Largest displacement of a distractor, beyond which the episode has failed [m]; 0: no limit."""

    def __post_init__(self) -> None:
        """Check the range.

        Raises:
            ConfigError: When the range of numbers is empty or too large, ``stay_m`` is negative, or ``minimum`` leaves
                no room for ``always``.
        """
        if len(self.always) > self.minimum:
            raise ConfigError(f"always names {len(self.always)} distractors, minimum is {self.minimum}; raise it")
        if self.stay_m < 0:
            raise ConfigError(f"stay_m must be >= 0, got {self.stay_m:g}")
        if not 0 <= self.minimum <= self.maximum <= MAX_DISTRACTORS:
            raise ConfigError(
                f"minimum and maximum must be 0 <= minimum <= maximum <= {MAX_DISTRACTORS}, "
                f"got {self.minimum} and {self.maximum}"
            )


@dataclass(frozen=True, kw_only=True)
class StepConfig:
    """One step of a task of several steps."""

    skill: str
    """Registered skill."""
    roles: dict[str, str] = field(default_factory=dict)
    """Role of the skill to the role of the task that fills it, a key of ``objects``; omitted: the one of that name.
    Steps share an object by naming the same role."""
    parameters: Any = None
    """The skill's parameters and thresholds."""
    lenient: Any = None
    """Parameters with other values for the evaluation of policies (purpose ``eval`` or ``train``)."""
    arguments: dict[str, Choice] = field(default_factory=dict)
    """Parameters that vary from episode to episode. Steps whose argument has the same name and values draw the same."""
    templates: Choice | None = None
    """Templates of the step's sentence, in roles of the skill; none: the skill's."""


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """A YAML file of ``config/tasks`` that describes one skill; see `TaskMix` for several skills."""

    LEFT_OUT_AT_DEFAULT: ClassVar[tuple[str, ...]] = ("skill_file", "wordings", "steps", "order", "limits")

    skill: str = "pick_up"
    """Registered skill, or ``path/to/file.py:Class``; with ``steps``, their skills joined by ``+``, which may be
    omitted."""
    skill_file: str = ""
    """File of the skill, ``path/to/file.py:Class``, if it is not registered; ``skill`` may name it instead."""
    steps: tuple[StepConfig, ...] = ()
    """Two to five steps of a longer task, instead of ``skill``; see docs/how-to/sequences.md."""
    order: str = "fixed"
    """``fixed``: the steps count in their order only; ``any``: in every order."""
    parameters: Any = None
    """The skill's parameters and thresholds that demonstrations must meet."""
    lenient: Any = None
    """Parameters with other values for the evaluation of policies (purpose ``eval`` or ``train``)."""
    arguments: dict[str, Choice] = field(default_factory=dict)
    """Parameters that vary from episode to episode, e.g. ``{drawer: {values: [top, middle], order: in_order}}``."""
    templates: Choice | None = None
    """Instruction templates with roles in braces, e.g. ``Pick up the {target}``; none: the skill's."""
    paraphrases: bool = False
    """Whether to use all of the skill's templates, or only the first one, where ``templates`` are not given."""
    wordings: str = ""
    """Set of ``config/wordings/SKILL.yaml`` that gives the instructions, e.g. ``trained`` or ``held_out``, where
    ``templates`` are not given; empty: the skill's templates."""
    objects: dict[str, ObjectConfig] = field(default_factory=dict)
    """Role of the skill to the objects that may fill it."""
    exclude: tuple[dict[str, dict[str, Scalar]], ...] = ()
    """Combinations of objects that are never drawn: role to ``model`` and modifiers, all of which must match."""
    distractors: DistractorConfig = DistractorConfig()
    """Further objects."""
    scene: str = "empty_table"
    """Name of a scene in ``config/scenes``."""
    robot: str = ""
    """Arm in ``config/robots`` that stands in the scene instead of its own; empty: the scene's."""
    reset: dict[str, Any] = field(default_factory=dict)
    """Reset component to its configuration; the skill's own components may be omitted."""
    visible: VisibleConfig = VisibleConfig()
    """Required visibility of the objects that the instruction names, in the cameras fixed in the world."""
    limits: LimitsConfig | None = None
    """Measures beside success, and their limits; none: they are not recorded, ``{}``: recorded without limits."""
    rate_hz: float = DEFAULT_RATE_HZ
    """Control rate [Hz]."""
    max_steps: int = 0
    """Actions after which an episode has failed; 0: the skill's number, scaled to the same duration at any rate."""
    max_draws: int = 100
    """Number of draws of a placement after which the reset is infeasible."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: When a number is out of range.
        """
        for name, minimum in (("max_steps", 0), ("max_draws", 1)):
            if getattr(self, name) < minimum:
                raise ConfigError(f"{name} must be >= {minimum}, got {getattr(self, name)}")

    def at(self, index: int) -> tuple[TaskConfig, int]:
        """Return the configuration of an episode and its index into ordered lists: this one and the given index."""
        return self, index

    def base_scene(self) -> SceneSpec:
        """Return the scene that a reset begins with: the file's, with the task's arm.

        Raises:
            ConfigError: When the scene is unknown or its file is invalid.
        """
        scene = named("scenes", self.scene, SceneSpec)
        if self.robot and self.robot != scene.robot.model:
            scene = replace(scene, robot=replace(scene.robot, model=self.robot, joint_positions=()))
        return scene

    def drawn(self, index: int) -> dict[str, str]:
        """Return the names that an episode's task records besides its draws: none, which only mixes have."""
        return {}

    def limit_arguments(self) -> dict[str, Scalar]:
        """Return the argument of a task that states its limits; none without limits."""
        if self.limits is None:
            return {}
        robot = self.base_scene().robot.model if self.limits.keep_out else self.limits.robot
        return {LIMITS: to_json(replace(self.limits, robot=robot))}


def with_members(config: TaskConfig, library: ModelLibrary) -> TaskConfig:
    """Return a task with the objects of each set in place of its name; they share the weight of the name.

    Args:
        config: The task.
        library: Library of the objects and their sets.
    """
    if not library.object_sets:
        return config
    always = library.expanded(config.distractors.always)
    distractors = replace(config.distractors, models=_members(config.distractors.models, library), always=always)
    objects = {role: replace(one, models=_members(one.models, library)) for role, one in config.objects.items()}
    return replace(config, objects=objects, distractors=distractors)


def _members(models: Choice, library: ModelLibrary) -> Choice:
    groups = [library.expanded((name,)) if isinstance(name, str) else (name,) for name in models.values]
    if all(len(group) == 1 for group in groups):
        return models
    shares = zip(groups, models.weights, strict=True) if models.weights else ()
    weights = tuple(weight / len(group) for group, weight in shares for _ in group)
    return replace(models, values=tuple(name for group in groups for name in group), weights=weights)
