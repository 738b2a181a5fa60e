"""Models side by side: the same condition of several runs of an experiment, on the cells that all runs contain.

Each model has its own trainings. With three or more each, trainings are the sample (Q2): Student's t over the
difference of each replicate or, where the numbers of trainings differ, Welch's t over all trainings of both. With
fewer, only these checkpoints are compared (Q1): on the scenes that both met (McNemar) or, where the scenes differ, on
the rollouts (Boschloo). P values of all pairs are adjusted (Holm); two models without a common letter differ. If more
than two models did not all meet the same scenes, their strengths show which models solve scenes that others do not
(Bradley-Terry).

Errors count as failures. A model with many of them is named, since its rate says little about the model. Runs whose
rollouts had different tasks are refused; other differences are named, see `roboxim_eval.experiments.comparable`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from roboxim_core.errors import ConfigError, one_of
from roboxim_eval.experiments.analysis import MAX_ERRORS
from roboxim_eval.experiments.card import Card
from roboxim_eval.experiments.card_checks import design_of_card, outcomes_of_card
from roboxim_eval.experiments.cells import chosen
from roboxim_eval.experiments.comparable import circumstances, require_same_rollouts
from roboxim_eval.experiments.config import ExperimentConfig
from roboxim_eval.statistics.multiple import bradley_terry, compact_letters, holm
from roboxim_eval.statistics.paired import Pairs, independent_difference, paired_difference
from roboxim_eval.statistics.rates import SuccessRate, success_rate
from roboxim_eval.statistics.replicates import (
    MIN_REPLICATES,
    ConditionDifference,
    Interval,
    condition_difference,
    condition_rate,
    is_even,
)
from roboxim_eval.statistics.tables import Arm

Wins = Mapping[tuple[str, str], bool]
"""Scene (cell and number) to whether it was solved."""


@dataclass(frozen=True, kw_only=True)
class Model:
    """A model in the comparison."""

    rate: Interval
    """Success rate, mean of the cells, with its 95 % interval."""
    successes: int
    """Rollouts that succeeded."""
    episodes: int
    """All rollouts."""
    errors: int
    """Rollouts that ended in an error; they count as failures."""
    trainings: int
    """Number of trainings."""
    letters: str
    """Models without a common letter differ."""

    @property
    def has_many_errors(self) -> bool:
        """Whether more rollouts ended in errors than an experiment's results allow, see `MAX_ERRORS`."""
        return self.errors > MAX_ERRORS * self.episodes


@dataclass(frozen=True, kw_only=True)
class PairOfModels:
    """Two models compared."""

    first: str
    """Model."""
    second: str
    """Model."""
    difference: Interval
    """First minus second, with its 95 % interval."""
    p: float
    """p value, adjusted for all pairs (Holm)."""
    test: str
    """Test, in words."""

    @property
    def differs(self) -> bool:
        """Whether a difference is shown: p is at most 0.05, and the interval excludes 0.

        The exact test may find a difference of small samples whose interval, by another method, includes 0.
        """
        return self.p <= 0.05 and not self.difference.low <= 0 <= self.difference.high


@dataclass(frozen=True, kw_only=True)
class Models:
    """Several models side by side."""

    condition: str
    """Condition that is compared."""
    where: str
    """``unseen``, ``seen`` or ``all``."""
    cells: tuple[str, ...]
    """Cells that all models met."""
    left_out: tuple[str, ...]
    """Cells that some model did not meet."""
    models: Mapping[str, Model]
    """Name to model, the best first."""
    pairs: tuple[PairOfModels, ...]
    """All pairs."""
    warnings: Mapping[str, tuple[str, ...]]
    """Model to the warnings of its own card."""
    strengths: Mapping[str, float]
    """Model to the log-odds that it, rather than an average model, solved a scene that exactly one of the two solved;
    the strongest first. Empty where all met the same scenes, or too few scenes connect them."""
    circumstances: tuple[str, ...]
    """Other differences between the runs than the models, a sentence each, e.g. their scales."""

    @property
    def sentences(self) -> tuple[str, ...]:
        """The result in words: models with many errors, the verdicts, and the warnings of the cards."""
        own = [
            f"The card of {name} warns: {warning}" for name, warnings in self.warnings.items() for warning in warnings
        ]
        return (*self.errors, *self.verdicts, *own)

    @property
    def errors(self) -> tuple[str, ...]:
        """A sentence for each model with many errors."""
        return tuple(
            f"{name}: {success_rate(model.errors, model.episodes)} of the rollouts ended in errors, more than "
            f"{100 * MAX_ERRORS:.0f} %; its results are not to be relied on."
            for name, model in self.models.items()
            if model.has_many_errors
        )

    @property
    def verdicts(self) -> tuple[str, ...]:
        """A sentence for each pair, first those that differ; then cells that are left out, and other differences."""
        differing = [pair for pair in self.pairs if pair.differs]
        found = [
            f"{best} is better than {worse} by {100 * abs(pair.difference.value):.0f} points "
            f"({_ends(pair.difference)}), {self._basis(pair)}."
            for pair in differing
            for best, worse in [_ordered(pair)]
        ]
        rest = [pair for pair in self.pairs if not pair.differs]
        found += [
            f"Cannot tell whether {pair.first} or {pair.second} is better: {self._unclear(pair)}, {self._basis(pair)}."
            for pair in rest
        ]
        if self.strengths:
            odds = ", ".join(f"{name} {value:+.2f}" for name, value in self.strengths.items())
            found.append(
                "Not all models met the same scenes. Log-odds of solving a scene that one of two models solved, over "
                f"the scenes that pairs met, against the average model (Bradley-Terry): {odds}."
            )
        if self.left_out:
            found.append(f"Left out, since not all models met them: {', '.join(self.left_out)}.")
        return (*found, *self.circumstances)

    def _basis(self, pair: PairOfModels) -> str:
        """Return the basis of a pair's sentence: the test, and the models whose errors count as failures."""
        broken = [name for name in (pair.first, pair.second) if self.models[name].has_many_errors]
        return f"{pair.test}; errors of {' and '.join(broken)} count as failures" if broken else pair.test

    def _unclear(self, pair: PairOfModels) -> str:
        """Return why a pair is not decided; an interval without 0 does not decide where p is too large."""
        interval = pair.difference
        if interval.low <= 0 <= interval.high:
            return f"{_signed(interval)} points are compatible"
        adjusted = " after adjustment for several comparisons" if len(self.pairs) > 1 else ""
        return f"the difference is {_points(interval.value)} points, but p is {pair.p:.2g}{adjusted}"


def compare_models(
    cards: Mapping[str, Card], *, condition: str = "", where: str = "",
    scenes: Mapping[str, Sequence[Wins]] | None = None,
) -> Models:  # fmt: skip
    """Compare a condition of several runs.

    Args:
        cards: Name of a model to its card.
        condition: Condition; empty: the first one of the primary comparison.
        where: ``unseen``, ``seen`` or ``all``; empty: that of the primary comparison.
        scenes: Model to the outcomes of each replicate by scene; models that met the same scenes are compared on them.

    Raises:
        ConfigError: When there are fewer than two cards, a card lacks the condition, no cell is common to all, or the
            rollouts of two runs had different tasks.
    """
    if len(cards) < 2:
        raise ConfigError(f"a comparison needs at least two runs, got {len(cards)}")
    first = next(iter(cards.values())).experiment.config
    condition = condition or compared_condition(first)
    where = where or (first.primary.where if first.primary else "all")
    arms = {name: _arm(name, card, condition) for name, card in cards.items()}
    keys = {name: _keys(cards[name], where) & set(arm.cells) for name, arm in arms.items()}
    common = set.intersection(*keys.values())
    if not common:
        raise ConfigError(f"the runs have no {where} cell in common; compare runs of one experiment")
    require_same_rollouts(cards, condition, common)
    order = [cell for cell in next(iter(arms.values())).cells if cell in common]
    arms = {name: arm.within(order) for name, arm in arms.items()}
    found = [
        _pair(one, two, arms, set(order), scenes or {}) for one, two in itertools.combinations(arms, 2)
    ]  # fmt: skip
    adjusted = holm([pair.p for pair in found])
    pairs = tuple(
        PairOfModels(first=p.first, second=p.second, difference=p.difference, p=q, test=p.test)
        for p, q in zip(found, adjusted, strict=True)
    )
    letters = compact_letters(
        {name: arm.rate for name, arm in arms.items()}, {(p.first, p.second): p.differs for p in pairs}
    )
    return Models(
        condition=condition, where=where, cells=tuple(order),
        left_out=tuple(sorted(set.union(*keys.values()) - common)), pairs=pairs,
        models={name: _model(arms[name], letters[name]) for name in letters},
        warnings={name: cards[name].warnings for name in letters}, strengths=_strengths(scenes or {}, set(order)),
        circumstances=tuple(circumstances(cards, condition)),
    )  # fmt: skip


def compared_condition(config: ExperimentConfig) -> str:
    """Return the condition by which runs are compared by default: the primary comparison's first one."""
    return config.primary.first if config.primary else next(iter(config.conditions))


def _arm(name: str, card: Card, condition: str) -> Arm:
    arms = outcomes_of_card(card).arms
    if condition not in arms:
        raise ConfigError(f"{name} has no condition '{condition}'; {one_of(arms, condition)}")
    return arms[condition]


def _keys(card: Card, where: str) -> set[str]:
    return {cell.key for cell in chosen(design_of_card(card).cells, where)}


def _model(arm: Arm, letters: str) -> Model:
    pooled = arm.pooled
    return Model(
        rate=condition_rate(arm), successes=pooled.successes, episodes=pooled.episodes, errors=pooled.errors,
        trainings=len(arm.replicates), letters=letters,
    )  # fmt: skip


def _pair(
    one: str, two: str, arms: Mapping[str, Arm], cells: set[str], scenes: Mapping[str, Sequence[Wins]]
) -> PairOfModels:
    first, second = arms[one], arms[two]
    numbers = len(first.replicates), len(second.replicates)
    replicates, equal = min(numbers), numbers[0] == numbers[1]
    pairs = _shared(scenes.get(one, ()), scenes.get(two, ()), cells) if equal else []
    if replicates >= MIN_REPLICATES and not equal:
        interval, p = _welch(first, second)
        test = f"over {numbers[0]} and {numbers[1]} trainings"
        return PairOfModels(first=one, second=two, difference=interval, p=p, test=test)
    if replicates >= MIN_REPLICATES:
        difference = condition_difference(first, second, pairs[:replicates] if len(pairs) >= replicates else ())
        return PairOfModels(
            first=one, second=two, difference=difference.interval(), p=difference.p_value,
            test=f"over {replicates} trainings each",
        )  # fmt: skip
    if pairs and all(p.scenes for p in pairs) and is_even(first) and is_even(second):
        together = sum(pairs[1:], start=pairs[0])
        found, test = paired_difference(together), f"these checkpoints, on {together.scenes} scenes that both met"
    else:
        found = independent_difference(*_rollouts(first, second))
        apart = equal and scenes.get(one) and scenes.get(two) and not any(p.scenes for p in pairs)
        test = f"these checkpoints, {'on different scenes' if apart else 'without pairing their scenes'}"
    interval = Interval(value=found.value, low=found.low, high=found.high)
    return PairOfModels(first=one, second=two, difference=interval, p=found.p_value, test=test)


def _rollouts(first: Arm, second: Arm) -> tuple[SuccessRate, SuccessRate]:
    """Return the success rates of the rollouts of two models, those of all trainings together."""
    return condition_difference(Arm(replicates=(first.by_cell,)), Arm(replicates=(second.by_cell,))).rollouts


def _welch(first: Arm, second: Arm) -> tuple[Interval, float]:
    """Compare models with different numbers of trainings, which have no partners: Welch's t over all trainings.

    As for `ConditionDifference`, the interval is never narrower than that of the rollouts alone, and p never smaller.

    Args:
        first: Outcomes of a model with at least two trainings.
        second: Outcomes of another one, with at least two trainings.

    Returns:
        The difference of the mean rates, first minus second, with its 95 % interval; and the two-sided p value.

    Source:
        Welch (1947), Biometrika 34, 28-35; as `scipy.stats.ttest_ind` with unequal variances, which warns of equal
        rates and returns no number if all are equal.
    """
    from scipy.stats import t as student

    value = first.rate - second.rate
    alone = ConditionDifference(differences=(value, value), rollouts=_rollouts(first, second))  # without a spread
    floor, p_alone = alone.interval(), alone.p_value
    numbers = np.array([len(first.replicates), len(second.replicates)])
    squares = np.array([np.var(first.rates, ddof=1), np.var(second.rates, ddof=1)]) / numbers
    error = math.sqrt(squares.sum())
    if error < 1e-9:  # equal trainings of each, except for rounding
        return floor, p_alone
    freedom = squares.sum() ** 2 / (squares**2 / (numbers - 1)).sum()
    half = float(student.ppf(0.975, freedom)) * error
    interval = Interval(
        value=value, low=max(-1.0, min(floor.low, value - half)), high=min(1.0, max(floor.high, value + half))
    )
    return interval, max(p_alone, float(2 * student.sf(abs(value) / error, freedom)))


def _shared(first: Sequence[Wins], second: Sequence[Wins], cells: set[str]) -> list[Pairs]:
    return [
        Pairs.of((one[scene], two[scene]) for scene in one if scene in two and scene[0] in cells)
        for one, two in zip(first, second, strict=False)
    ]


def _strengths(scenes: Mapping[str, Sequence[Wins]], cells: set[str]) -> dict[str, float]:
    """Return the strengths of more than two models that did not all meet the same scenes; empty: not needed, or none.

    Args:
        scenes: Model to the outcomes of each replicate by scene.
        cells: Cells to include.
    """
    met = {
        name: {(replicate, *scene) for replicate, wins in enumerate(found) for scene in wins if scene[0] in cells}
        for name, found in scenes.items()
    }
    if len(met) < 3 or len({frozenset(found) for found in met.values()}) == 1:
        return {}
    wins: dict[tuple[str, str], int] = {}
    for one, two in itertools.combinations(met, 2):
        pairs = sum(_shared(scenes[one], scenes[two], cells), start=Pairs(both=0, first=0, second=0, neither=0))
        wins |= {(one, two): pairs.first, (two, one): pairs.second} if pairs.first + pairs.second else {}
    connected = {next(iter(met))}
    for _ in met:
        connected |= {name for pair in wins if connected & set(pair) for name in pair}
    if connected != set(met):
        return {}
    found = bradley_terry(wins)
    return {name: found[name] for name in sorted(found, key=lambda name: -found[name])}


def _ordered(pair: PairOfModels) -> tuple[str, str]:
    return (pair.first, pair.second) if pair.difference.value > 0 else (pair.second, pair.first)


def _ends(interval: Interval) -> str:
    ends = sorted((abs(interval.low), abs(interval.high)))
    return f"{100 * ends[0]:.0f} to {100 * ends[1]:.0f}"


def _signed(interval: Interval) -> str:
    return f"{_points(interval.low)} to {_points(interval.high)}"


def _points(difference: float) -> str:
    """Format a difference in points with its sign, e.g. ``-7``; never ``-0``."""
    return f"{round(100 * difference) + 0:+d}"
