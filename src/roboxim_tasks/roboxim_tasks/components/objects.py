"""Reset component ``objects``: where the objects of the task lie."""

from __future__ import annotations

from roboxim_core.specs import SceneSpec
from roboxim_tasks.components.base import ResetComponent, ResetContext, register
from roboxim_tasks.placement import PlacementConfig, place
from roboxim_tasks.roles import task_objects


@register
class ObjectsReset(ResetComponent):
    """Places the objects that the instruction speaks of, in the order of their roles."""

    name = "objects"
    Config = PlacementConfig
    places = True

    def reset(self, scene: SceneSpec, context: ResetContext) -> SceneSpec:
        """Place each object apart from the others.

        Raises:
            RejectedError: When one finds no room.
        """
        for thing in task_objects(context.task):
            scene = place(scene, thing, self.config, context, self.name)
        return scene
