"""Reset component ``joints``: initial joint positions of the task's objects, e.g. how far drawers are open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

from roboxim_core.errors import ConfigError
from roboxim_core.specs import EntitySpec, Scalar, SceneSpec
from roboxim_tasks.choices import Choice
from roboxim_tasks.components.base import ResetComponent, ResetContext, register, require_roles
from roboxim_tasks.roles import task_objects
from roboxim_tasks.sequences.steps import own_objects, steps_of
from roboxim_tasks.task_config import TaskConfig


@dataclass(frozen=True, kw_only=True)
class JointChoices:
    """Joint positions as fractions of the travel, 0 = shut, 1 = fully open."""

    target: Choice = Choice(values=(0.0,))
    """Position of the joints that the task, or a step of it, is about (the argument ``joint``)."""
    others: Choice = Choice(values=(0.0,))
    """Position of every other joint."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: When a fraction is outside of 0..1.
        """
        for name, choice in (("target", self.target), ("others", self.others)):
            for value in choice.ends:
                if isinstance(value, str | bool) or not 0.0 <= value <= 1.0:
                    raise ConfigError(f"{name} must be fractions of the joints' travel from 0 to 1, got {value!r}")


@dataclass(frozen=True, kw_only=True)
class JointsResetConfig(JointChoices):
    """Joint positions of the task's objects as fractions of the travel, 0 = shut, 1 = fully open."""

    LEFT_OUT_AT_DEFAULT: ClassVar[tuple[str, ...]] = ("roles",)

    roles: dict[str, JointChoices] = field(default_factory=dict)
    """Role to the positions of its object's joints, where they differ from the common ones."""


@register
class JointsReset(ResetComponent):
    """Sets the joints of the objects in the instruction; joints with springs keep their positions."""

    name = "joints"
    Config = JointsResetConfig
    places = True

    @classmethod
    def check(cls, config: JointsResetConfig, roles: Sequence[str], task: TaskConfig) -> None:
        """Refuse positions of roles that the skill lacks."""
        require_roles(config.roles, roles)

    def reset(self, scene: SceneSpec, context: ResetContext) -> SceneSpec:
        """Draw a position for every joint."""
        names = {thing.entity for thing in task_objects(context.task)}
        moved = {
            (entity, step.arguments.get("joint"))
            for step in steps_of(context.task) for entity in own_objects(step).values()
        }  # fmt: skip
        entities = tuple(self._drawn(e, context, moved) if e.name in names else e for e in scene.entities)
        return replace(scene, entities=entities)

    def _drawn(self, entity: EntitySpec, context: ResetContext, moved: set[tuple[str, Scalar | None]]) -> EntitySpec:
        rng, index = context.rng(self.name), context.index
        config: JointChoices = self.config.roles.get(entity.name, self.config)
        positions = {}
        for joint in context.library.entity_model(entity).joints:
            if joint.spring == 0.0:
                choice = config.target if (entity.name, joint.name) in moved else config.others
                share = choice.draw_number(rng, index)
                context.record(f"joints.{joint.name}", choice, share)
                positions[joint.name] = joint.lower + share * (joint.upper - joint.lower)
        return replace(entity, joint_positions=positions) if positions else entity
