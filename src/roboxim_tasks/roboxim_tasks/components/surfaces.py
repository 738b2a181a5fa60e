"""Reset component ``surfaces``: colour, texture and gloss of table, floor and wall."""

from __future__ import annotations

from dataclasses import dataclass, replace

from roboxim_core.specs import MaterialSpec, SceneSpec
from roboxim_tasks.choices import Choice, VectorChoice
from roboxim_tasks.components.base import ResetComponent, ResetContext, register


@dataclass(frozen=True, kw_only=True)
class SurfaceConfig:
    """How a surface varies; what is left out stays as the scene has it."""

    color: VectorChoice | None = None
    """sRGB base colour, each component 0..1."""
    texture: Choice | None = None
    """Names of built-in textures; an empty name is none."""
    roughness: Choice | None = None
    """0 = mirror, 1 = chalk."""

    def __post_init__(self) -> None:
        """Check the colours' length.

        Raises:
            ConfigError: When a colour is not of three numbers.
        """
        if self.color is not None:
            self.color.require_size(3, "color")


@dataclass(frozen=True, kw_only=True)
class SurfacesResetConfig:
    """How the surfaces vary."""

    table: SurfaceConfig = SurfaceConfig()
    """The table's top."""
    floor: SurfaceConfig = SurfaceConfig()
    """The floor."""
    wall: SurfaceConfig = SurfaceConfig()
    """The wall behind the table."""


@register
class SurfacesReset(ResetComponent):
    """Draws the materials of the surroundings."""

    name = "surfaces"
    Config = SurfacesResetConfig

    def reset(self, scene: SceneSpec, context: ResetContext) -> SceneSpec:
        """Draw each surface."""
        look = scene.look
        for surface in ("table", "floor", "wall"):
            config: SurfaceConfig = getattr(self.config, surface)
            material: MaterialSpec = getattr(scene.look, surface)
            rng, index = context.rng(f"{self.name}/{surface}"), context.index
            if config.color is not None:
                r, g, b = config.color.draw(rng, index).tolist()
                material = replace(material, color=(r, g, b))
            if config.texture is not None:
                material = replace(material, texture=str(config.texture.draw(rng, index)))
            if config.roughness is not None:
                material = replace(material, roughness=config.roughness.draw_number(rng, index))
            look = replace(look, **{surface: material})  # type: ignore[arg-type]
        return replace(scene, look=look)
