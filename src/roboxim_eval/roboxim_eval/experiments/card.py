"""The card of an experiment, the content of ``card.json``: counts, where they come from, and what follows from them.

Scores, verdicts and sentences follow from ``evaluations``, ``pairs`` and ``judged_again`` alone, so that
`roboxim_eval.experiments.card_checks` computes them again without any bag. ``sha256`` covers everything but ``times``:
interrupting and continuing an experiment does not change it.

Counts come from results, hashes from the run's folder, `proofs` from the bags, and `judged_again` from bags that were
judged by the other instructions of the training.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

from roboxim_core.config import from_plain, to_plain
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.limits import echo
from roboxim_eval.experiments.config import ExperimentConfig
from roboxim_eval.statistics.beside import Beside
from roboxim_eval.statistics.tables import Count, Intervals

SCHEMA = 4
"""Version of the form of new cards."""
INTERVALS: dict[int, Intervals] = {2: "student", 3: "beta_binomial", 4: "beta_binomial_differences"}
"""Version of a card's form to the method of its intervals. A published card keeps its own."""
KNOWN = ", ".join(map(str, range(min(INTERVALS), SCHEMA))) + f" or {SCHEMA}"
EXPOSURES = ("no", "yes", "unknown")
NOT_HASHED = ("sha256", "times")


@dataclass(frozen=True, kw_only=True)
class CardExperiment:
    """The experiment."""

    name: str
    """Name of its file."""
    scale: str
    """Scale at which it ran."""
    thesis: str = ""
    """Section of the thesis that the shipped experiments follow (see the glossary); empty: none."""
    sha256: str = ""
    """Hash of the configuration at this scale."""
    trainer: str = ""
    """Trainer of the file; empty: its first one."""
    deviations: tuple[str, ...] = ()
    """What differs from the thesis, a sentence each."""
    config: ExperimentConfig
    """The configuration at this scale."""


@dataclass(frozen=True, kw_only=True)
class CardCode:
    """Code that a stage ran with."""

    version: str = ""
    """Version of RoboXim."""
    commit: str = ""
    """Commit; empty: not run from a repository."""
    dirty: bool = False
    """Whether files differed from the commit."""

    @property
    def words(self) -> str:
        """The version of the code in words, e.g. ``0.1.0 at b29ef5141170``."""
        at = f" at {self.commit[:12]}" if self.commit else ""
        return f"{self.version}{at}{' with uncommitted changes' if self.dirty else ''}"


@dataclass(frozen=True, kw_only=True)
class CardEnvironment:
    """The machine and its software."""

    packages_sha256: str = ""
    """Hash of the names and versions of all installed packages."""
    renderer: str = ""
    """Renderer of the evaluations' images."""
    device: str = ""
    """Processor and GPUs of the machine that started the last evaluation; a statement names other stages' machines."""


@dataclass(frozen=True, kw_only=True)
class CardDataset:
    """A dataset of demonstrations."""

    sha256: str = ""
    """Hash of its files."""
    by_cell: dict[str, int] = field(default_factory=dict)
    """Cell to number of demonstrations, as exported."""
    fault: str = ""
    """Planted data fault; empty: none."""
    faulty: int = 0
    """Number of demonstrations with the planted fault."""


ARGUMENTS = "arguments"
"""Key of a recipe with a condition's additions to its trainer's command."""


@dataclass(frozen=True, kw_only=True)
class Attestation:
    """Statements about a training that its data do not show."""

    recipe: dict[str, Any] = field(default_factory=dict)
    """Everything besides the dataset and the seed that the result depends on, e.g. model, steps, learning rate."""
    dataset_sha256: str = ""
    """Hash of the dataset that was trained with, as the card states it; empty: not stated."""
    pretraining: str = ""
    """Weights that the training started from, e.g. ``octo-small-1.5``; ``none``: random ones; empty: not stated."""
    exposure: str = "unknown"
    """Whether the pre-training contained held-out combinations: ``no``, ``yes`` or ``unknown``."""

    def __post_init__(self) -> None:
        """Check the exposure.

        Raises:
            ConfigError: When it is none of the three words.
        """
        if self.exposure not in EXPOSURES:
            raise ConfigError(f"exposure: unknown '{self.exposure}'; {one_of(EXPOSURES, self.exposure)}")


@dataclass(frozen=True, kw_only=True)
class CardTraining:
    """A training."""

    condition: str
    """Its condition."""
    replicate: int
    """Number of the replicate, from 0."""
    dataset: str
    """Key of its dataset in ``datasets``; empty: unknown."""
    recipe_sha256: str = ""
    """Hash of the attested recipe."""
    checkpoint_sha256: str = ""
    """Hash of the checkpoint's files; empty: the policy is not a file here."""
    steps: int = 0
    """Training steps; 0: unknown."""
    seed: int = 0
    """Seed of the training."""
    attest: Attestation = Attestation()
    """Statements about it."""


@dataclass(frozen=True, kw_only=True)
class CardEvaluation:
    """Rollouts of one policy."""

    LEFT_OUT_AT_DEFAULT: ClassVar[tuple[str, ...]] = ("beside",)
    """Later fields, see `roboxim_core.config.LEFT_OUT`: cards without them keep their hashes."""

    condition: str
    """Its condition."""
    replicate: int
    """Number of the replicate, from 0."""
    checkpoint: int = 0
    """Training steps of a checkpoint on the learning curve; 0: the final one."""
    seed: int = 0
    """Seed of the scenes; evaluations of a replicate share it."""
    results_sha256: str = ""
    """Hash of the results without wall times."""
    by_cell: dict[str, tuple[int, int, int]]
    """Cell to numbers of successes, episodes and errors."""
    beside: Beside | None = None
    """Force, speed, path and other measures beside success, and crossed limits; null: no task has ``limits``."""

    @property
    def counts(self) -> dict[str, Count]:
        """The outcomes by cell."""
        return {cell: Count(successes=s, episodes=n, errors=e) for cell, (s, n, e) in self.by_cell.items()}


@dataclass(frozen=True, kw_only=True)
class CardFresh:
    """Fresh scenes: those of a seed that was drawn for this run, see `roboxim_eval.experiments.fresh`."""

    seed: int
    """Seed of the first replicate's scenes."""
    nonce: str
    """Random text that was hashed with the seed, so that the hash does not reveal the seed."""
    commitment: str
    """Hash of nonce and seed, which could be published before the seed was used."""
    trained_before: int = 0
    """Trainings of this run that were finished before the seed was drawn."""
    public_card_sha256: str = ""
    """Hash of the card of the same policies in the public scenes; empty: they were not evaluated there."""
    public: tuple[CardEvaluation, ...] = ()
    """Final evaluations of that card."""


@dataclass(frozen=True, kw_only=True)
class JudgedAgain:
    """A failed held-out episode, judged by the instructions of the training."""

    cell: str
    """Its cell."""
    satisfied: tuple[str, ...] = ()
    """Cells of the training whose instruction it satisfies; empty: none."""


@dataclass(frozen=True, kw_only=True)
class CardVerdict:
    """A comparison with its verdict."""

    first: str
    """Condition."""
    second: str
    """Condition that it is compared with."""
    where: str
    """Cells of the first condition."""
    against: str = ""
    """Cells of the second one; empty: the same."""
    primary: bool = False
    """Whether the experiment was designed for it."""
    kind: str
    """``lower``, ``higher``, ``as_good`` or ``cannot_tell``."""
    question: str
    """``checkpoint`` (Q1) or ``condition`` (Q2)."""
    p: float
    """p value, adjusted for all comparisons of the file (Holm)."""
    difference: tuple[float | None, float | None, float | None]
    """Difference of the success rates with its 95 % interval; null: unbounded."""
    sentence: str
    """The verdict in words."""


@dataclass(frozen=True, kw_only=True)
class Card:
    """Results of an experiment."""

    LEFT_OUT_AT_DEFAULT: ClassVar[tuple[str, ...]] = ("fresh",)
    """Later fields, see `roboxim_core.config.LEFT_OUT`: cards without them keep their hashes."""

    schema: int = SCHEMA
    """Version of this form; it decides the method of the intervals: 2 Student's t, 3 beta-binomial success rates, 4
    beta-binomial differences too, and Tango's score interval of two checkpoints."""
    experiment: CardExperiment
    """The experiment."""
    code: CardCode = CardCode()
    """Code of the last evaluation; a statement names that of other stages."""
    environment: CardEnvironment = CardEnvironment()
    """The machine and its software."""
    datasets: dict[str, CardDataset] = field(default_factory=dict)
    """``NAME.GENERATION`` to dataset."""
    trainings: tuple[CardTraining, ...] = ()
    """All trainings."""
    evaluations: tuple[CardEvaluation, ...]
    """All evaluations, those of learning curves included."""
    fresh: CardFresh | None = None
    """Fresh scenes; null: the final evaluations have the public ones, or those of a seed in the file."""
    pairs: dict[str, tuple[tuple[int, int, int, int], ...]] = field(default_factory=dict)
    """Number of a comparison to, for each replicate, the scenes that both, the first alone, the second alone and
    neither solved."""
    judged_again: tuple[JudgedAgain, ...] | None = None
    """Failed held-out episodes of the primary comparison's first condition; null: not judged again."""
    proofs: dict[str, tuple[int, int]] = field(default_factory=dict)
    """Proof of delivery to the numbers of episodes that passed and that were checked."""
    statements: tuple[str, ...] = ()
    """What proofs say beside passed and failed, e.g. that held-out objects were distractors of the training."""
    scores: dict[str, Any] | None = None
    """Scores of the held-out cells; null: the experiment has none."""
    verdicts: tuple[CardVerdict, ...] = ()
    """Comparisons with their verdicts, the primary one first."""
    warnings: tuple[str, ...] = ()
    """What weakens the results, in sentences."""
    times: dict[str, float] = field(default_factory=dict)
    """Stage to wall time [s]; not part of the hash."""
    sha256: str = ""
    """Hash of the canonical JSON of all other keys but ``times``."""

    @property
    def sentences(self) -> tuple[str, ...]:
        """A sentence for each comparison, the primary one first, then the warnings."""
        return (*(verdict.sentence for verdict in self.verdicts), *self.warnings)

    @property
    def intervals(self) -> Intervals:
        """Method of the intervals.

        Raises:
            ConfigError: When the schema is unknown.
        """
        if self.schema not in INTERVALS:
            raise ConfigError(f"unknown schema {self.schema} of a card; expected {KNOWN}")
        return INTERVALS[self.schema]

    @property
    def plain(self) -> dict[str, Any]:
        """The card as plain data."""
        data: dict[str, Any] = json.loads(json.dumps(to_plain(self)))
        return data


def final_counts(evaluations: Iterable[CardEvaluation]) -> dict[str, list[Mapping[str, Count]]]:
    """Return the outcomes of the final evaluations by condition, in the order of their replicates."""
    found: dict[str, list[Mapping[str, Count]]] = {}
    for row in sorted(evaluations, key=lambda row: row.replicate):
        if not row.checkpoint:
            found.setdefault(row.condition, []).append(row.counts)
    return found


def sha256_of(value: Any) -> str:
    """Return the SHA-256 of plain data's canonical JSON: sorted keys, no spaces, UTF-8."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def sealed(card: Card) -> Card:
    """Return a card with its hash."""
    content = {key: value for key, value in card.plain.items() if key not in NOT_HASHED}
    return replace(card, sha256=sha256_of(content))


def is_card(data: Any) -> bool:
    """Return whether plain data states that it is a card of a known schema."""
    return isinstance(data, dict) and data.get("schema") in INTERVALS


def parse_card(data: Any, *, source: str = "card") -> Card:
    """Return the card of plain data; its numbers are not checked, see `roboxim_eval.experiments.card_checks`.

    Raises:
        ConfigError: When the data is no card of this schema.
    """
    if not is_card(data):
        found = data.get("schema") if isinstance(data, dict) else None
        again = "run 'experiment report DIR' again"
        if found is None:
            raise ConfigError(f"{source} is no card of an experiment; give the card.json that 'experiment run' wrote")
        if str(found).startswith("benchmark-"):
            again = "of a benchmark's card, use 'benchmark report --from', or the card of one of its experiments"
        raise ConfigError(f"{source} is no card of schema {KNOWN}, found {echo(found)}; {again}")
    card: Card = from_plain(data, Card, source=source)
    return card
