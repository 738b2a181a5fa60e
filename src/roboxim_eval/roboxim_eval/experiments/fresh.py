"""Fresh scenes: evaluation scenes on which a policy cannot have been tuned.

The seeds of an experiment's scenes are public, like its file, so policies can be tuned on these scenes. A fresh seed is
drawn for one run. Its commitment, a hash, can be published before the trainings without revealing the seed. The card
then names the seed, and anyone can check that it matches the commitment: it was not chosen among several after their
results were seen.

If the same policies were also evaluated in the public scenes, the card warns of those that are better there.
"""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from roboxim_core.errors import ConfigError
from roboxim_eval.experiments.card import Card, CardEvaluation, CardFresh, final_counts
from roboxim_eval.experiments.config import MAX_SEED, MIN_SEED
from roboxim_eval.statistics.multiple import holm
from roboxim_eval.statistics.paired import Difference, independent_difference
from roboxim_eval.statistics.rates import SuccessRate
from roboxim_eval.statistics.replicates import pooled_rate
from roboxim_eval.statistics.tables import Arm


@dataclass(frozen=True, kw_only=True)
class SceneSeed:
    """Seed of fresh scenes."""

    seed: int
    """Seed of the first replicate's scenes; the next replicates have the following ones."""
    nonce: str
    """Random text, 32 hexadecimal digits."""

    def __post_init__(self) -> None:
        """Check both.

        Raises:
            ConfigError: When one is out of range.
        """
        if not MIN_SEED <= self.seed <= MAX_SEED or len(self.nonce) < 32:
            raise ConfigError(
                f"a seed of fresh scenes is from {MIN_SEED} to {MAX_SEED}, with a nonce of at least 32 characters; "
                f"got {self.seed} and {len(self.nonce)} characters"
            )

    @property
    def commitment(self) -> str:
        """SHA-256 of ``NONCE SEED``, the nonce and the decimal seed with a space between them."""
        return hashlib.sha256(f"{self.nonce} {self.seed}".encode()).hexdigest()

    @staticmethod
    def drawn() -> SceneSeed:
        """Draw a seed from the system's entropy: the only seed of an experiment that is not an argument."""
        return SceneSeed(seed=MIN_SEED + secrets.randbelow(MAX_SEED - MIN_SEED), nonce=secrets.token_hex(16))


def require_committed(card: Card, source: str) -> None:
    """Check that a card's scenes are those of the seed that it names, and that its commitment is that seed's.

    Raises:
        ConfigError: When it names another one.
    """
    fresh = card.fresh
    if fresh is None:
        return
    found = SceneSeed(seed=fresh.seed, nonce=fresh.nonce).commitment
    if found != fresh.commitment:
        raise ConfigError(f"{source}: its seed {fresh.seed} is not the one of commitment {fresh.commitment}")
    first = fresh.seed + card.experiment.config.replicates.first_seed
    odd = [one for one in card.evaluations if not one.checkpoint and one.seed != first + one.replicate]
    if odd or card.experiment.config.evaluate.seed != fresh.seed:
        raise ConfigError(f"{source}: not all of its scenes are those of its fresh seed {fresh.seed}; it was changed")


def committed_text(card: Card) -> str:
    """Return where a card's scenes come from, in words; empty: from the public seed."""
    fresh, seed = card.fresh, card.experiment.config.evaluate.seed
    if fresh is None:
        return f"seed {seed}, which the run was given" if seed else ""
    trainings = len(card.trainings)
    when = f"after {fresh.trained_before} of {trainings} trainings were finished"
    if any(not training.checkpoint_sha256 for training in card.trainings):
        when = "before or after the trainings, which is unknown because some took place elsewhere"
    elif not fresh.trained_before:
        when = f"before all {trainings} trainings" if trainings else "before the evaluations"
    return (
        f"fresh, of seed {fresh.seed}, drawn {when}; the commitment {fresh.commitment} is the SHA-256 of "
        f"'{fresh.nonce} {fresh.seed}'"
    )


@dataclass(frozen=True, kw_only=True)
class PublicAdvantage:
    """Success of a condition's policies in the public scenes, minus that in fresh ones."""

    condition: str
    """The condition."""
    rates: tuple[SuccessRate, SuccessRate]
    """Success rates in the public scenes and in fresh ones."""
    difference: Difference
    """Public minus fresh."""
    p: float
    """Two-sided p value, adjusted for all conditions (Holm)."""

    @property
    def significant(self) -> bool:
        """Whether the policies are better in the public scenes."""
        return self.difference.value > 0 and self.p <= 0.05


def public_advantages(card: Card) -> tuple[PublicAdvantage, ...]:
    """Compare a card's policies in the public scenes with the same policies in fresh ones.

    The comparison is about these policies, so their rollouts are the sample: Boschloo's test on the cells that both
    evaluations met. Rollouts in several cells vary less than the test assumes; it errs on the safe side.

    Returns:
        A comparison for each condition; none where a card has no results in the public scenes.
    """
    if card.fresh is None or not card.fresh.public:
        return ()
    fresh, public = _arms(card.evaluations), _arms(card.fresh.public)
    found: dict[str, tuple[tuple[SuccessRate, SuccessRate], Difference]] = {}
    for condition in fresh:
        if condition in public:
            cells = [cell for cell in fresh[condition].cells if cell in public[condition].cells]
            if cells:
                rates = (pooled_rate(public[condition].within(cells)), pooled_rate(fresh[condition].within(cells)))
                found[condition] = (rates, independent_difference(*rates))
    adjusted = holm([difference.p_value for _, difference in found.values()])
    return tuple(
        PublicAdvantage(condition=name, rates=rates, difference=difference, p=p)
        for (name, (rates, difference)), p in zip(found.items(), adjusted, strict=True)
    )


def _arms(rows: tuple[CardEvaluation, ...]) -> Mapping[str, Arm]:
    return {name: Arm(replicates=tuple(found)) for name, found in final_counts(rows).items()}


def public_warnings(card: Card) -> Iterator[str]:
    """Yield a sentence for each condition whose policies are better in the public scenes than in fresh ones."""
    for one in public_advantages(card):
        if one.significant:
            public, fresh = one.rates
            low, high = 100 * one.difference.low, 100 * one.difference.high
            yield (
                f"{one.condition} is better in the public scenes than in fresh ones: {100 * public.rate:.0f} % against "
                f"{100 * fresh.rate:.0f} %, by {100 * one.difference.value:.0f} points ({low:.0f} to {high:.0f}; p "
                f"{one.p:.2g} after adjustment). It may have been tuned on the public scenes; its results there are "
                "not to be relied on."
            )


def public_text(card: Card) -> str:
    """Return the success in the public scenes minus that in fresh ones, in words; empty: it was not measured."""
    return "; ".join(
        f"{one.condition} {value:+d} points ({low:+d} to {high:+d})"
        for one in public_advantages(card)
        for value, low, high in [
            [round(100 * x) + 0 for x in (one.difference.value, one.difference.low, one.difference.high)]
        ]
    )


def fresh_part(seed: SceneSeed, trained_before: int, public: Card | None) -> CardFresh:
    """Return what a card says about its fresh scenes.

    Args:
        seed: The seed.
        trained_before: Trainings that were finished before it was drawn.
        public: Card of the same policies in the public scenes; none: they were not evaluated there.
    """
    return CardFresh(
        seed=seed.seed, nonce=seed.nonce, commitment=seed.commitment, trained_before=trained_before,
        public_card_sha256=public.sha256 if public is not None else "",
        public=tuple(row for row in public.evaluations if not row.checkpoint) if public is not None else (),
    )  # fmt: skip
