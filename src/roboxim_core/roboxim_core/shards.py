"""Shards: one run, or one export, divided among machines that need no connection to each other."""

from __future__ import annotations

import re
from dataclasses import dataclass

from roboxim_core.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class Shard:
    """One part of a run. An episode does not depend on how its run is divided."""

    number: int = 1
    """Number of the part, from 1."""
    count: int = 1
    """Number of parts."""

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Return the shard that ``I/N`` names; the whole run for an empty text.

        Raises:
            ConfigError: When the text has another form, or I is not 1 to N.
        """
        if not text:
            return cls()
        found = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text)
        if not found or not 1 <= int(found[1]) <= int(found[2]):
            raise ConfigError(f"a shard is I/N with I from 1 to N, e.g. 2/8 for the second of 8; got '{text}'")
        return cls(number=int(found[1]), count=int(found[2]))

    def indices(self, episodes: int) -> range:
        """Return the indices of the shard's episodes in a run of ``episodes`` episodes."""
        return range(self.number - 1, episodes, self.count)

    def part(self, episodes: int) -> slice:
        """Return the shard's part of consecutive episodes; the parts of all shards, in order, are the whole run."""
        return slice(episodes * (self.number - 1) // self.count, episodes * self.number // self.count)

    def __str__(self) -> str:
        """Return ``I/N``; empty for a whole run."""
        return f"{self.number}/{self.count}" if self.count > 1 else ""
