"""Reset component ``background``: walls and background colour behind the table."""

from __future__ import annotations

from dataclasses import dataclass, replace

from roboxim_core.errors import ConfigError, one_of
from roboxim_core.specs import BACKGROUNDS, SceneSpec
from roboxim_tasks.choices import Choice, VectorChoice
from roboxim_tasks.components.base import ResetComponent, ResetContext, register


@dataclass(frozen=True, kw_only=True)
class BackgroundResetConfig:
    """Variation of the background. Omitted keys stay as in the scene. For wall and floor see ``surfaces``."""

    kind: Choice | None = None
    """``room`` (walls around) or ``plain`` (no walls)."""
    backdrop: VectorChoice | None = None
    """sRGB colour behind all surfaces, each component 0..1."""

    def __post_init__(self) -> None:
        """Check the names and the colours' length.

        Raises:
            ConfigError: When a name is unknown or a colour is invalid; names the key.
        """
        if self.backdrop is not None:
            self.backdrop.require_color("backdrop")
        if self.kind is not None:
            for value in self.kind.values or ("",):
                if value not in BACKGROUNDS:
                    raise ConfigError(f"kind: no background '{value}'; {one_of(BACKGROUNDS, str(value))}")


@register
class BackgroundReset(ResetComponent):
    """Draws the background."""

    name = "background"
    Config = BackgroundResetConfig

    def reset(self, scene: SceneSpec, context: ResetContext) -> SceneSpec:
        """Draw the background."""
        rng, index, look = context.rng(self.name), context.index, scene.look
        if self.config.kind is not None:
            look = replace(look, background=str(self.config.kind.draw(rng, index)))
            context.record(self.name, self.config.kind, look.background)
        if self.config.backdrop is not None:
            r, g, b = self.config.backdrop.draw(rng, index).tolist()
            look = replace(look, backdrop=(r, g, b))
            context.record(f"{self.name}.backdrop", self.config.backdrop, look.backdrop)
        return replace(scene, look=look)
