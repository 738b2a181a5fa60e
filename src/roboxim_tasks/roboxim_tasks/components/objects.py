"""Reset component ``objects``: placement of the task's objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from roboxim_core.specs import SceneSpec
from roboxim_tasks.components.base import ResetComponent, ResetContext, register, require_roles
from roboxim_tasks.roles import task_objects
from roboxim_tasks.sampling.placement import Demand, PlacementConfig, place
from roboxim_tasks.task_config import TaskConfig


@dataclass(frozen=True, kw_only=True)
class ObjectsResetConfig(PlacementConfig):
    """Placement of the task's objects."""

    roles: dict[str, PlacementConfig] = field(default_factory=dict)
    """Role to its own placement, where it differs from the common one."""


@register
class ObjectsReset(ResetComponent):
    """Places the objects in the instruction, in the order of their roles."""

    name = "objects"
    Config = ObjectsResetConfig
    places = True

    @classmethod
    def check(cls, config: ObjectsResetConfig, roles: Sequence[str], task: TaskConfig) -> None:
        """Refuse placements of roles that the skill lacks."""
        require_roles(config.roles, roles)

    def reset(self, scene: SceneSpec, context: ResetContext) -> SceneSpec:
        """Place each object apart from the others.

        Raises:
            RejectedError: When there is no room for an object.
        """
        for thing in task_objects(context.task):
            config: PlacementConfig = self.config.roles.get(thing.entity, self.config)
            if thing.entity in context.areas:
                config = replace(config, area=context.areas[thing.entity])
            scene = place(scene, thing, config, context, self.name, Demand(leaves=context.newest_refused))
        return scene
