"""Models side by side: the same condition of several runs of an experiment, on the cells that all of them met.

Each model has trainings of its own. With three or more each, trainings are the sample (Q2, Student's t over the
difference of each replicate). With fewer, only these checkpoints are compared (Q1): on the scenes that both met
(McNemar) or, where the scenes differ, on the rollouts (Boschloo). P values of all pairs are adjusted (Holm); two models
without a common letter differ.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from roboxim_core.errors import ConfigError, one_of
from roboxim_eval.experiments.card import Card
from roboxim_eval.experiments.card_checks import design_of_card, outcomes_of_card
from roboxim_eval.experiments.cells import chosen
from roboxim_eval.statistics.multiple import compact_letters, holm
from roboxim_eval.statistics.paired import Pairs, independent_difference, paired_difference
from roboxim_eval.statistics.rates import success_rate
from roboxim_eval.statistics.replicates import LEAST_REPLICATES, Interval, condition_difference, condition_rate
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
    trainings: int
    """Number of trainings."""
    letters: str
    """Models without a common letter differ."""


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
    """What was tested, in words."""


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

    @property
    def sentences(self) -> tuple[str, ...]:
        """The result in words."""
        differing = [pair for pair in self.pairs if pair.p <= 0.05]
        found = [
            f"{best} is better than {worse} by {100 * abs(pair.difference.value):.0f} points "
            f"({_ends(pair.difference)}), {pair.test}."
            for pair in differing
            for best, worse in [_ordered(pair)]
        ]
        rest = [pair for pair in self.pairs if pair.p > 0.05]
        found += [
            f"Cannot tell whether {pair.first} or {pair.second} is better: {_signed(pair.difference)} points are "
            f"compatible, {pair.test}."
            for pair in rest
        ]
        if self.left_out:
            found.append(f"Left out, since not all models met them: {', '.join(self.left_out)}.")
        return tuple(found)


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
        ConfigError: When there are fewer than two cards, a card lacks the condition, or no cell is common to all.
    """
    if len(cards) < 2:
        raise ConfigError(f"a comparison needs at least two runs, got {len(cards)}")
    first = next(iter(cards.values())).experiment.config
    condition = condition or (first.primary.first if first.primary else next(iter(first.conditions)))
    where = where or (first.primary.where if first.primary else "all")
    arms = {name: _arm(name, card, condition) for name, card in cards.items()}
    keys = {name: _keys(cards[name], where) & set(arm.cells) for name, arm in arms.items()}
    common = set.intersection(*keys.values())
    if not common:
        raise ConfigError(f"the runs have no {where} cell in common; compare runs of one experiment")
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
        {name: arm.rate for name, arm in arms.items()}, {(p.first, p.second): p.p <= 0.05 for p in pairs}
    )
    return Models(
        condition=condition, where=where, cells=tuple(order),
        left_out=tuple(sorted(set.union(*keys.values()) - common)), pairs=pairs,
        models={name: _model(arms[name], letters[name]) for name in letters},
    )  # fmt: skip


def _arm(name: str, card: Card, condition: str) -> Arm:
    counts = outcomes_of_card(card).counts
    if condition not in counts:
        raise ConfigError(f"{name} has no condition '{condition}'; {one_of(counts, condition)}")
    return Arm(replicates=tuple(counts[condition]))


def _keys(card: Card, where: str) -> set[str]:
    return {cell.key for cell in chosen(design_of_card(card).cells, where)}


def _model(arm: Arm, letters: str) -> Model:
    pooled = arm.pooled
    return Model(
        rate=condition_rate(arm), successes=pooled.successes, episodes=pooled.episodes, trainings=len(arm.replicates),
        letters=letters,
    )  # fmt: skip


def _pair(
    one: str, two: str, arms: Mapping[str, Arm], cells: set[str], scenes: Mapping[str, Sequence[Wins]]
) -> PairOfModels:
    first, second = arms[one], arms[two]
    replicates = min(len(first.replicates), len(second.replicates))
    pairs = _shared(scenes.get(one, ()), scenes.get(two, ()), cells)
    if replicates >= LEAST_REPLICATES:
        same = Arm(replicates=first.replicates[:replicates]), Arm(replicates=second.replicates[:replicates])
        difference = condition_difference(*same, pairs[:replicates] if len(pairs) >= replicates else ())
        return PairOfModels(
            first=one, second=two, difference=difference.interval(), p=difference.p_value,
            test=f"over {replicates} trainings each",
        )  # fmt: skip
    if pairs and all(p.scenes for p in pairs):
        together = sum(pairs[1:], start=pairs[0])
        found, test = paired_difference(together), f"these checkpoints, on {together.scenes} scenes that both met"
    else:
        rates = [success_rate(a.pooled.successes, a.pooled.episodes) for a in (first, second)]
        found, test = independent_difference(*rates), "these checkpoints, on different scenes"
    interval = Interval(value=found.value, low=found.low, high=found.high)
    return PairOfModels(first=one, second=two, difference=interval, p=found.p_value, test=test)


def _shared(first: Sequence[Wins], second: Sequence[Wins], cells: set[str]) -> list[Pairs]:
    return [
        Pairs.of((one[scene], two[scene]) for scene in one if scene in two and scene[0] in cells)
        for one, two in zip(first, second, strict=False)
    ]


def _ordered(pair: PairOfModels) -> tuple[str, str]:
    return (pair.first, pair.second) if pair.difference.value > 0 else (pair.second, pair.first)


def _ends(interval: Interval) -> str:
    ends = sorted((abs(interval.low), abs(interval.high)))
    return f"{100 * ends[0]:.0f} to {100 * ends[1]:.0f}"


def _signed(interval: Interval) -> str:
    return f"{round(100 * interval.low) + 0:+d} to {round(100 * interval.high) + 0:+d}"
