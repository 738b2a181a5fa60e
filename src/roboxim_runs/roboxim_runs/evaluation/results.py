"""Results of evaluated policies.

Statistics are imported where they are needed: the import takes seconds.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError, EvaluationError, one_of
from roboxim_core.plain_data.tables import aligned
from roboxim_runs.evaluation.notebook import evaluation_html
from roboxim_runs.filmed import Episode

if TYPE_CHECKING:
    from roboxim_eval.statistics.beside import Beside
    from roboxim_eval.statistics.rates import SuccessRate
    from roboxim_eval.statistics.steps import StepShare


@dataclass(frozen=True, kw_only=True)
class PolicyResult:
    """Result of one policy."""

    name: str
    """Its name."""
    results: tuple[EpisodeResult, ...]
    """Results by episode, in the order of their indices."""
    folder: Path
    """Folder of its run, with the bags."""

    @property
    def episodes(self) -> tuple[Episode, ...]:
        """The episodes, each with its bag and its film."""
        return tuple(Episode(policy=self.name, result=result, folder=self.folder) for result in self.results)

    @property
    def measured(self) -> bool:
        """Whether the results measure the policy; false when most episodes ended in errors."""
        from roboxim_eval.statistics.rates import is_measured

        return is_measured(self.results)

    @property
    def rate(self) -> SuccessRate:
        """Success rate with its interval; an error counts as a failure."""
        from roboxim_eval.statistics.rates import rate_of

        return rate_of(self.results)

    @property
    def success_rate(self) -> float | None:
        """Share of successes, 0..1; none when `measured` is false."""
        return self.rate.rate if self.measured else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """The 95 % interval of the success rate; none when `measured` is false."""
        return (self.rate.low, self.rate.high) if self.measured else None

    @property
    def steps(self) -> StepShare | None:
        """Share of the steps that were done, of tasks of several steps; none: all tasks have one step."""
        from roboxim_eval.statistics.steps import step_share

        return step_share(self.results)

    @property
    def measures(self) -> Beside | None:
        """Force, speed, path, smoothness and crossed limits; none: no task has ``limits``."""
        from roboxim_eval.statistics.beside import beside_success

        return beside_success(self.results)

    @property
    def summary(self) -> str:
        """Rate, interval, share of the steps, crossed limits and errors in one line."""
        return rate_line(self.results)


@dataclass(frozen=True, kw_only=True)
class EvaluationResult:
    """Result of an evaluation; ``evaluation["bc"]`` is one policy's result."""

    policies: Mapping[str, PolicyResult]
    """Name to result, the policy under test first."""
    report: Path | None
    """The report, ``<out>/report.html``; none: not written."""
    comparison: str
    """Comparison of the first policy with the others, in words; empty for one policy."""
    privileged: tuple[str, ...]
    """Policies that received the task, scene and state, which a policy under test must not see."""
    doubts: tuple[str, ...] = ()
    """What keeps the results from being relied upon, a sentence each: missing results, and lines without a checksum."""

    def __repr__(self) -> str:
        """Return the rates, in words."""
        lines = [f"{name}: {rate_line(policy.results)}" for name, policy in self.policies.items()]
        more = (*self.doubts, self.comparison, f"report: {self.report}" if self.report else "")
        return "\n".join([*lines, *self.by_skill, *filter(None, more)])

    def __getitem__(self, name: str) -> PolicyResult:
        """Return a policy's result.

        Raises:
            ConfigError: When no policy has the name.
        """
        if name not in self.policies:
            raise ConfigError(f"no policy '{name}' in this evaluation; {one_of(self.policies, name)}")
        return self.policies[name]

    @property
    def first(self) -> PolicyResult:
        """The result of the policy under test."""
        return next(iter(self.policies.values()))

    @property
    def success_rate(self) -> float | None:
        """Success rate of the policy under test, 0..1; none when it was not measured."""
        return self.first.success_rate

    @property
    def interval(self) -> tuple[float, float] | None:
        """The 95 % interval of that rate; none when the policy was not measured."""
        return self.first.interval

    @property
    def results(self) -> tuple[EpisodeResult, ...]:
        """Results by episode of the policy under test."""
        return self.first.results

    @property
    def by_skill(self) -> tuple[str, ...]:
        """Table of the successes by skill, a line each; empty when there is one skill."""
        skills = sorted({episode.skill for policy in self.policies.values() for episode in policy.results})
        if len(skills) < 2:
            return ()
        rows = [("", *self.policies)]
        for skill in skills:
            of = {name: [r for r in policy.results if r.skill == skill] for name, policy in self.policies.items()}
            rows.append(
                (skill, *(f"{sum(r.outcome == 'success' for r in found)} of {len(found)}" for found in of.values()))
            )
        return tuple(aligned(rows))

    @property
    def episodes(self) -> tuple[Episode, ...]:
        """The episodes of all policies."""
        return tuple(episode for policy in self.policies.values() for episode in policy.episodes)

    def to_frame(self) -> Any:
        """Return the episodes of all policies as a pandas data frame, a row each.

        Raises:
            ConfigError: When pandas is not installed.
        """
        try:
            pandas = importlib.import_module("pandas")
        except ImportError:
            raise ConfigError(
                "a data frame needs pandas: pip install pandas; [episode.row() for episode in evaluation.episodes] "
                "has the same rows"
            ) from None
        return pandas.DataFrame([episode.row() for episode in self.episodes])

    def _repr_html_(self) -> str:
        return evaluation_html(self.policies, self.comparison, self.report)

    def require_measured(self) -> None:
        """Refuse a result in which most episodes of a policy ended in errors.

        Raises:
            EvaluationError: Naming the policies.
        """
        broken = [policy for policy in self.policies.values() if not policy.measured]
        if broken:
            names = " and ".join(policy.name for policy in broken)
            raise EvaluationError(
                f"{names} could not be measured: most episodes ended in errors. Fix what their "
                f"reasons name; then choose another output folder (--out or out=) or remove "
                f"{', '.join(str(policy.folder) for policy in broken)}"
            )


def rate_line(results: Sequence[EpisodeResult]) -> str:
    """Return a policy's success rate with its interval, and its errors; only the errors when they are most episodes."""
    from roboxim_eval.statistics.beside import beside_success
    from roboxim_eval.statistics.rates import error_line, is_measured, rate_of
    from roboxim_eval.statistics.steps import step_share

    errors = error_line(results)
    if not is_measured(results):
        return errors
    steps = step_share(results)
    measures = beside_success(results)
    limits = str(measures) if measures and measures.crossed else ""
    parts = [str(rate_of(results)), str(steps) if steps else "", limits, errors]
    return "; ".join(filter(None, parts))
