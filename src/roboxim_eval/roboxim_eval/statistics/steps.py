"""Partial credit of tasks of several steps: which share of the steps was done, and which step was not."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from roboxim_core.episode import EpisodeResult
from roboxim_core.verdicts import STEP, STEPS_SHARE

DRAWS = 10_000
"""Number of samples of the bootstrap."""


@dataclass(frozen=True, kw_only=True)
class StepShare:
    """Mean share of the steps that were done at the end of an episode, with its 95 % interval."""

    share: float
    """Mean over episodes, 0..1; an episode that ended in an error counts with what was done by then."""
    low: float
    """Lower bound of the interval, 0..1."""
    high: float
    """Upper bound of the interval, 0..1."""
    episodes: int
    """Episodes of tasks of several steps."""
    stopped_at: dict[str, int]
    """Number of the first step that was not done, to the number of failed episodes that stopped there."""

    def __str__(self) -> str:
        """Format the share, e.g. ``62 % of the steps (95 % interval 50 to 74 %)``."""
        return f"{100 * self.share:.0f} % of the steps (95 % interval {100 * self.low:.0f} to {100 * self.high:.0f} %)"

    @property
    def stops(self) -> str:
        """At which steps failed episodes stopped, in words; empty: none failed."""
        return ", ".join(f"step {step} ({count})" for step, count in self.stopped_at.items())


def step_share(results: Sequence[EpisodeResult]) -> StepShare | None:
    """Return the partial credit of results; None: no task has several steps.

    The interval is the percentile bootstrap's over episodes, with a fixed seed. If all episodes have the same share it
    is as wide as that of a rate: an interval of width 0 would claim certainty.

    Source:
        Efron and Tibshirani, An Introduction to the Bootstrap (1993), chapter 13.
    """
    from roboxim_eval.statistics.rates import success_rate

    several = [result for result in results if STEPS_SHARE in result.verdict.predicates]
    if not several:
        return None
    shares = np.array([result.verdict.predicates[STEPS_SHARE] for result in several])
    count, mean = len(shares), float(shares.mean())
    means = np.random.default_rng(0).choice(shares, (DRAWS, count)).mean(axis=1)
    low, high = (float(value) for value in np.quantile(means, (0.025, 0.975)))
    if shares.min() == shares.max():
        bounds = success_rate(round(mean * count), count)
        low, high = min(low, bounds.low), max(high, bounds.high)
    stops = Counter(int(result.verdict.predicates[STEP]) for result in several if result.outcome != "success")
    stopped_at = {str(number): stops[number] for number in sorted(stops)}
    return StepShare(share=mean, low=low, high=high, episodes=count, stopped_at=stopped_at)
