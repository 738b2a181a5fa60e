"""Reset component ``surfaces``: colour, texture and gloss of table, floor and wall."""

from __future__ import annotations

from dataclasses import dataclass, replace

import roboxim_core.models.textures  # noqa: F401  (registers the objects' textures)
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.plain_data.pictures import file_of
from roboxim_core.specs import MaterialSpec, SceneSpec
from roboxim_core.vision.textures import ROOM_TEXTURES, TEXTURES
from roboxim_tasks.choices import Choice, VectorChoice
from roboxim_tasks.components.base import ResetComponent, ResetContext, register


@dataclass(frozen=True, kw_only=True)
class SurfaceConfig:
    """Variation of a surface. Omitted properties stay as in the scene."""

    color: VectorChoice | None = None
    """sRGB base colour, each component 0..1."""
    texture: Choice | None = None
    """Names of built-in textures, or paths of images; an empty name: no texture."""
    roughness: Choice | None = None
    """Roughness, 0 = mirror, 1 = chalk."""

    def __post_init__(self) -> None:
        """Check colours, names and numbers.

        Raises:
            ConfigError: When a colour, name or number is invalid; names the key.
        """
        if self.color is not None:
            self.color.require_color("color")
        if self.texture is not None:
            self.texture.require_words("texture", "names of textures")
            for name in map(str, self.texture.values):
                _check_texture(name)
        if self.roughness is not None:
            self.roughness.require_numbers("roughness", 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class SurfacesResetConfig:
    """Variation of the surfaces."""

    table: SurfaceConfig = SurfaceConfig()
    """The table's top."""
    floor: SurfaceConfig = SurfaceConfig()
    """The floor."""
    wall: SurfaceConfig = SurfaceConfig()
    """The wall behind the table."""


def _check_texture(name: str) -> None:
    known = sorted({*ROOM_TEXTURES, *TEXTURES})
    if "/" in name:
        if not file_of(name)[0].is_file():
            raise ConfigError(f"texture: no such file: {name}")
    elif name and name not in known:
        raise ConfigError(f"texture: no texture '{name}'; {one_of(known, name)}")


@register
class SurfacesReset(ResetComponent):
    """Draws the materials of table, floor and wall."""

    name = "surfaces"
    Config = SurfacesResetConfig

    def reset(self, scene: SceneSpec, context: ResetContext) -> SceneSpec:
        """Draw each surface."""
        look = scene.look
        for surface in ("table", "floor", "wall"):
            config: SurfaceConfig = getattr(self.config, surface)
            material: MaterialSpec = getattr(scene.look, surface)
            names = {key: f"{surface}.{key}" for key in ("color", "texture", "roughness")}
            drawn = context.vary(config, context.rng(f"{self.name}/{surface}"), names)
            look = replace(look, **{surface: replace(material, **drawn)})  # type: ignore[arg-type]
        return replace(scene, look=look)
