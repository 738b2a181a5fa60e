"""Reset component ``lights``: direction, colour and strength of the light."""

from __future__ import annotations

from dataclasses import dataclass, replace

from roboxim_core.errors import ConfigError
from roboxim_core.specs import LightSpec, SceneSpec
from roboxim_tasks.choices import Choice, VectorChoice
from roboxim_tasks.components.base import ResetComponent, ResetContext, register


@dataclass(frozen=True, kw_only=True)
class LightsResetConfig:
    """How the scene's first light and the surroundings vary; what is left out stays as the scene has it."""

    intensity: Choice | None = None
    """Radiance factor of the light."""
    color: VectorChoice | None = None
    """sRGB colour of the light, each component 0..1."""
    direction: VectorChoice | None = None
    """Direction that the light travels in, in the world."""
    ambient: VectorChoice | None = None
    """Radiance of the surroundings, one component per colour."""

    def __post_init__(self) -> None:
        """Check the vectors' length.

        Raises:
            ConfigError: Naming the key.
        """
        for key in ("color", "direction", "ambient"):
            choice = getattr(self, key)
            if choice is not None:
                choice.require_size(3, key)


@register
class LightsReset(ResetComponent):
    """Draws the main light and the ambient light."""

    name = "lights"
    Config = LightsResetConfig

    def reset(self, scene: SceneSpec, context: ResetContext) -> SceneSpec:
        """Draw the light.

        Raises:
            ConfigError: When the scene has no light to vary.
        """
        rng, index, look = context.rng(self.name), context.index, scene.look
        changed: dict[str, object] = {}
        if self.config.intensity is not None:
            changed["intensity"] = self.config.intensity.draw_number(rng, index)
        for key in ("color", "direction"):
            choice = getattr(self.config, key)
            if choice is not None:
                changed[key] = tuple(choice.draw(rng, index).tolist())
        if changed:
            if not look.lights:
                raise ConfigError(
                    f"reset.lights sets {', '.join(changed)}, but scene '{context.config.scene}' has no light"
                )
            light: LightSpec = replace(look.lights[0], **changed)  # type: ignore[arg-type]
            look = replace(look, lights=(light, *look.lights[1:]))
        if self.config.ambient is not None:
            r, g, b = self.config.ambient.draw(rng, index).tolist()
            look = replace(look, ambient=(r, g, b))
        return replace(scene, look=look)
