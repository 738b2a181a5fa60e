"""Reset component ``distractors``: where the objects lie that the task is not about."""

from __future__ import annotations

from roboxim_core.specs import SceneSpec
from roboxim_tasks.components.base import ResetComponent, ResetContext, register
from roboxim_tasks.placement import PlacementConfig, place
from roboxim_tasks.roles import task_distractors


@register
class DistractorsReset(ResetComponent):
    """Places distractors between the objects of the task, which they leave where they are."""

    name = "distractors"
    Config = PlacementConfig
    places = True

    def reset(self, scene: SceneSpec, context: ResetContext) -> SceneSpec:
        """Place each distractor apart from everything.

        Raises:
            RejectedError: When one finds no room.
        """
        for thing in task_distractors(context.task):
            scene = place(scene, thing, self.config, context, self.name)
        return scene
