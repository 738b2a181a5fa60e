"""Success rates with their uncertainty."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import InvalidRequestError


@dataclass(frozen=True, kw_only=True)
class SuccessRate:
    """A share of successes with its 95 % interval."""

    successes: int
    """Episodes that succeeded."""
    episodes: int
    """Episodes run, errors included."""
    low: float
    """Lower bound of the interval, 0..1."""
    high: float
    """Upper bound of the interval, 0..1."""

    @property
    def rate(self) -> float:
        """Share of successes, 0..1; 0 for no episodes."""
        return self.successes / self.episodes if self.episodes else 0.0

    def __str__(self) -> str:
        """Format the rate, e.g. ``14 of 20 = 70 % (95 % interval 48 to 85 %)``."""
        if not self.episodes:
            return "no episodes"
        return (
            f"{self.successes} of {self.episodes} = {100 * self.rate:.0f} % "
            f"(95 % interval {100 * self.low:.0f} to {100 * self.high:.0f} %)"
        )


@lru_cache(maxsize=4096)
def success_rate(successes: int, episodes: int) -> SuccessRate:
    """Return a success rate with its interval at 95 %.

    The interval is Wilson's score interval. If no episode or every episode succeeded, it is one-sided, and its bound is
    Clopper's and Pearson's at 97.5 %, because Wilson's interval is too narrow there.

    Args:
        successes: Episodes that succeeded.
        episodes: Episodes run.

    Raises:
        InvalidRequestError: If a count is negative, or there are more successes than episodes.

    Source:
        Wilson (1927) and Clopper and Pearson (1934), as `scipy.stats.binomtest` computes them.
    """
    from scipy.stats import binomtest

    if not 0 <= successes <= episodes:
        raise InvalidRequestError(f"needs 0 <= successes <= episodes, got {successes} of {episodes}")
    if episodes == 0:
        return SuccessRate(successes=0, episodes=0, low=0.0, high=1.0)
    method: Literal["exact", "wilson"] = "exact" if successes in (0, episodes) else "wilson"
    interval = binomtest(successes, episodes).proportion_ci(confidence_level=0.95, method=method)
    return SuccessRate(successes=successes, episodes=episodes, low=float(interval.low), high=float(interval.high))


def rate_of(results: Iterable[EpisodeResult]) -> SuccessRate:
    """Return the success rate of results; an error does not count as a success."""
    outcomes = [result.outcome == "success" for result in results]
    return success_rate(sum(outcomes), len(outcomes))


def rates_by(results: Sequence[EpisodeResult], key: Callable[[EpisodeResult], str]) -> dict[str, SuccessRate]:
    """Return group name to success rate, sorted by name.

    Args:
        results: The results.
        key: Returns the group name of a result, e.g. its instruction.
    """
    groups: dict[str, list[EpisodeResult]] = {}
    for result in results:
        groups.setdefault(key(result), []).append(result)
    return {name: rate_of(groups[name]) for name in sorted(groups)}


def failure_reasons(results: Iterable[EpisodeResult]) -> dict[str, int]:
    """Count the reasons of episodes that did not succeed, most frequent first."""
    reasons = Counter(result.reason or "unnamed" for result in results if result.outcome != "success")
    return dict(reasons.most_common())


def error_reasons(results: Iterable[EpisodeResult]) -> dict[str, int]:
    """Count the reasons of episodes that ended in an error, most frequent first."""
    return failure_reasons(result for result in results if result.outcome == "error")


def is_measured(results: Sequence[EpisodeResult]) -> bool:
    """Return whether results measure a policy: false if more than half of the episodes ended in an error."""
    return 2 * sum(error_reasons(results).values()) <= len(results)


def error_line(results: Sequence[EpisodeResult]) -> str:
    """Return a phrase with the number and reasons of episodes that ended in errors; empty if there are none."""
    reasons = error_reasons(results)
    if not reasons:
        return ""
    kinds = ", ".join(f"{reason} x{count}" for reason, count in reasons.items())
    line = f"{sum(reasons.values())} of {len(results)} episodes ended in errors ({kinds})"
    return line if is_measured(results) else f"{line}; the policy is not measured"
