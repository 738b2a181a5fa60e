"""What a judge says of an episode, tick by tick."""

from __future__ import annotations

from dataclasses import dataclass, field

NOT_HELD = "not_held"
"""Reason of a task that is solved but has not stayed so for long enough."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The outcome so far: a pure fold over state records, computed live and from a bag alike."""

    success: bool = False
    """Whether the task is solved at this tick."""
    success_ever: bool = False
    """Whether it was solved at this or any earlier tick."""
    failed: bool = False
    """Whether the task can no longer be solved, e.g. because the target fell off the table."""
    reason: str = ""
    """Why the task failed, or what is missing, in snake_case, e.g. ``not_lifted``; empty on success."""
    predicates: dict[str, float] = field(default_factory=dict)
    """Predicate name to value: 0 or 1, or a measure with its unit in the name, e.g. ``lift_m``."""

    @property
    def solved(self) -> bool:
        """Whether everything that the skill demands holds at this tick, however briefly."""
        return self.success or self.reason == NOT_HELD
