"""Reset component ``joints``: initial joint positions of the task's objects, e.g. how far drawers are open."""

from __future__ import annotations

from dataclasses import dataclass, replace

from roboxim_core.errors import ConfigError
from roboxim_core.specs import EntitySpec, SceneSpec
from roboxim_tasks.choices import Choice
from roboxim_tasks.components.base import ResetComponent, ResetContext, register
from roboxim_tasks.roles import task_objects


@dataclass(frozen=True, kw_only=True)
class JointsResetConfig:
    """Joint positions as fractions of the travel, 0 = shut, 1 = fully open."""

    target: Choice = Choice(values=(0.0,))
    """Position of the joint that the task is about (the task's argument ``joint``)."""
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


@register
class JointsReset(ResetComponent):
    """Sets the joints of the objects in the instruction; joints with springs keep their positions."""

    name = "joints"
    Config = JointsResetConfig
    places = True

    def reset(self, scene: SceneSpec, context: ResetContext) -> SceneSpec:
        """Draw a position for every joint."""
        names = {thing.entity for thing in task_objects(context.task)}
        entities = tuple(self._drawn(e, context) if e.name in names else e for e in scene.entities)
        return replace(scene, entities=entities)

    def _drawn(self, entity: EntitySpec, context: ResetContext) -> EntitySpec:
        rng, index = context.rng(self.name), context.index
        positions = {}
        for joint in context.library.entity_model(entity).joints:
            if joint.spring == 0.0:
                wanted = joint.name == context.task.arguments.get("joint")
                choice = self.config.target if wanted else self.config.others
                share = choice.draw_number(rng, index)
                context.record(f"joints.{joint.name}", choice, share)
                positions[joint.name] = joint.lower + share * (joint.upper - joint.lower)
        return replace(entity, joint_positions=positions) if positions else entity
