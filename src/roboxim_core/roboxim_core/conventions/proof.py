"""The proof of a convention: the genuine client that it was compared with, and the training data of its policies."""

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
    """Positions of the training's cameras, in words."""
    views: dict[str, str] = field(default_factory=dict)
    """Picture key to the camera of ``config/cameras`` with the pose of the training's camera, where there is one."""

    def __hash__(self) -> int:
        """Return the hash; equal values have equal hashes."""
        return hash((self.client, self.date))
