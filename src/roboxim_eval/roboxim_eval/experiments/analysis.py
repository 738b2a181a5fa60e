"""Results of an experiment: from counts by cell to scores and verdicts.

Everything follows from the counts and from the pairs of outcomes on shared scenes, so that a stored card can be checked
without the bags.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from roboxim_core.errors import ConfigError, one_of
from roboxim_eval.experiments.cells import chosen
from roboxim_eval.experiments.config import CompareConfig, ExperimentConfig
from roboxim_eval.experiments.design import Design
from roboxim_eval.statistics.multiple import holm
from roboxim_eval.statistics.paired import Pairs, independent_difference, paired_difference
from roboxim_eval.statistics.rates import success_rate
from roboxim_eval.statistics.replicates import MIN_REPLICATES, ConditionDifference, condition_difference
from roboxim_eval.statistics.scores import Scores, scores
from roboxim_eval.statistics.tables import Arm, Count, Intervals
from roboxim_eval.statistics.verdicts import Verdict, checkpoint_verdict, condition_verdict

MAX_ERRORS = 0.01
"""Share of episodes that ended in errors above which a policy is not measured."""


@dataclass(frozen=True, kw_only=True)
class Outcomes:
    """Outcomes of an experiment's final evaluations."""

    counts: Mapping[str, Sequence[Mapping[str, Count]]]
    """Condition to the counts by cell of each replicate."""
    pairs: Mapping[int, Sequence[Pairs]] = field(default_factory=dict)
    """Number of a comparison to the outcomes of its conditions on shared scenes, for each replicate."""
    failed: Sequence[tuple[str, Collection[str]]] | None = None
    """Failed held-out episodes of the primary comparison's first condition, judged again; none: not judged again."""
    intervals: Intervals = "beta_binomial_differences"
    """Method of the intervals."""

    @property
    def score(self) -> bool:
        """Whether two checkpoints are compared by Tango's score interval, as in cards since schema 4."""
        return self.intervals == "beta_binomial_differences"

    def arm(self, condition: str) -> Arm:
        """Return the outcomes of a condition.

        Raises:
            ConfigError: When it has none.
        """
        if condition not in self.counts:
            raise ConfigError(f"no outcomes of condition '{condition}'; {one_of(self.counts, condition)}")
        return Arm(replicates=tuple(self.counts[condition]), intervals=self.intervals)

    @property
    def arms(self) -> dict[str, Arm]:
        """Condition to its outcomes."""
        return {name: self.arm(name) for name in self.counts}


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """A comparison with its verdict."""

    config: CompareConfig
    """The comparison."""
    verdict: Verdict
    """The verdict; its p values are adjusted for all comparisons of the file (Holm), separately for a difference and
    for a difference within the margin."""


@dataclass(frozen=True, kw_only=True)
class Analysis:
    """All results of an experiment."""

    comparisons: tuple[Comparison, ...]
    """The comparisons, the primary one first."""
    scores: Scores | None
    """Scores of the held-out cells; none: the experiment has no held-out cells and baseline."""
    warnings: tuple[str, ...]
    """Limitations of the results, in sentences."""

    @property
    def sentences(self) -> tuple[str, ...]:
        """A sentence for each comparison, the primary one first, then the warnings."""
        return (*(comparison.verdict.sentence for comparison in self.comparisons), *self.warnings)


def analyse(design: Design, outcomes: Outcomes) -> Analysis:
    """Return the scores and verdicts of an experiment.

    Args:
        design: The experiment.
        outcomes: Outcomes of its final evaluations.

    Raises:
        ConfigError: When a condition has no outcomes, or outcomes lack a cell of its evaluation.
        InvalidRequestError: When conditions have different numbers of replicates.
    """
    arms = {name: _arm(design, name, outcomes) for name in design.config.conditions}
    compares = sorted(enumerate(design.config.compare), key=lambda item: item[1] is not design.config.primary)
    pairs = [outcomes.pairs.get(n, ()) if _same_scenes(compare) else () for n, compare in compares]
    found = [_differences(design, arms, one, shared) for (_, one), shared in zip(compares, pairs, strict=True)]
    adjusted = holm([_p_value(difference) for difference in found])
    margin, score = design.config.decide.margin, outcomes.score
    as_good = holm([_p_as_good(difference, margin, score=score) for difference in found])
    comparisons = tuple(
        Comparison(
            config=compare, verdict=_verdict(design.config, compare, difference, p_value, equal, shared, score=score)
        )  # fmt: skip
        for (_, compare), difference, p_value, equal, shared in zip(
            compares, found, adjusted, as_good, pairs, strict=True
        )
    )
    own = _scores(design, arms, outcomes)
    warnings = (*(own.warnings if own else ()), *_errors(arms), *_empty(arms))
    return Analysis(comparisons=comparisons, scores=own, warnings=warnings)


def _arm(design: Design, condition: str, outcomes: Outcomes) -> Arm:
    return outcomes.arm(condition).within(list(design.counts(condition)))


def _keys(design: Design, where: str) -> list[str]:
    return [cell.key for cell in chosen(design.cells, where)]


def _same_scenes(compare: CompareConfig) -> bool:
    """Tell whether both sides meet the same cells; otherwise pairs would be those of a condition with itself."""
    return compare.against in ("", compare.where)


def _differences(
    design: Design, arms: Mapping[str, Arm], compare: CompareConfig, pairs: Sequence[Pairs]
) -> ConditionDifference:
    first = arms[compare.first].within(_keys(design, compare.where))
    second = arms[compare.second].within(_keys(design, compare.against or compare.where))
    same = design.config.compares_same_trainings(compare)
    return condition_difference(first, second, pairs, same_cells=not compare.against, same_trainings=same)


def _p_value(difference: ConditionDifference) -> float:
    """Return the p value of a comparison by itself: over trainings, or over scenes if there is one training each."""
    if difference.replicates >= MIN_REPLICATES:
        return difference.p_value
    if difference.replicates > 1:
        return 1.0
    if difference.pairs is not None and difference.pairs.scenes:
        return paired_difference(difference.pairs).p_value
    return independent_difference(*difference.rollouts).p_value


def _p_as_good(difference: ConditionDifference, margin: float, *, score: bool) -> float:
    """Return the p value of a difference within the margin by itself; 1 where none can be shown."""
    if difference.replicates >= MIN_REPLICATES:
        return difference.p_as_good(margin)
    if difference.replicates == 1 and difference.pairs is not None and difference.pairs.scenes:
        return paired_difference(difference.pairs, score=score).p_as_good(margin)
    return 1.0


def _verdict(
    config: ExperimentConfig, compare: CompareConfig, difference: ConditionDifference, p_value: float,
    p_as_good: float, shared: Sequence[Pairs], *, score: bool,
) -> Verdict:  # fmt: skip
    first, second = compare.first, compare.second
    margin, alpha, comparisons = config.decide.margin, config.decide.alpha, len(config.compare)
    if compare.against:
        first, second = f"{first} in {compare.where} cells", f"{second} in {compare.against} cells"
    elif compare.where != "all":
        first, second = f"{first} in {compare.where} cells", f"{second} there"
    if difference.replicates > 1:
        return condition_verdict(
            first, second, difference, margin=margin, alpha=alpha, p_value=p_value, p_as_good=p_as_good,
            comparisons=comparisons,
        )  # fmt: skip
    if difference.pairs is not None and difference.pairs.scenes:
        return checkpoint_verdict(
            first, second, difference.pairs, margin=margin, alpha=alpha, p_value=p_value, p_as_good=p_as_good,
            comparisons=comparisons, score=score,
        )  # fmt: skip
    apart = independent_difference(*difference.rollouts)
    verdict = condition_verdict(first, second, difference, margin=margin, alpha=alpha)
    which = "These rates of one checkpoint" if compare.first == compare.second else "These two checkpoints"
    adjusted = " after adjustment" if comparisons > 1 else ""
    # cells with unequal numbers of rollouts are not paired, see `condition_difference`
    how = "without pairing their scenes" if any(pairs.scenes for pairs in shared) else "on different scenes"
    return replace(verdict, sentence=f"{verdict.sentence} {which} differ by {apart} {how} (p {p_value:.2g}{adjusted}).")


def _scores(design: Design, arms: Mapping[str, Arm], outcomes: Outcomes) -> Scores | None:
    primary, unseen = design.config.primary, _keys(design, "unseen")
    if primary is None or primary.against or primary.where != "unseen" or not unseen or design.config.combinations:
        return None  # the second side of combinations never saw the held-out cells: it is no baseline
    blind = design.config.blind
    order = outcomes.pairs.get(design.config.compare.index(primary), ())
    swapped = [Pairs(both=p.both, first=p.second, second=p.first, neither=p.neither) for p in order]
    return scores(
        arms[primary.first],
        arms[primary.second],
        unseen=unseen,
        blind=arms[blind] if blind else None,
        failed=outcomes.failed,
        pairs=swapped,
        refuse_below=design.config.decide.refuse_below,
    )


def _errors(arms: Mapping[str, Arm]) -> Iterable[str]:
    for name, arm in arms.items():
        count = arm.pooled
        if count.errors > MAX_ERRORS * count.episodes:
            rate = success_rate(count.errors, count.episodes)
            yield (
                f"{name}: {rate} of the episodes ended in errors, more than {100 * MAX_ERRORS:.0f} %; its results are "
                "not to be relied on."
            )


def _empty(arms: Mapping[str, Arm]) -> Iterable[str]:
    for name, arm in arms.items():
        for number, counts in enumerate(arm.replicates):
            if empty := [cell for cell, count in counts.items() if not count.episodes]:
                yield (
                    f"{name}, replicate {number}: no episode counts in {', '.join(empty)}, so its rate is the mean of "
                    "other cells than that of the others; do not rely on their differences."
                )
