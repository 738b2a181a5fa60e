"""Cards as Markdown, for READMEs, papers' supplements and documentation. All numbers are from the card alone."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

from roboxim_eval.benchmark.card import BenchmarkCard
from roboxim_eval.experiments.card import Card
from roboxim_eval.experiments.card_checks import design_of_card, outcomes_of_card
from roboxim_eval.experiments.cells import Cell
from roboxim_eval.report.benchmark import benchmark_rows
from roboxim_eval.report.experiment import provenance_of
from roboxim_eval.report.scores import score_rows
from roboxim_eval.statistics.replicates import condition_rate
from roboxim_eval.statistics.tables import Arm


def experiment_markdown(card: Card, *, warnings: Sequence[str] = ()) -> str:
    """Return sentences, scores, rates by condition and by cell, deviations and provenance of an experiment.

    Args:
        card: A card whose scores follow from its counts.
        warnings: Further limitations of its results, besides its card's warnings.

    Raises:
        ConfigError: When the card lacks counts of a condition or a cell.
    """
    return "\n".join(_experiment(card, 1, warnings)) + "\n"


def benchmark_markdown(card: BenchmarkCard, *, warnings: Mapping[str, Sequence[str]] | None = None) -> str:
    """Return the scores of a benchmark beside the published ones, then its experiments.

    Args:
        card: A card whose scores follow from its experiments.
        warnings: Experiment to further limitations of its results, besides its card's warnings.

    Raises:
        ConfigError: When an experiment's card lacks counts of a condition or a cell.
    """
    return "\n".join(_benchmark(card, warnings or {})) + "\n"


def _experiment(card: Card, level: int, warnings: Sequence[str]) -> Iterator[str]:
    config, design = card.experiment.config, design_of_card(card)
    arms = outcomes_of_card(card).arms
    yield f"{'#' * level} {card.experiment.name}, scale {card.experiment.scale}\n"
    yield f"{config.about}\n"
    yield from (f"- **{one.sentence}**" if one.primary else f"- {one.sentence}" for one in card.verdicts)
    yield from (f"- Warning: {warning}" for warning in (*card.warnings, *warnings))
    if card.scores:
        yield "\n" + _table(
            ("score", "value", "95 % interval"), ((r["name"], r["value"], r["interval"]) for r in score_rows(card))
        )
    head = ("condition", "success, mean of cells", "each training", "rollouts")
    yield "\n" + _table(head, map(_rate, arms, arms.values()))
    yield "\n" + _by_cell(design.cells, arms)
    if card.experiment.deviations:
        yield "\nDeviations:\n"
        yield from (f"- {sentence}" for sentence in card.experiment.deviations)
    yield "\n" + _provenance(provenance_of(card))


def _benchmark(card: BenchmarkCard, warnings: Mapping[str, Sequence[str]]) -> Iterator[str]:
    yield f"# {card.name}, scale {card.scale}\n"
    yield f"{card.about}\n"
    yield from (f"- {sentence}" for sentence in card.sentences)
    reference = card.reference
    scores = ("absolute, u", "baseline, s", "gap, s - u", "relative, u / s")
    head = ("dimension or experiment", *scores, "published absolute", "published relative")
    rows = [
        (row.name, row.absolute_text, row.baseline_text, row.gap_text, row.relative_text, *row.published_texts)
        for row in benchmark_rows(card)
    ]
    width = len(head) if reference else 1 + len(scores)
    yield "\n" + _table(head[:width], (row[:width] for row in rows))
    if reference:
        yield f"\nPublished: {reference.name}.\n"
        yield from (f"- {sentence}" for sentence in reference.differences)
    for name, one in card.experiments.items():
        yield ""
        yield from _experiment(one, 2, warnings.get(name, ()))
    yield f"\nHash of the benchmark's card: `{card.sha256}`."


def _rate(name: str, arm: Arm) -> tuple[str, ...]:
    rate, pooled = condition_rate(arm), arm.pooled
    each = ", ".join(f"{100 * value:.0f} %" for value in arm.rates)
    mean = f"{100 * rate.value:.0f} % ({100 * rate.low:.0f} to {100 * rate.high:.0f} %)"
    return name, mean, each, f"{pooled.successes} of {pooled.episodes}"


def _by_cell(cells: Sequence[Cell], arms: Mapping[str, Arm]) -> str:
    """Return the counts of the evaluated cells; the longer dimension forms the rows, so that the table stays narrow."""
    names = [f"**{cell.key}**" if cell.unseen else cell.key for cell in cells]
    counts = [tuple(_count(arm, cell.key) for arm in arms.values()) for cell in cells]
    rows = [(name, *row) for name, row in zip(names, counts, strict=True) if set(row) != {"-"}]
    heading = "cell, **held out**" if any(cell.unseen for cell in cells) else "cell"
    head, table = (heading, *arms), [*rows]
    if len(arms) > len(rows):
        head, *table = zip(head, *rows, strict=True)
    return _table(head, table)


def _count(arm: Arm, cell: str) -> str:
    found = arm.by_cell.get(cell)
    return f"{found.successes} of {found.episodes}" if found and found.episodes else "-"


def _provenance(facts: Mapping[str, str]) -> str:
    return "; ".join(f"{name} {value}" for name, value in facts.items() if value != "-") + "."


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', '/') for cell in line)} |" for line in lines)
