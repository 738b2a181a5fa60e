"""Options of a report's films. Its imports are light, because options are checked before a run starts."""

from __future__ import annotations

from dataclasses import dataclass

from roboxim_core.errors import ConfigError

FILM_FRAMES = 24
"""Number of frames of a film by default."""
FRAME_HEIGHT = 192
"""Largest height of a frame by default [px]."""


@dataclass(frozen=True, kw_only=True)
class FilmOptions:
    """Which films a report shows, and how."""

    scenes: int = 6
    """Number of scenes whose films are shown, for each policy; 0: none."""
    frames: int = FILM_FRAMES
    """Largest number of frames of a film."""
    height: int = FRAME_HEIGHT
    """Largest height of a frame [px]."""

    only: tuple[str, ...] = ()
    """Names of the scenes, e.g. ``("3", "7")``; empty: ``scenes`` of them, as many of each pattern of outcomes."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: When a number is out of range.
        """
        for name, low, high in (("scenes", 0, 10_000), ("frames", 2, 10_000), ("height", 16, 2_160)):
            if not low <= getattr(self, name) <= high:
                raise ConfigError(f"{name} of films must be from {low} to {high}, got {getattr(self, name)}")

    def require_scenes(self, indices: range) -> None:
        """Check that an evaluation has the scenes that are named, before it runs.

        Args:
            indices: Its scenes; those of a shard are in steps.

        Raises:
            ConfigError: When one is not among them.
        """
        known = set(map(str, indices))
        if unknown := [scene for scene in self.only if scene not in known]:
            steps = f" in steps of {indices.step}: the shard's" if indices.step > 1 else ""
            numbers = f"from {indices[0]} to {indices[-1]}{steps}"
            raise ConfigError(f"no scene {', '.join(unknown)} to film: scenes are numbered {numbers}")
