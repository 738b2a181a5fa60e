"""The report of an experiment: its card in sentences and pictures, and the episodes behind each number.

Everything except episodes, films, maps and factors comes from the card alone, so a card without its folder also has a
page.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import PurePath
from typing import Any

from roboxim_eval.experiments.card import Card, CardVerdict
from roboxim_eval.experiments.card_checks import card_curve, design_of_card, outcomes_of_card
from roboxim_eval.experiments.cells import chosen
from roboxim_eval.experiments.combinations import TransferCurve, name_of
from roboxim_eval.experiments.cost import detectable_drop
from roboxim_eval.experiments.design import Design
from roboxim_eval.experiments.fresh import committed_text, public_text
from roboxim_eval.experiments.proving.proofs import PICTURES
from roboxim_eval.experiments.spread import card_pairing, spread_rows
from roboxim_eval.report.charts.curve import CurvePoint, learning_curve
from roboxim_eval.report.charts.forest import RATES, ForestRow, Scale, difference_scale
from roboxim_eval.report.charts.heat_map import HeatMap, arm_maps
from roboxim_eval.report.charts.table_map import Place
from roboxim_eval.report.course import shown
from roboxim_eval.report.episodes import (
    Episode,
    Link,
    any_of,
    checkpoint_arm,
    episodes_json,
    episodes_link,
    no_link,
)
from roboxim_eval.report.evaluation import MEASURE_NAMES
from roboxim_eval.report.films import Film
from roboxim_eval.report.page import render
from roboxim_eval.report.parts import (
    breakdowns,
    failure_rows,
    film_groups,
    films_shown,
    map_view,
    scene_patterns,
)
from roboxim_eval.report.scores import score_rows, substitutions
from roboxim_eval.report.vocabulary import vocabulary
from roboxim_eval.statistics.paired import newcombe
from roboxim_eval.statistics.rates import success_rate
from roboxim_eval.statistics.replicates import Interval, condition_rate
from roboxim_eval.statistics.tables import Arm, Count, total

MANY = 6
"""Number of comparisons from which a page lists them by verdict, with the sentences folded."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ExperimentPage:
    """Content of a page."""

    card: Card
    """The card."""
    name: str = ""
    """Name of the experiment; empty: the card's."""
    episodes: Sequence[Episode] = ()
    """Episodes of the final evaluations; empty: only the card is there, and no number has a link."""
    checkpoints: Sequence[Episode] = ()
    """Episodes of the learning curve; their arms are those of `checkpoint_arm`."""
    films: Mapping[int, Film] = field(default_factory=dict)
    """Place in `episodes` to a film."""
    place: Place | None = None
    """Positions of robot and table; none: unknown, or not the same in all episodes."""
    command: str = ""
    """Command that runs the experiment again."""
    warnings: Sequence[str] = ()
    """Limitations besides the card's warnings, e.g. that the scene alone reveals the object."""


def experiment_page(page: ExperimentPage) -> str:
    """Return the page as HTML.

    Raises:
        ConfigError: When the card lacks counts of a condition or a cell.
    """
    card, design, transfer = page.card, design_of_card(page.card), card_curve(page.card)
    arms = outcomes_of_card(card).arms
    names = list(arms)
    link: Link = episodes_link if page.episodes else no_link
    return render(
        "experiment.html",
        title=f"{page.name or card.experiment.name}, scale {card.experiment.scale}",
        card=card,
        config=card.experiment.config,
        conditions=list(arms),
        warnings=(*card.warnings, *page.warnings),
        facts=_facts(card, design),
        cells_line=_cells_line(design),
        kinds=_kinds(card),
        margin=f" within {100 * card.experiment.config.decide.margin:.0f} points",
        scores=list(score_rows(card, link)),
        spreads=list(spread_rows(card)),
        pairing=card_pairing(card),
        substitutions=substitutions(card, link),
        rates=_rates(arms, link),
        heat=heat_maps(card, design, arms, link),
        by_level=by_level(design, arms, link),
        forests=_forests(card, design, arms, link),
        emphasised=_has_primary(card),
        curve=_curve(card, link if page.checkpoints else no_link),
        curve_of_seen=_curve_is_of_seen_cells(card, design),
        beside=[
            (f"{row.condition}.{row.replicate}", row.beside)
            for row in card.evaluations
            if row.beside and not row.checkpoint
        ],
        value_of=shown,
        measure_names=MEASURE_NAMES,
        combinations=transfer,
        combinations_chart=_transfer_chart(transfer, link) if transfer else None,
        map=map_view(page.episodes, names, page.place),
        breakdowns=breakdowns(page.episodes, names, without=design.cells[0].levels),
        failures=[(name, failure_rows([e for e in page.episodes if e.arm == name], arm=name)) for name in names],
        patterns=scene_patterns(page.episodes, names),
        groups=film_groups(page.episodes, page.films, names),
        films_shown=films_shown(page.episodes, page.films),
        data=episodes_json([*page.episodes, *page.checkpoints], page.films),
        has_episodes=bool(page.episodes),
        vocabulary=[
            one
            for one in vocabulary(card.experiment.config, design.cells)
            if one.names and any(asdict(one.names).values())
        ],
        proofs=_proofs(card),
        unproved=any(passed < made for name, (passed, made) in card.proofs.items() if PICTURES not in name),
        provenance=provenance_of(card),
        command=page.command,
    )


# ------------------------------------------------------------------ numbers


def _facts(card: Card, design: Design) -> dict[str, str]:
    config = card.experiment.config
    held_out = [cell.key for cell in design.cells if cell.unseen]
    named = f": {', '.join(held_out)}" if held_out else ""
    replicates = f"{len(card.trainings)}: {config.replicates.count} of each condition"
    facts = {
        "cells": f"{len(design.cells)}, {len(held_out)} of them held out{named}",
        "demonstrations": ", ".join(f"{name} {sum(d.by_cell.values())}" for name, d in card.datasets.items())
        or ("not stated" if card.trainings else "none, the policies exist"),
        "trainings": replicates if card.trainings else "none",
        "rollouts": f"{sum(n for e in card.evaluations for _, n, _ in e.by_cell.values()):,}",
    }  # fmt: skip
    if scenes := committed_text(card):
        facts["scenes"] = scenes
    if advantage := public_text(card):
        facts["public minus fresh scenes"] = advantage
    if design.compared_scenes:
        drop, worst = detectable_drop(design), detectable_drop(design, alone=True)
        trainings = f"{config.replicates.count} training{'s' * (config.replicates.count > 1)}"
        size = f"{trainings} x {design.compared_scenes} rollouts"
        if len(config.compare) > 1:
            alone = "none" if worst is None else f"a drop to {80 - 100 * worst:.0f} %"
            size += f"; if no other comparison is found: {alone}"
        facts["what it could find"] = (
            f"too small to find any drop from 80 % in 4 of 5 such experiments ({size})" if drop is None
            else f"a drop from 80 % to {80 - 100 * drop:.0f} %, in 4 of 5 such experiments ({size})"
        )  # fmt: skip
    decide = config.decide
    facts["decided by"] = (
        f"error probability {decide.alpha:g}, margin {100 * decide.margin:.0f} points, no ratio to a baseline whose "
        f"lower bound is below {100 * decide.refuse_below:.0f} %"
    )
    return facts


def _kinds(card: Card) -> list[tuple[str, str, list[tuple[str, str]]]]:
    """Return the conditions by verdict, each with its difference, if there are too many sentences to read.

    Returns:
        Verdict, condition that all are compared with and where, and names with differences in points; empty: few
        comparisons, or with several conditions or cells.
    """
    seconds = {(verdict.second, verdict.where) for verdict in card.verdicts}
    if len(card.verdicts) < MANY or len(seconds) > 1 or any(verdict.against for verdict in card.verdicts):
        return []
    found: dict[str, list[tuple[str, str]]] = {"lower": [], "higher": [], "as_good": [], "cannot_tell": []}
    for verdict in card.verdicts:
        value = verdict.difference[0]
        found[verdict.kind].append((verdict.first, "?" if value is None else f"{100 * abs(value):.0f}"))
    ((second, where),) = seconds
    second += f" in {where} cells" if where != "all" else ""
    return [(kind, second, names) for kind, names in found.items() if names]


def _cells_line(design: Design) -> str:
    """Return an explanation of "cell" and "unseen"; empty if all cells are seen."""
    unseen = sum(cell.unseen for cell in design.cells)
    if not unseen:
        return ""
    *rest, last = (name.replace("_", " ") for name in design.cells[0].levels)
    of = f"combination of {', '.join(rest)} and {last}" if rest else f"level of {last}"
    return (
        f"A cell is a {of}. {unseen} of {len(design.cells)} {'is' if unseen == 1 else 'are'} unseen, or held out: "
        "policies that are to generalise were not trained there."
    )


def _proofs(card: Card) -> tuple[list[str], list[tuple[str, str]]]:
    """Return the proofs of delivery that all episodes passed, and the others with their counts."""
    whole = [name for name, (passed, made) in card.proofs.items() if passed == made]
    rest = [(name, f"{passed} of {made}") for name, (passed, made) in card.proofs.items() if passed < made]
    return whole, rest


def _rates(arms: Mapping[str, Arm], link: Link) -> list[tuple[str, Count, Interval, str, str]]:
    return [
        (name, arm.pooled, condition_rate(arm), link(arm=name), link(arm=name, outcome="error"))
        for name, arm in arms.items()
    ]


def by_level(design: Design, arms: Mapping[str, Arm], link: Link) -> list[dict[str, Any]]:
    """Return the rates of each condition by the levels of each factor that has at least two of them.

    Args:
        design: The experiment.
        arms: Condition to its outcomes.
        link: Makes the links of the rows.
    """
    tables = []
    for factor in design.cells[0].levels:
        cells: dict[str, list[str]] = {}
        for cell in design.cells:
            cells.setdefault(cell.levels[factor], []).append(cell.key)
        if len(cells) > 1:
            rows = [
                replace(
                    _rate_total(
                        f"{PurePath(level).stem if level.endswith('.yaml') else level}: {name}", name, outcomes, link
                    ),
                    kind="cell",
                )
                for level, keys in cells.items()
                for name, arm in arms.items()
                if (outcomes := _met(arm, keys)) is not None
            ]
            heading = f"By {factor.replace('_', ' ')}, success in %"
            tables.append({"heading": heading, "rows": rows, "scale": RATES})
    return tables


def _met(arm: Arm, cells: Collection[str]) -> Arm | None:
    """Return a condition's outcomes in those of some cells that it was evaluated in; None: a training has none."""
    keys = [key for key in cells if key in arm.cells]
    return arm.within(keys) if all(any(counts[key].episodes for key in keys) for counts in arm.replicates) else None


# ------------------------------------------------------------------ pictures


def heat_maps(card: Card, design: Design, arms: Mapping[str, Arm], link: Link) -> list[HeatMap]:
    """Return the rates of each condition by cell, and the differences of the primary comparison.

    Args:
        card: The card.
        design: The experiment.
        arms: Condition to its outcomes.
        link: Makes the links of the fields.
    """
    if len(design.cells) < 2:
        return []
    primary = card.experiment.config.primary
    pair = (primary.first, primary.second) if primary is not None and primary.first != primary.second else None
    counts = {name: arm.by_cell for name, arm in arms.items()}
    return arm_maps(design.cells, counts, pair, lambda names, cell: link(arm=any_of(names), cell=cell))


def _forests(card: Card, design: Design, arms: Mapping[str, Arm], link: Link) -> list[dict[str, Any]]:
    """Return the rows of each comparison; if none of several is the primary one, first a row for each of them."""
    forests = [_forest(verdict, design, arms, link) for verdict in card.verdicts]
    signed = [one for one in forests if one["signed"]]
    if _has_primary(card) or not signed:
        return forests
    rows = [replace(one["rows"][-1], label=one["heading"].removesuffix(", points"), kind="cell") for one in signed]
    heading = "All comparisons, points; intervals are not adjusted for their number"
    return [{"heading": heading, "rows": rows, "scale": difference_scale(rows), "signed": True}, *forests]


def _has_primary(card: Card) -> bool:
    """Return whether the file names a primary comparison, or has no other."""
    return len(card.verdicts) == 1 or any(one.primary for one in card.experiment.config.compare)


def _forest(verdict: CardVerdict, design: Design, arms: Mapping[str, Arm], link: Link) -> dict[str, Any]:
    """Return the rows of a comparison: its cells with episodes, and the total with the replicates as dots."""
    keys = [cell.key for cell in chosen(design.cells, verdict.where)]
    unseen = {cell.key for cell in design.cells if cell.unseen}
    first = arms[verdict.first].within(keys)
    where = f", {verdict.where} cells" if verdict.where != "all" else ""
    if verdict.against:
        others = [cell.key for cell in chosen(design.cells, verdict.against)]
        second = arms[verdict.second].within(others)
        rows = [*_rate_rows(verdict.first, first, unseen, link), *_rate_rows(verdict.second, second, unseen, link)]
        rows += [_rate_total(f"{verdict.first}, {verdict.where}", verdict.first, first, link)]
        rows += [_rate_total(f"{verdict.second}, {verdict.against}", verdict.second, second, link)]
        heading = (
            f"{verdict.first} in {verdict.where} cells and {verdict.second} in {verdict.against} cells, success in %"
        )
        return {"heading": heading, "rows": rows, "scale": RATES, "signed": False}
    second = arms[verdict.second].within(keys)
    both = any_of((verdict.first, verdict.second))
    rows = [
        _difference_row(key, one, two, key in unseen, link(arm=both, cell=key))
        for key in keys
        if (one := first.by_cell[key]).episodes and (two := second.by_cell[key]).episodes
    ]
    value, low, high = (math.nan if x is None else x for x in verdict.difference)
    one, two = first.pooled, second.pooled
    rows.append(ForestRow(
        label="total, mean of cells", value=value, low=-1.0 if math.isnan(low) else low,
        high=1.0 if math.isnan(high) else high, dots=tuple(float(x) for x in first.rates - second.rates),
        number=f"{one.successes} of {one.episodes} - {two.successes} of {two.episodes}", kind="total",
        link=link(arm=both, cell=any_of(keys)),
    ))  # fmt: skip
    scale: Scale = difference_scale(rows)
    heading = f"{verdict.first} - {verdict.second}{where}, points"
    return {"heading": heading, "rows": rows, "scale": scale, "signed": True}


def _difference_row(cell: str, one: Count, two: Count, unseen: bool, link: str) -> ForestRow:
    rates = success_rate(one.successes, one.episodes), success_rate(two.successes, two.episodes)
    low, high = newcombe(*rates)
    return ForestRow(
        label=cell, value=rates[0].rate - rates[1].rate, low=low, high=high, kind="unseen" if unseen else "cell",
        number=f"{one.successes} of {one.episodes} - {two.successes} of {two.episodes}", link=link,
    )  # fmt: skip


def _rate_rows(name: str, arm: Arm, unseen: set[str], link: Link) -> list[ForestRow]:
    rows = []
    for cell, count in arm.by_cell.items():
        if not count.episodes:
            continue
        rate = success_rate(count.successes, count.episodes)
        rows.append(ForestRow(
            label=f"{name}: {cell}", value=rate.rate, low=rate.low, high=rate.high,
            kind="unseen" if cell in unseen else "cell", number=f"{count.successes} of {count.episodes}",
            link=link(arm=name, cell=cell),
        ))  # fmt: skip
    return rows


def _rate_total(label: str, name: str, arm: Arm, link: Link) -> ForestRow:
    rate, count = condition_rate(arm), arm.pooled
    return ForestRow(
        label=label, value=rate.value, low=rate.low, high=rate.high, dots=tuple(float(x) for x in arm.rates),
        number=f"{count.successes} of {count.episodes}", kind="total", link=link(arm=name, cell=any_of(arm.cells)),
    )  # fmt: skip


def _curve(card: Card, link: Link) -> Any:
    """Return the learning curve; None: no checkpoint of one was evaluated."""
    points: dict[str, dict[int, list[float]]] = {}
    for row in card.evaluations:
        if row.checkpoint:
            count = total(row.counts.values())
            if count.episodes:
                rates = points.setdefault(row.condition, {}).setdefault(row.checkpoint, [])
                rates.append(count.successes / count.episodes)
    curves = {
        name: [CurvePoint(steps=steps, rates=tuple(rates)) for steps, rates in sorted(found.items())]
        for name, found in points.items()
    }
    return learning_curve(curves, lambda *point: link(arm=checkpoint_arm(*point))) if curves else None


def _curve_is_of_seen_cells(card: Card, design: Design) -> bool:
    """Return whether an experiment has held-out cells and its learning curve is of the others alone."""
    unseen = {cell.key for cell in design.cells if cell.unseen}
    return bool(unseen) and not any(unseen & row.by_cell.keys() for row in card.evaluations if row.checkpoint)


def _transfer_chart(curve: TransferCurve, link: Link) -> Any:
    points = [CurvePoint(steps=point.number, rates=point.rates) for point in curve.points]
    return learning_curve(
        {"held-out cells": points}, lambda _, number: link(arm=name_of(number)), axis="seen combinations"
    )


def primary_forest(card: Card, design: Design, arms: Mapping[str, Arm], link: Link) -> dict[str, Any] | None:
    """Return the rows of the primary comparison; None: the experiment compares nothing.

    Args:
        card: The card.
        design: Its experiment.
        arms: Condition to its outcomes.
        link: Makes the links of the rows.
    """
    return _forest(card.verdicts[0], design, arms, link) if card.verdicts else None


def provenance_of(card: Card) -> dict[str, str]:
    """Return the provenance of a card's results, for a table."""
    code, environment = card.code, card.environment
    commit = f"{code.commit[:12]}{', with uncommitted changes' if code.dirty else ''}" if code.commit else "-"
    return {
        "RoboXim": code.version or "-", "commit": commit, "renderer": environment.renderer or "-",
        "device": environment.device or "-", "packages": environment.packages_sha256[:16] or "-",
        "experiment file": card.experiment.sha256[:16] or "-", "card": card.sha256,
    }  # fmt: skip
