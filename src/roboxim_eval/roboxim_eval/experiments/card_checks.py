"""Computes a card's scores, verdicts and sentences from its counts, and checks that a stored card agrees with them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from roboxim_core.config import to_plain
from roboxim_core.errors import ConfigError, RoboximError
from roboxim_eval.experiments.analysis import Analysis, Comparison, Outcomes, analyse
from roboxim_eval.experiments.card import ARGUMENTS, Card, CardTraining, CardVerdict, final_counts, parse_card, sealed
from roboxim_eval.experiments.combinations import TransferCurve, name_of, transfer_curve
from roboxim_eval.experiments.design import Design, design_of
from roboxim_eval.experiments.fresh import public_warnings, require_committed
from roboxim_eval.statistics.paired import Pairs
from roboxim_eval.statistics.replicates import ConditionDifference, Interval

DERIVED = ("scores", "verdicts", "warnings", "sha256")
"""Parts of a card that follow from the others."""


def outcomes_of_card(card: Card) -> Outcomes:
    """Return the outcomes of a card's final evaluations.

    Raises:
        ConfigError: When a replicate is missing or appears twice.
        InvalidRequestError: When counts are impossible.
    """
    counts = final_counts(card.evaluations)
    for condition in counts:
        numbers = [row.replicate for row in card.evaluations if row.condition == condition and not row.checkpoint]
        if sorted(numbers) != list(range(len(numbers))):
            raise ConfigError(
                f"evaluations of condition '{condition}' must be of the replicates 0, 1, ...; got {numbers}"
            )
    pairs = {
        int(number): [Pairs(both=a, first=b, second=c, neither=d) for a, b, c, d in rows]
        for number, rows in card.pairs.items()
    }
    failed = None if card.judged_again is None else [(row.cell, row.satisfied) for row in card.judged_again]
    return Outcomes(counts=counts, pairs=pairs, failed=failed, intervals=card.intervals)


def design_of_card(card: Card) -> Design:
    """Return the experiment of a card, expanded."""
    return design_of(card.experiment.config, card.experiment.trainer)


def concluded(card: Card, design: Design | None = None) -> Card:
    """Return a card with the scores, verdicts, warnings and hash that follow from its other parts.

    Args:
        card: The card.
        design: Its experiment, expanded; none: it is expanded here.

    Raises:
        ConfigError: When counts of a condition or a cell are missing.
        InvalidRequestError: When counts are impossible, or conditions have different numbers of replicates.
    """
    analysis = analyse(design or design_of_card(card), outcomes_of_card(card))
    return sealed(replace(
        card,
        scores=plain_scores(analysis),
        verdicts=tuple(_verdict(c, c.config.primary or len(analysis.comparisons) == 1) for c in analysis.comparisons),
        warnings=(
            *analysis.warnings, *public_warnings(card), *attestation_warnings(card.trainings),
            *proof_warnings(card.proofs), *card.statements,
        ),
    ))  # fmt: skip


def analysis_of(card: Card) -> Analysis:
    """Return the analysis of a card's counts."""
    return analyse(design_of_card(card), outcomes_of_card(card))


def card_curve(card: Card) -> TransferCurve | None:
    """Return transfer as a curve, from a card's counts; none: its experiment has no combinations."""
    config = card.experiment.config
    if config.combinations is None:
        return None
    largest = name_of(config.combinations.seen[-1])
    kinds = {
        one.first: one.kind for one in card.verdicts
        if (one.second, one.where, one.question) == (largest, "unseen", "condition") and one.against in ("", one.where)
    }  # fmt: skip
    return transfer_curve(config, config.combinations, outcomes_of_card(card).arms, kinds)


def check_card(data: Any, *, source: str = "card") -> Card:
    """Recompute a card's scores and sentences from its counts, and refuse a card with others.

    Raises:
        ConfigError: When the data is no card of this schema, or was changed; names the first part that differs.
    """
    card = parse_card(data, source=source)
    try:
        again = concluded(card).plain
    except RoboximError as error:
        raise ConfigError(f"{source}: {error}") from error
    except (
        LookupError,
        ArithmeticError,
        TypeError,
        ValueError,
    ) as error:  # a part refers to entries that the others lack
        raise ConfigError(f"{source}: its parts contradict each other ({error!r}); it was changed") from None
    require_committed(card, source)
    for part in DERIVED:
        if again[part] != data.get(part):
            raise ConfigError(f"{source}: its {part} do not follow from its counts; it was changed")
    return card


def plain_scores(analysis: Analysis) -> dict[str, Any] | None:
    """Return the scores as plain data: values with the bounds of their 95 % intervals; None: the file has none."""
    found = analysis.scores
    if found is None:
        return None
    ratio, substitution = found.relative.ratio, found.substitution
    return {
        "absolute": plain_interval(found.absolute),
        "baseline": plain_interval(found.baseline),
        "gap": _difference(found.gap),
        "relative": None if ratio is None else plain_interval(ratio),
        "relative_refused": found.relative.refused,
        "words": _difference(found.words),
        "competence": _difference(found.competence),
        "substitution": None if substitution is None else {
            "rate": [round(x, 6) for x in (substitution.rate.rate, substitution.rate.low, substitution.rate.high)],
            "failed": substitution.rate.episodes, "worst": substitution.worst,
        },
    }  # fmt: skip


def _difference(difference: ConditionDifference | None) -> list[float | None] | None:
    return None if difference is None else plain_interval(difference.interval())


def plain_interval(interval: Interval) -> list[float | None]:
    """Return value, lower and upper bound; None: unbounded."""
    return [round(x, 6) if math.isfinite(x) else None for x in (interval.value, interval.low, interval.high)]


def _verdict(comparison: Comparison, primary: bool) -> CardVerdict:
    config, verdict = comparison.config, comparison.verdict
    value, low, high = plain_interval(verdict.difference)
    return CardVerdict(
        first=config.first, second=config.second, where=config.where, against=config.against, primary=primary,
        kind=verdict.kind, question=verdict.question, p=round(verdict.p_value, 6), difference=(value, low, high),
        sentence=verdict.sentence,
    )  # fmt: skip


# ------------------------------------------------------------------ warnings


def attestation_warnings(trainings: Iterable[CardTraining]) -> Iterable[str]:
    """Yield a sentence for missing statements, each difference of the recipes, and exposure to held-out pairs."""
    trainings = tuple(trainings)
    if unstated := sorted({t.condition for t in trainings if not t.attest.recipe}):
        yield f"The recipe of {' and '.join(unstated)} is not stated, so more than the dataset may differ."
    by_condition: dict[str, CardTraining] = {}
    for training in trainings:
        first = by_condition.setdefault(training.condition, training)
        if training.attest.recipe != first.attest.recipe:
            yield (
                f"Trainings of {training.condition} have different recipes: replicate {training.replicate} differs "
                f"from {first.replicate} in {_differing(first, training)}."
            )
    own = {name: training.attest.recipe.get(ARGUMENTS) for name, training in by_condition.items()}
    if len(set(map(str, own.values()))) > 1:
        differences = "; ".join(f"{name}: {text}" for name, text in own.items())
        yield f"Conditions differ in the arguments of their trainings, not in the dataset alone ({differences})."
    names = list(by_condition)
    for name in names[1:]:
        one, two = by_condition[names[0]], by_condition[name]
        if differences := _differing(one, two, without=ARGUMENTS):
            yield f"Recipes of {one.condition} and {two.condition} differ in more than the dataset: {differences}."
        if one.attest.pretraining != two.attest.pretraining:
            yield (
                f"{one.condition} and {two.condition} started from different weights: "
                f"'{one.attest.pretraining or 'not said'}' and '{two.attest.pretraining or 'not said'}'."
            )
    exposed = sorted({t.condition for t in trainings if t.attest.exposure == "yes"})
    if exposed:
        yield f"The pre-training of {' and '.join(exposed)} contained held-out combinations, so they were not unseen."
    unknown = sorted({t.condition for t in trainings if t.attest.exposure == "unknown"})
    if unknown:
        yield f"It is not known whether the pre-training of {' and '.join(unknown)} contained held-out combinations."


def _differing(one: CardTraining, two: CardTraining, *, without: str = "") -> str:
    """Return the recipe's keys that differ, with both values, e.g. ``steps 4000 and 2000``; empty: none."""
    first, second = to_plain(one.attest.recipe), to_plain(two.attest.recipe)
    return ", ".join(
        f"{key} {first.get(key, 'not said')} and {second.get(key, 'not said')}"
        for key in dict.fromkeys((*first, *second))
        if first.get(key) != second.get(key) and key != without
    )


def proof_warnings(proofs: Mapping[str, tuple[int, int]]) -> Iterable[str]:
    """Yield a sentence for each proof of delivery that episodes failed."""
    for check, (passed, checked) in proofs.items():
        if passed < checked:
            yield f"Delivery is not proved for {checked - passed} of {checked} episodes: {check}."
