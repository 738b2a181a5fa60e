"""Contents of the YAML files in ``config/lights`` and ``config/looks``."""

from __future__ import annotations

from dataclasses import dataclass, fields

from roboxim_core.errors import ConfigError
from roboxim_core.specs import RGB, LightSpec, LookSpec


@dataclass(frozen=True, kw_only=True)
class Lighting:
    """A YAML file in ``config/lights``."""

    lights: tuple[LightSpec, ...] = ()
    """The lights; the first one that casts a shadow is the main light."""
    ambient: RGB | None = None
    """Radiance of the surroundings; none: the scene's."""


@dataclass(frozen=True, kw_only=True)
class Room(LookSpec):
    """One look of a set: materials, lights and background, and from where the camera ``workspace`` looks."""

    view: str = ""
    """Camera file of ``config/cameras`` for the camera ``workspace``; empty: the task's choice."""

    @property
    def look(self) -> LookSpec:
        """The look without the camera."""
        return LookSpec(**{field.name: getattr(self, field.name) for field in fields(LookSpec)})


@dataclass(frozen=True, kw_only=True)
class LookSet:
    """A YAML file in ``config/looks``: rooms to draw from."""

    looks: dict[str, Room]
    """Name to look."""

    def __post_init__(self) -> None:
        """Check that there is a look.

        Raises:
            ConfigError: When there is none.
        """
        if not self.looks:
            raise ConfigError("looks must hold at least one look, got none")
