"""The source of all randomness: one seed sequence per (run seed, purpose, index, attempt, component).

Components never share a stream, and demonstrations and evaluations never share seeds. An episode depends only on its
own seed path, not on the number of workers, the order, or earlier episodes.

In a mix with ``seed_by: cell`` the cell's key and the number in the cell replace the index. Two mixes then have the
same episodes in shared cells, regardless of their other cells.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from roboxim_core.errors import InvalidRequestError

Purpose = Literal["demo", "eval", "train", "test"]
PURPOSES: tuple[str, ...] = get_args(Purpose)
EVALUATED = ("eval", "train")
"""Purposes of episodes that policies play to be compared: reports, and choices that no report may have seen."""
CELL = "cell"
"""Key of a task's ``drawn``: the episode's cell in a mix, e.g. ``pick_up target=apple``."""
CELL_NUMBER = "cell_number"
"""Key of a task's ``drawn``: number of the episode in its cell, if the seeds go by cell."""


def _number(text: str) -> int:
    return int.from_bytes(hashlib.blake2s(text.encode(), digest_size=4).digest(), "little")


@dataclass(frozen=True, kw_only=True)
class SeedPath:
    """Address of one episode's randomness."""

    run_seed: int
    """Seed of the run, >= 0."""
    purpose: str
    """One of ``demo``, ``eval``, ``train``, ``test``."""
    index: int
    """Index of the episode in its run, >= 0."""
    attempt: int = 0
    """Number of earlier attempts at this index; after a failure the index is drawn again with ``attempt + 1``."""
    cell: str = ""
    """Key of the cell that ``index`` counts in; empty: ``index`` counts in the whole run."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            InvalidRequestError: On a negative number or an unknown purpose.
        """
        if min(self.run_seed, self.index, self.attempt) < 0:
            raise InvalidRequestError(f"seed, index and attempt must be >= 0, got {self}")
        if self.purpose not in PURPOSES:
            raise InvalidRequestError(f"purpose must be one of {', '.join(PURPOSES)}, got '{self.purpose}'")

    def rng(self, component: str) -> np.random.Generator:
        """Return a fresh generator of one component's stream, e.g. ``rng("camera")``."""
        key: tuple[int, ...] = (_number(self.purpose), self.index, self.attempt, _number(component))
        if self.cell:
            key += (_number(self.cell),)
        return np.random.default_rng(np.random.SeedSequence(self.run_seed, spawn_key=key))

    def in_cell(self, cell: str, number: int) -> SeedPath:
        """Return the seed path of an episode that is addressed by its cell and its number there."""
        return replace(self, cell=cell, index=number)

    def of_task(self, drawn: Mapping[str, str]) -> SeedPath:
        """Return the seed path that a task was drawn from.

        Args:
            drawn: The task's ``drawn``; its cell and number replace the index if the seeds go by cell.
        """
        return self.in_cell(drawn[CELL], int(drawn[CELL_NUMBER])) if CELL_NUMBER in drawn else self

    def derived_seed(self, component: str) -> int:
        """Return a 31-bit seed of one component, for libraries and policies that take an integer."""
        return int(self.rng(component).integers(2**31))
