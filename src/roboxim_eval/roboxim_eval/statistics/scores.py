"""Scores of an experiment with held-out cells: how well a policy combines levels that it has seen only separately.

With u the success rate of the leave-out condition in held-out cells, s that of the baseline, b that of the leave-out
condition without words (``blind``), and u_seen, s_seen the rates in cells that both have seen:

| score | formula | guards against |
| --- | --- | --- |
| absolute | u | a good ratio of two bad policies; it ranks models |
| gap | s - u | the blow-up of a ratio; the primary test |
| relative | u / s | nothing by itself, so it is never reported alone; refused if the baseline is too weak |
| words | u - b | a policy that ignores the instruction |
| substitution | see below | memorised pairs |
| competence | u_seen - s_seen | different numbers of demonstrations a cell; a weakened baseline |

Substitution is the share of failed held-out episodes that satisfied another instruction of the training. If no scene
allows one, it is always 0; `roboxim_runs.experiments.scenes.leakage` reports this from the task files.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

from roboxim_eval.statistics.paired import Pairs
from roboxim_eval.statistics.rates import SuccessRate, success_rate
from roboxim_eval.statistics.replicates import (
    MIN_REPLICATES,
    ConditionDifference,
    Interval,
    condition_difference,
    condition_rate,
    condition_ratio,
    mean_interval,
)
from roboxim_eval.statistics.tables import Arm


@dataclass(frozen=True, kw_only=True)
class Relative:
    """The ratio u / s, or the reason why it is refused. It is never clipped at 1."""

    ratio: Interval | None
    """The ratio with its 95 % interval; none: refused."""
    refused: str = ""
    """Why no ratio is stated; empty: it is stated."""

    def __str__(self) -> str:
        """Format the ratio, or the reason."""
        return f"refused: {self.refused}" if self.ratio is None else str(self.ratio)


@dataclass(frozen=True, kw_only=True)
class Substitution:
    """Failed held-out episodes that satisfied another instruction of the training."""

    rate: SuccessRate
    """Their share of the failed held-out episodes."""
    worst: str = ""
    """The most frequent one in words, e.g. ``pick_up target=cube -> place_on target=cube (41 of 60)``; empty: none."""


@dataclass(frozen=True, kw_only=True)
class Scores:
    """All scores of a leave-out condition against its baseline."""

    absolute: Interval
    """u, the success rate in held-out cells."""
    baseline: Interval
    """s, that of the baseline in the same cells."""
    gap: ConditionDifference
    """s - u."""
    relative: Relative
    """u / s."""
    words: ConditionDifference | None = None
    """u - b; none: no blind condition was evaluated."""
    competence: ConditionDifference | None = None
    """u_seen - s_seen; none: no seen cells were evaluated."""
    substitution: Substitution | None = None
    """Memorised pairs; none: no bags were judged again."""
    warnings: tuple[str, ...] = ()
    """Limitations of the scores, in sentences."""


def relative_score(unseen: Arm, baseline: Arm, blind: Arm | None = None, *, refuse_below: float = 0.10) -> Relative:
    """Return u / s, or refuse it.

    It is refused if the lower bound of s is 0 or below ``refuse_below``, or if s is not above b: a baseline that fails,
    or is no better than a policy without words, is no reference.

    Args:
        unseen: The leave-out condition in held-out cells.
        baseline: The baseline in the same cells.
        blind: The leave-out condition without words in these cells; none: not evaluated.
        refuse_below: Least lower bound of the baseline's success rate, 0..1.

    Raises:
        InvalidRequestError: If the replicates differ in number.
    """
    if len(unseen.replicates) < MIN_REPLICATES:
        return Relative(ratio=None, refused=f"fewer than {MIN_REPLICATES} trainings of each condition have no interval")
    s = condition_rate(baseline)
    if s.low < refuse_below or not s.low:  # a ratio to 0 has no upper bound
        return Relative(
            ratio=None,
            refused=f"the baseline may succeed in as little as {100 * s.low:.0f} % of these episodes (limit: "
            f"{100 * refuse_below:.0f} %); a ratio to it means nothing",
        )
    if blind is not None and not (s_over_b := condition_difference(baseline, blind)).interval().low > 0:
        return Relative(
            ratio=None,
            refused="the baseline is not shown to be better than a policy without words "
            f"({100 * s_over_b.interval().low:+.0f} to {100 * s_over_b.interval().high:+.0f} points)",
        )
    return Relative(ratio=condition_ratio(unseen, baseline))


def substitutions(failed: Iterable[tuple[str, Collection[str]]]) -> Substitution:
    """Count the failed held-out episodes that satisfied an instruction of the training.

    Args:
        failed: For each failed held-out episode its cell, and the seen cells whose instructions its bag satisfies.
    """
    failed = [(cell, tuple(satisfied)) for cell, satisfied in failed]
    found = Counter((cell, sorted(satisfied)[0]) for cell, satisfied in failed if satisfied)
    worst = ""
    if found:
        (cell, instead), count = found.most_common(1)[0]
        worst = f"{cell} -> {instead} ({count} of {sum(c == cell for c, _ in failed)} failures)"
    return Substitution(rate=success_rate(sum(found.values()), len(failed)), worst=worst)


def scores(
    leave_out: Arm,
    baseline: Arm,
    *,
    unseen: Collection[str],
    blind: Arm | None = None,
    failed: Iterable[tuple[str, Collection[str]]] | None = None,
    pairs: Sequence[Pairs] = (),
    refuse_below: float = 0.10,
) -> Scores:
    """Return all scores.

    Args:
        leave_out: Outcomes of the leave-out condition, in held-out cells and, if evaluated, in seen ones.
        baseline: Outcomes of the baseline, in the same cells.
        unseen: The held-out cells.
        blind: Outcomes of the leave-out condition's checkpoints without words in held-out cells; none: not evaluated.
        failed: See `substitutions`; none: no bags were judged again.
        pairs: Outcomes of baseline (first) and leave-out (second) in held-out cells, for each replicate.
        refuse_below: See `relative_score`.

    Raises:
        InvalidRequestError: If a held-out cell was not met by an arm, or the replicates differ in number.
    """
    unseen = tuple(unseen)
    u, s = leave_out.within(unseen), baseline.within(unseen)
    b = None if blind is None else blind.within(unseen)
    seen = tuple(cell for cell in leave_out.cells if cell not in unseen and cell in baseline.cells)
    words = None if b is None else condition_difference(u, b, same_trainings=True)
    competence = None
    if seen:
        competence = condition_difference(leave_out.within(seen), baseline.within(seen))
    gap = condition_difference(s, u, pairs)
    return Scores(
        absolute=condition_rate(u),
        baseline=condition_rate(s),
        gap=gap,
        relative=relative_score(u, s, b, refuse_below=refuse_below),
        words=words,
        competence=competence,
        substitution=None if failed is None else substitutions(failed),
        warnings=(
            *_weak_baseline(condition_rate(s), refuse_below),
            *_wordless(condition_rate(u).low >= refuse_below, words, gap),
            *_unequal(competence),
        ),
    )


def _weak_baseline(baseline: Interval, refuse_below: float) -> Iterable[str]:
    if baseline.high < 2 * refuse_below:
        yield (
            f"The baseline succeeds in {100 * baseline.value:.0f} % ({100 * baseline.low:.0f} to "
            f"{100 * baseline.high:.0f} %) of the held-out episodes: to be as good as a baseline that fails is no "
            "success."
        )


def _wordless(succeeds: bool, words: ConditionDifference | None, gap: ConditionDifference) -> Iterable[str]:
    """Yield evidence against an influence of the words: no blind policy, or one that is as good."""
    if words is None:
        yield "No policy without words was evaluated, so the scene alone may explain the success."
    elif succeeds and words.replicates >= MIN_REPLICATES and not words.interval().low > 0:
        alike = f"without the instruction the same checkpoints are not shown to be worse ({_points(words.interval())})"
        if gap.interval().low > 0:
            yield f"The leave-out condition is not shown to use its words in held-out cells: {alike}."
        else:
            yield f"This experiment needs no words here: {alike}."


def _unequal(competence: ConditionDifference | None) -> Iterable[str]:
    """Yield a sentence if the conditions differ in cells that both have seen."""
    if competence is not None and competence.replicates >= MIN_REPLICATES and competence.p_value <= 0.05:
        better = "the leave-out condition" if competence.value > 0 else "the baseline"
        yield (
            f"Competence differs: in cells that both have seen {better} is better ({_points(competence.interval())}), "
            "so the gap is not due to the held-out cells alone."
        )


def _points(interval: Interval) -> str:
    return f"{round(100 * interval.low):+d} to {round(100 * interval.high):+d} points"


@dataclass(frozen=True, kw_only=True)
class ExperimentScore:
    """Values that a benchmark uses from an experiment."""

    dimensions: tuple[str, ...]
    """The dimensions that it varies."""
    absolute: Interval
    """u, the success rate in held-out cells."""
    baseline: Interval
    """s, that of the baseline there."""
    gap: Interval
    """s - u."""
    relative: Interval | None
    """u / s; none: refused."""


@dataclass(frozen=True, kw_only=True)
class DimensionScore:
    """Score of a dimension, e.g. ``object``: the mean over the experiments that vary it."""

    absolute: Interval
    """Mean success rate in held-out cells."""
    baseline: Interval
    """Mean success rate of the baselines there."""
    gap: Interval
    """Mean of what holding out costs, s - u."""
    relative: Interval | None
    """Mean ratio to the baseline; none: refused in an experiment."""
    experiments: tuple[str, ...]
    """The experiments that vary the dimension."""
    refused: tuple[str, ...] = ()
    """Experiments whose ratio was refused, so that there is no mean."""


def dimension_scores(experiments: Mapping[str, ExperimentScore]) -> dict[str, DimensionScore]:
    """Return the benchmark's scores by dimension, as section 6.3 of the thesis defines them.

    Their intervals assume independent experiments: each has its own demonstrations and trainings.

    Args:
        experiments: Name of an experiment to its scores.
    """
    found = {}
    for dimension in dict.fromkeys(name for one in experiments.values() for name in one.dimensions):
        selected = {name: one for name, one in experiments.items() if dimension in one.dimensions}
        ratios = [one.relative for one in selected.values() if one.relative is not None]
        refused = tuple(name for name, one in selected.items() if one.relative is None)
        found[dimension] = DimensionScore(
            absolute=mean_interval([one.absolute for one in selected.values()]),
            baseline=mean_interval([one.baseline for one in selected.values()]),
            gap=mean_interval([one.gap for one in selected.values()]),
            relative=None if refused else mean_interval(ratios),
            experiments=tuple(selected),
            refused=refused,
        )
    return found
