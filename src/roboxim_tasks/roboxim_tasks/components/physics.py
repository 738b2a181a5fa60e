"""Reset component ``physics``: friction of the table, friction and mass of the objects."""

from __future__ import annotations

from dataclasses import dataclass, replace

from roboxim_core.errors import ConfigError
from roboxim_core.models.modifiers import PHYSICAL
from roboxim_core.specs import EntitySpec, SceneSpec
from roboxim_tasks.choices import Choice
from roboxim_tasks.components.base import ResetComponent, ResetContext, register
from roboxim_tasks.roles import task_distractors, task_objects

MAX_FRICTION = 2.0


@dataclass(frozen=True, kw_only=True)
class BodyConfig:
    """Variation of some objects' physics. Omitted properties keep their values. Each object is drawn separately."""

    mass: Choice | None = None
    """Factor on the mass of every link, 0.2..5."""
    mass_kg: Choice | None = None
    """Alternative to ``mass``: mass of the whole object [kg]. The resulting factor must be within the same bounds."""
    friction: Choice | None = None
    """Factor on the lateral friction coefficient, 0.2..2."""
    friction_coefficient: Choice | None = None
    """Alternative to ``friction``: the coefficient. The resulting factor must be within the same bounds."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: When a factor is out of range, a value is not positive, or both a factor and a value are given.
        """
        for kind, value_of in (("mass", "mass_kg"), ("friction", "friction_coefficient")):
            factors, values = getattr(self, kind), getattr(self, value_of)
            if factors is not None and values is not None:
                raise ConfigError(f"give either {kind}, a factor, or {value_of}")
            for factor in factors.ends if factors else ():
                PHYSICAL[kind].check("physics", kind, factor)
            for value in values.ends if values else ():
                if isinstance(value, str | bool) or value <= 0:
                    raise ConfigError(f"{value_of} must be > 0, got {value!r}")


@dataclass(frozen=True, kw_only=True)
class PhysicsResetConfig:
    """What varies."""

    table_friction: Choice = Choice(lower=0.4, upper=1.0)
    """Lateral friction coefficient of the table, 0..2."""
    objects: BodyConfig = BodyConfig(mass=Choice(lower=0.5, upper=2.0), friction=Choice(lower=0.7, upper=1.25))
    """The objects in the instruction."""
    distractors: BodyConfig = BodyConfig(mass=Choice(lower=0.5, upper=2.0), friction=Choice(lower=0.7, upper=1.25))
    """The others."""

    def __post_init__(self) -> None:
        """Check the table's friction.

        Raises:
            ConfigError: When the friction is out of range.
        """
        for value in self.table_friction.ends:
            if isinstance(value, str | bool) or not 0.0 <= value <= MAX_FRICTION:
                raise ConfigError(f"table_friction must be from 0 to {MAX_FRICTION:g}, got {value!r}")


@register
class PhysicsReset(ResetComponent):
    """Draws the table's friction, and factors on mass and friction of each object.

    Randomisation: the table and each object have separate random streams, so a further distractor changes nothing else.

    Non-obvious:
        - The factors become the entities' modifiers ``mass`` and ``friction``, so the scene's record holds them.
        - The simulator multiplies the friction coefficients of two bodies in contact.
        - The component runs after the components that place objects.
    """

    name = "physics"
    Config = PhysicsResetConfig
    places = True

    def reset(self, scene: SceneSpec, context: ResetContext) -> SceneSpec:
        """Draw the table's friction and every object's factors.

        Raises:
            ConfigError: When a value leads to a factor out of bounds.
        """
        rng = context.seed.rng(f"{self.name}/table")
        table = replace(scene.table, friction=self.config.table_friction.draw_number(rng, context.index))
        context.record("friction.table", self.config.table_friction, table.friction)
        drawn = {thing.entity: self.config.objects for thing in task_objects(context.task)}
        drawn |= {thing.entity: self.config.distractors for thing in task_distractors(context.task)}
        entities = tuple(
            self._drawn(entity, drawn[entity.name], context) if entity.name in drawn else entity
            for entity in scene.entities
        )
        return replace(scene, table=table, entities=entities)

    def _drawn(self, entity: EntitySpec, config: BodyConfig, context: ResetContext) -> EntitySpec:
        rng, index = context.seed.rng(f"{self.name}/{entity.name}"), context.index
        modifiers = {name: value for name, value in entity.modifiers.items() if name not in PHYSICAL}
        usual = context.library.object(entity.model, modifiers)
        for kind, factor, value, usually in (
            ("mass", config.mass, config.mass_kg, sum(link.mass for link in usual.links)),
            ("friction", config.friction, config.friction_coefficient, usual.friction.lateral),
        ):
            if factor is not None:
                modifiers[kind] = factor.draw_number(rng, index)
            elif value is not None:
                modifiers[kind] = value.draw_number(rng, index) / usually
                PHYSICAL[kind].check(f"reset.physics: {entity.model}, usually {usually:g}", kind, modifiers[kind])
            elif kind in entity.modifiers:
                modifiers[kind] = entity.modifiers[kind]
            if factor is not None or value is not None:
                context.record(f"{kind}.{entity.name}", factor or value, modifiers[kind])
        return replace(entity, modifiers=modifiers)
