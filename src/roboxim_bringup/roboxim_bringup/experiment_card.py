"""The card of an experiment: counts by cell, pairs, scores and verdicts as plain data, with a hash.

All scores and sentences follow from the counts and pairs, so that `check_card` recomputes them without any bag.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from roboxim_bringup.runs.folder import RunFolder
from roboxim_core.config import digest, from_plain, to_plain
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError
from roboxim_core.seeds import CELL, CELL_NUMBER
from roboxim_eval.experiments import Analysis, Design, ExperimentConfig, Outcomes, analyse, chosen, design_of, stages_of
from roboxim_eval.statistics.paired import Pairs
from roboxim_eval.statistics.replicates import ConditionDifference, Interval
from roboxim_eval.statistics.tables import Count
from roboxim_tasks.config import TaskMix, task_mix

SCHEMA = 1


@dataclass(frozen=True, kw_only=True)
class Card:
    """An experiment's card."""

    data: Mapping[str, Any]
    """Plain data, the content of ``card.json``."""

    @property
    def sentences(self) -> tuple[str, ...]:
        """A sentence for each comparison, the primary one first, then the warnings."""
        return tuple(self.data["sentences"])


def outcomes_of(design: Design, folder: Path) -> Outcomes:
    """Return the outcomes of an experiment's final evaluations.

    Args:
        design: The experiment.
        folder: Folder with a subfolder ``CONDITION.REPLICATE`` for each evaluation.

    Raises:
        ConfigError: When an evaluation is not finished, or its results are damaged.
    """
    mixes = {s.name.removeprefix("evaluate/"): s.inputs["mix"] for s in stages_of(design) if s.kind == "evaluate"}
    found: dict[tuple[str, int], dict[tuple[str, int], EpisodeResult]] = {}
    for evaluation in design.evaluations:
        if evaluation.checkpoint:
            continue
        name = f"{evaluation.condition}.{evaluation.replicate}"
        results = RunFolder(folder / name / evaluation.condition).results()
        by_scene = _by_scene(_task_mix(json.dumps(mixes[name])), results)
        if len(by_scene) != evaluation.rollouts:
            raise ConfigError(f"{folder / name} has {len(by_scene)} of {evaluation.rollouts} rollouts; run it again")
        found[evaluation.condition, evaluation.replicate] = by_scene
    replicates = range(design.config.replicates.count)
    counts = {
        condition: [_counts(found[condition, replicate]) for replicate in replicates]
        for condition in design.config.conditions
    }
    pairs = {
        number: [
            _pairs(found[compare.first, r], found[compare.second, r], _keys(design, compare.where)) for r in replicates
        ]
        for number, compare in enumerate(design.config.compare)
        if not compare.against
    }
    return Outcomes(counts=counts, pairs=pairs)


def _keys(design: Design, where: str) -> set[str]:
    return {cell.key for cell in chosen(design.cells, where)}


@lru_cache(maxsize=16)
def _task_mix(text: str) -> TaskMix:
    """Return the task mix of a JSON text; replicates and conditions share theirs."""
    return task_mix(json.loads(text))


def _by_scene(mix: TaskMix, results: Sequence[EpisodeResult]) -> dict[tuple[str, int], EpisodeResult]:
    """Return results by cell and number in the cell, which name a scene within a replicate."""
    found = {}
    for result in results:
        drawn = mix.drawn(result.index)
        found[drawn[CELL], int(drawn[CELL_NUMBER])] = result
    return found


def _counts(results: Mapping[tuple[str, int], EpisodeResult]) -> dict[str, Count]:
    counts: dict[str, list[EpisodeResult]] = {}
    for (cell, _), result in results.items():
        counts.setdefault(cell, []).append(result)
    return {
        cell: Count(
            successes=sum(r.outcome == "success" for r in mine), episodes=len(mine),
            errors=sum(r.outcome == "error" for r in mine),
        )
        for cell, mine in counts.items()
    }  # fmt: skip


def _pairs(
    first: Mapping[tuple[str, int], EpisodeResult], second: Mapping[tuple[str, int], EpisodeResult], cells: set[str]
) -> Pairs:
    shared = [scene for scene in first if scene in second and scene[0] in cells]
    return Pairs.of((first[s].outcome == "success", second[s].outcome == "success") for s in shared)


def card_of(name: str, scale: str, design: Design, outcomes: Outcomes) -> Card:
    """Return the card of an experiment's results.

    Args:
        name: Name of the experiment.
        scale: Its scale.
        design: The experiment.
        outcomes: Outcomes of its final evaluations.
    """
    analysis = analyse(design, outcomes)
    config = json.loads(json.dumps(to_plain(design.config)))
    data: dict[str, Any] = {
        "schema": SCHEMA,
        "experiment": {"name": name, "scale": scale, "thesis": design.config.thesis, "config": config},
        "deviations": list(design.config.deviations),
        "evaluations": [
            {
                "condition": condition,
                "replicate": replicate,
                "by_cell": {cell: [c.successes, c.episodes, c.errors] for cell, c in sorted(counts.items())},
            }
            for condition, rows in outcomes.counts.items()
            for replicate, counts in enumerate(rows)
        ],
        "pairs": {
            str(number): [[p.both, p.first, p.second, p.neither] for p in rows]
            for number, rows in outcomes.pairs.items()
        },
        "scores": _scores(analysis),
        "verdicts": [
            {
                "first": c.config.first, "second": c.config.second, "where": c.config.where,
                "against": c.config.against, "kind": c.verdict.kind, "question": c.verdict.question,
                "p": round(c.verdict.p_value, 6), "difference": _interval(c.verdict.difference),
            }
            for c in analysis.comparisons
        ],
        "sentences": list(analysis.sentences),
    }  # fmt: skip
    return Card(data={**data, "sha256": digest(data)})


def check_card(data: Any, *, source: str = "card") -> Card:
    """Compute a card's scores and sentences again from its counts, and refuse a card that states others.

    Raises:
        ConfigError: When the data is no card of this schema, or was changed; names the first part that differs.
    """
    if not isinstance(data, Mapping) or data.get("schema") != SCHEMA:
        raise ConfigError(f"{source} is no card of schema {SCHEMA}")
    try:
        config = from_plain(data["experiment"]["config"], ExperimentConfig, source=source)
        design = design_of(config)
        counts: dict[str, list[Mapping[str, Count]]] = {}
        for row in sorted(data["evaluations"], key=lambda row: row["replicate"]):
            counts.setdefault(row["condition"], []).append(
                {c: Count(successes=s, episodes=n, errors=e) for c, (s, n, e) in row["by_cell"].items()}
            )
        pairs = {
            int(number): [Pairs(both=a, first=b, second=c, neither=d) for a, b, c, d in rows]
            for number, rows in data["pairs"].items()
        }
        name, scale = data["experiment"]["name"], data["experiment"]["scale"]
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"{source} is no card: {error!r}") from None
    again = card_of(name, scale, design, Outcomes(counts=counts, pairs=pairs))
    plain = json.loads(json.dumps(again.data))
    for part in ("scores", "verdicts", "sentences", "sha256"):
        if plain[part] != data.get(part):
            raise ConfigError(f"{source}: its {part} do not follow from its counts; it was changed")
    return again


def _scores(analysis: Analysis) -> dict[str, Any] | None:
    found = analysis.scores
    if found is None:
        return None
    ratio = found.relative.ratio
    return {
        "absolute": _interval(found.absolute),
        "baseline": _interval(found.baseline),
        "gap": _difference(found.gap),
        "relative": None if ratio is None else _interval(ratio),
        "relative_refused": found.relative.refused,
        "words": _difference(found.words),
        "competence": _difference(found.competence),
        "substitution": None if found.substitution is None else found.substitution.rate.rate,
    }


def _difference(difference: ConditionDifference | None) -> list[float | None] | None:
    return None if difference is None else _interval(difference.interval())


def _interval(interval: Interval) -> list[float | None]:
    """Return value, lower and upper bound; None: unbounded."""
    return [round(x, 6) if math.isfinite(x) else None for x in (interval.value, interval.low, interval.high)]
