"""Reset component ``toppled``: lay the task's target on its side."""

from __future__ import annotations

from dataclasses import dataclass, replace

from roboxim_core.errors import ConfigError
from roboxim_core.specs import EntitySpec, SceneSpec
from roboxim_tasks.choices import Choice
from roboxim_tasks.components.base import ResetComponent, ResetContext, register
from roboxim_tasks.sampling.placement import refusal, turned
from roboxim_tasks.sampling.rejection import RejectedError


@dataclass(frozen=True, kw_only=True)
class ToppledResetConfig:
    """How it lies."""

    yaw_rad: Choice = Choice(lower=-3.141592653589793, upper=3.141592653589793)
    """Rotation about the vertical [rad]."""
    gap_m: float = 0.03
    """Free space around the target [m]."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: When a yaw is no number, or the gap is negative.
        """
        self.yaw_rad.require_numbers("yaw_rad")
        if self.gap_m < 0:
            raise ConfigError(f"gap_m must be >= 0, got {self.gap_m:g}")


@register
class ToppledReset(ResetComponent):
    """Topples the target where the component ``objects`` has put it, onto one of its model's ``toppled`` sides."""

    name = "toppled"
    Config = ToppledResetConfig
    places = True

    def reset(self, scene: SceneSpec, context: ResetContext) -> SceneSpec:
        """Draw a side and a yaw.

        Raises:
            RejectedError: When there is no room for the toppled target.
            ConfigError: When its model has no toppled pose.
        """
        target = scene.entity(context.task.objects["target"].entity)
        lying = self._drawn(scene, target, context)
        others = replace(scene, entities=tuple(e for e in scene.entities if e.name != target.name))
        reason = refusal(others, lying, self.config.gap_m, context.library)
        if reason:
            raise RejectedError(f"target_toppled_{reason}")
        return replace(scene, entities=tuple(lying if e.name == target.name else e for e in scene.entities))

    def _drawn(self, scene: SceneSpec, target: EntitySpec, context: ResetContext) -> EntitySpec:
        rng, index = context.rng(self.name), context.index
        sides = context.library.entity_model(target).toppled
        if not sides:
            raise ConfigError(f"object '{target.model}' has no toppled pose; choose another model")
        number = int(rng.integers(len(sides)))
        side = sides[number]
        context.record("toppled.side", Choice(values=tuple(range(len(sides)))), number)
        yaw = self.config.yaw_rad.draw_number(rng, index)
        x, y, _ = target.pose.position
        return replace(target, pose=turned((x, y, scene.table.center[2]), yaw) @ side)
