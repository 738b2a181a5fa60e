"""The proof of a convention: with which genuine client it was compared, and what its policies were trained on."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True)
class Proof:
    """Result of `make verify-conventions` for one convention."""

    client: str
    """The genuine client and its version, or the statement of its source."""
    date: str
    """Day of the comparison, ``YYYY-MM-DD``."""
    trained_with: str = ""
    """Where the cameras of the training stood, in words."""
    views: dict[str, str] = field(default_factory=dict)
    """Key of a picture to the camera of ``config/cameras`` that stands where the training's stood, if it was one."""

    def __hash__(self) -> int:
        """Return the hash, which equal ones share."""
        return hash((self.client, self.date))
