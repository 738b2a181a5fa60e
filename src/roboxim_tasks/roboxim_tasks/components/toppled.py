"""Reset component ``toppled``: lay objects of the task on their sides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

from roboxim_core.errors import ConfigError, one_of
from roboxim_core.specs import EntitySpec, SceneSpec
from roboxim_tasks.choices import Choice
from roboxim_tasks.components.base import ResetComponent, ResetContext, register
from roboxim_tasks.sampling.placement import refusal, turned
from roboxim_tasks.sampling.rejection import RejectedError
from roboxim_tasks.task_config import TaskConfig


@dataclass(frozen=True, kw_only=True)
class ToppledResetConfig:
    """How they lie."""

    LEFT_OUT_AT_DEFAULT: ClassVar[tuple[str, ...]] = ("roles",)

    roles: tuple[str, ...] = ("target",)
    """Roles of the task whose objects lie; in a longer task, by default those that its steps turn upright."""
    yaw_rad: Choice = Choice(lower=-3.141592653589793, upper=3.141592653589793)
    """Rotation about the vertical [rad]."""
    gap_m: float = 0.03
    """Free space around each [m]."""

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
    """Topples objects where the component ``objects`` has put them, onto one of their models' ``toppled`` sides."""

    name = "toppled"
    Config = ToppledResetConfig
    places = True

    @classmethod
    def check(cls, config: ToppledResetConfig, roles: Sequence[str], task: TaskConfig) -> None:
        """Refuse roles that the task lacks."""
        for role in config.roles:
            if role not in roles:
                raise ConfigError(f"roles: no role '{role}' to topple; {one_of(roles, role)}")

    def reset(self, scene: SceneSpec, context: ResetContext) -> SceneSpec:
        """Draw a side and a yaw.

        Raises:
            RejectedError: When there is no room for a toppled object.
            ConfigError: When its model has no toppled pose.
        """
        for role in self.config.roles:
            target = scene.entity(context.task.objects[role].entity)
            lying = self._drawn(scene, role, target, context)
            others = replace(scene, entities=tuple(e for e in scene.entities if e.name != target.name))
            reason = refusal(others, lying, self.config.gap_m, context.library)
            if reason:
                raise RejectedError(f"{role}_toppled_{reason}")
            scene = replace(scene, entities=tuple(lying if e.name == target.name else e for e in scene.entities))
        return scene

    def _drawn(self, scene: SceneSpec, role: str, target: EntitySpec, context: ResetContext) -> EntitySpec:
        own = "" if role == "target" else f"{role}."
        rng, index = context.rng(f"{own}{self.name}"), context.index
        sides = context.library.entity_model(target).toppled
        if not sides:
            raise ConfigError(f"object '{target.model}' has no toppled pose; choose another model")
        number = int(rng.integers(len(sides)))
        side = sides[number]
        context.record(f"{own}toppled.side", Choice(values=tuple(range(len(sides)))), number)
        yaw = self.config.yaw_rad.draw_number(rng, index)
        x, y, _ = target.pose.position
        return replace(target, pose=turned((x, y, scene.table.center[2]), yaw) @ side)
