"""Verdicts of a judge on an episode, tick by tick."""

from __future__ import annotations

from dataclasses import dataclass, field

NOT_HELD = "not_held"
"""Reason while a task is solved, but not yet for the required time."""
LIMIT = "limits."
"""Begins the predicates of a task's measures beside success."""
STEP = "step"
"""Predicate of tasks of several steps: number, from 1, of the first step that is not done, or of the last one."""
STEPS_DONE = "steps_done"
"""Predicate of tasks of several steps: number of steps that are done and hold."""
STEPS_SHARE = "steps_share"
"""Predicate of tasks of several steps: share of steps that are done and hold, 0..1."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The outcome so far. It is a pure fold over state records and can be computed live or from a bag."""

    success: bool = False
    """Whether the task is solved at this tick."""
    success_ever: bool = False
    """Whether the task was solved at this or any earlier tick."""
    failed: bool = False
    """Whether the task can no longer be solved, e.g. because the target fell off the table."""
    reason: str = ""
    """Why the task failed, or which condition is not met, in snake_case, e.g. ``not_lifted``; empty on success."""
    predicates: dict[str, float] = field(default_factory=dict)
    """Predicate name to value: 0 or 1, or a measured value with its unit in the name, e.g. ``lift_m``."""

    @property
    def solved(self) -> bool:
        """Whether all conditions of the skill hold at this tick, for however short a time."""
        return self.success or self.reason == NOT_HELD

    @property
    def step(self) -> int:
        """Number, from 1, of the step at hand of a task of several steps; 0: the task has one step."""
        return int(self.predicates.get(STEP, 0))
