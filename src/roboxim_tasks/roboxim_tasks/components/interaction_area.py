"""Reset component ``interaction_area``: the named area of the table in which the task takes place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from roboxim_core.errors import ConfigError, one_of
from roboxim_core.specs import SceneSpec
from roboxim_tasks.choices import Choice, VectorChoice
from roboxim_tasks.components.base import ResetComponent, ResetContext, register
from roboxim_tasks.task_config import TaskConfig

AREAS = {
    "far_left": VectorChoice(lower=(0.36, 0.32), upper=(0.52, 0.48)),
    "left": VectorChoice(lower=(0.36, 0.12), upper=(0.52, 0.28)),
    "middle": VectorChoice(lower=(0.36, -0.08), upper=(0.52, 0.08)),
    "right": VectorChoice(lower=(0.36, -0.28), upper=(0.52, -0.12)),
    "far_right": VectorChoice(lower=(0.36, -0.48), upper=(0.52, -0.32)),
}
"""Five areas next to each other, as the robot sees them: boxes of x and y in its base frame [m]."""


@dataclass(frozen=True, kw_only=True)
class InteractionAreaConfig:
    """The areas, and the choice of one per episode."""

    areas: dict[str, VectorChoice] = field(default_factory=lambda: dict(AREAS))
    """Area name to a box, or a list of positions, of x and y in the robot's base frame [m]."""
    area: Choice | None = None
    """Names of the areas to use, at random or in order; none: all areas at random."""
    roles: tuple[str, ...] = ("target",)
    """Roles of the task whose objects are placed there; ``objects`` places the other roles in its own area."""

    def __post_init__(self) -> None:
        """Check names and positions.

        Raises:
            ConfigError: When an area is unknown, or is not given by x and y.
        """
        for name, area in self.areas.items():
            area.require_size(2, f"areas.{name}")
        for chosen in self.area.values if self.area else ():
            if chosen not in self.areas:
                raise ConfigError(f"area: no interaction area '{chosen}'; {one_of(self.areas, str(chosen))}")
        if not self.areas or (self.area and not self.area.values):
            raise ConfigError("needs at least one of areas, and area as values: names of areas, not a range")


@register
class InteractionAreaReset(ResetComponent):
    """Chooses the area; the component ``objects`` then places the roles' objects there instead of in its own area.

    Randomisation: the area. The position within it comes from the stream of ``objects``, so that datasets with other
    areas stay paired in everything else. The task records the area's name as ``drawn["interaction_area"]``.
    """

    name = "interaction_area"
    Config = InteractionAreaConfig

    @classmethod
    def check(cls, config: InteractionAreaConfig, roles: Sequence[str], task: TaskConfig) -> None:
        """Refuse roles that the task's skill lacks; distractors have no area."""
        for role in config.roles:
            if role not in roles:
                raise ConfigError(f"roles: no role '{role}' that 'objects' places; {one_of(roles, role)}")

    def reset(self, scene: SceneSpec, context: ResetContext) -> SceneSpec:
        """Choose an area."""
        choice = self.config.area or Choice(values=tuple(self.config.areas))
        name = str(choice.draw(context.rng(self.name), context.index))
        for role in self.config.roles:
            context.areas[context.task.objects[role].entity] = self.config.areas[name]
        context.record(self.name, choice, name, always=True)
        return scene
