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
        names = {"kind": self.name, "backdrop": f"{self.name}.backdrop"}
        drawn = context.vary(self.config, context.rng(self.name), names)
        if "kind" in drawn:
            drawn["background"] = drawn.pop("kind")
        return replace(scene, look=replace(scene.look, **drawn))
