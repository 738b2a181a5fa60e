"""Reset component ``lights``: number, direction, colour, strength and softness of the lights."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from roboxim_core.errors import ConfigError
from roboxim_core.specs import LightSpec, SceneSpec
from roboxim_tasks.choices import Choice, VectorChoice
from roboxim_tasks.components.base import ResetComponent, ResetContext, register

MAX_LAMPS = 3
"""Largest number of additional lights, which every renderer can draw."""


@dataclass(frozen=True, kw_only=True)
class LampsConfig:
    """Lamps in addition to the scene's lights; each is drawn separately. They cast no shadow in `raster`."""

    number: Choice = Choice(values=(0,))
    """Number of lamps, 0..3; a value drawn from a range is rounded."""
    position: VectorChoice = VectorChoice(lower=(-0.2, -1.2, 0.9), upper=(1.2, 1.2, 1.8))
    """Position in the world [m]."""
    intensity: Choice = Choice(lower=0.3, upper=1.0)
    """Radiance factor at the world's origin."""
    color: VectorChoice = VectorChoice(lower=(0.8, 0.75, 0.65), upper=(1.0, 1.0, 1.0))
    """sRGB colour, each component 0..1."""

    def __post_init__(self) -> None:
        """Check numbers and lengths.

        Raises:
            ConfigError: When a value is invalid; names the key.
        """
        self.position.require_size(3, "position")
        self.color.require_color("color")
        self.intensity.require_numbers("intensity", lower=0.0)
        for value in self.number.values or (self.number.lower, self.number.upper):
            if isinstance(value, str | bool) or value is None or not 0 <= value <= MAX_LAMPS:
                raise ConfigError(f"number must be 0..{MAX_LAMPS}, got {value!r}")


@dataclass(frozen=True, kw_only=True)
class LightsResetConfig:
    """Variation of the scene's first light and of the ambient light, and additional lamps.

    Omitted properties stay as in the scene.
    """

    intensity: Choice | None = None
    """Radiance factor of the light."""
    color: VectorChoice | None = None
    """sRGB colour of the light, each component 0..1."""
    direction: VectorChoice | None = None
    """Direction that the light travels in, in the world (any length > 0)."""
    position: VectorChoice | None = None
    """Position of the light in the world, if it is a lamp [m]."""
    radius: Choice | None = None
    """A lamp's radius [m], a sun's angular radius [rad]."""
    ambient: VectorChoice | None = None
    """Radiance of the surroundings, one component >= 0 per colour."""
    lamps: LampsConfig = LampsConfig()
    """Further lamps."""

    def __post_init__(self) -> None:
        """Check numbers and lengths.

        Raises:
            ConfigError: When a value is invalid; names the key.
        """
        for key in ("color", "direction", "position", "ambient"):
            choice = getattr(self, key)
            if choice is not None:
                choice.require_size(3, key)
        if self.color is not None:
            self.color.require_color("color")
        if self.direction is not None:
            self.direction.require_not_zero("direction")
        if self.ambient is not None:
            self.ambient.require_not_negative("ambient")
        if self.intensity is not None:
            self.intensity.require_numbers("intensity", lower=0.0)
        if self.radius is not None:
            self.radius.require_numbers("radius", 0.0, 1.0)


@register
class LightsReset(ResetComponent):
    """Draws the main light, the ambient light and further lamps.

    Randomisation: the main light and the ambient light share a random stream. The lamps have another one, so that
    adding lamps leaves the main light unchanged.
    """

    name = "lights"
    Config = LightsResetConfig

    def reset(self, scene: SceneSpec, context: ResetContext) -> SceneSpec:
        """Draw the lights.

        Raises:
            ConfigError: When the scene has no light to vary.
        """
        look = scene.look
        names = {key: f"light.{key}" for key in ("intensity", "color", "direction", "position", "radius", "ambient")}
        changed = context.vary(self.config, context.rng(self.name), names)
        look = replace(look, ambient=changed.pop("ambient", look.ambient))
        if changed:
            if not look.lights:
                raise ConfigError(
                    f"reset.lights sets {', '.join(changed)}, but scene '{context.config.scene}' has no light"
                )
            look = replace(look, lights=(replace(look.lights[0], **changed), *look.lights[1:]))
        lamps = self._lamps(context.rng(f"{self.name}/lamps"), context.index)
        context.record("light.lamps", self.config.lamps.number, len(lamps))
        return replace(scene, look=replace(look, lights=(*look.lights, *lamps)))

    def _lamps(self, rng: np.random.Generator, index: int) -> tuple[LightSpec, ...]:
        config = self.config.lamps
        number = round(config.number.draw_number(rng, index))
        return tuple(
            LightSpec(
                kind="lamp",
                position=tuple(config.position.draw(rng, index).tolist()),
                intensity=config.intensity.draw_number(rng, index),
                color=tuple(config.color.draw(rng, index).tolist()),
                shadow=False,
            )
            for _ in range(number)
        )
