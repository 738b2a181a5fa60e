"""The plan of an experiment in words: what it runs, how long it takes, and what it can show. Nothing is started."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from roboxim_core.errors import ConfigError
from roboxim_eval.experiments import Cost, Design, Rates, cost_of
from roboxim_eval.experiments.allocation import Allocation
from roboxim_eval.experiments.cost import detectable_drop, same_checkpoints, trainings_at_once
from roboxim_eval.experiments.spread import primary_components
from roboxim_eval.statistics.components import Components, pooled_components
from roboxim_runs.experiments.scenes.leakage import scene_leakage

NO_RATES = (
    "unknown: no rates of this machine were measured; 'roboxim experiment calibrate' measures them in a few minutes"
)


def known_cost(design: Design, rates: Rates | None, trainings: int) -> Cost | None:
    """Return the cost of an experiment; none: a rate that it needs was never measured.

    Args:
        design: The experiment.
        rates: This machine's rates; none: never measured.
        trainings: Largest number of trainings at a time.
    """
    if rates is None or rates.at_once(trainings_at_once(design, trainings)) is None:
        return None
    return cost_of(design, rates, trainings)


def plan_lines(name: str, scale: str, design: Design, rates: Rates | None, trainings: int = 1) -> Iterator[str]:
    """Yield the plan of an experiment, line by line.

    Args:
        name: Name of the experiment.
        scale: Its scale.
        design: The experiment.
        rates: This machine's rates; none: never measured.
        trainings: Largest number of trainings at a time.
    """
    config = design.config
    yield f"{name}, scale {scale}" + (f" (thesis {config.thesis})" if config.thesis else "")
    yield f"  {config.about}"
    yield f"  cells           {len(design.cells)}, {sum(cell.unseen for cell in design.cells)} of them held out"
    if design.generations:
        sizes = ", ".join(f"{key} {sum(counts.values())}" for key, counts in design.datasets.items())
        many = f" in {design.generations} generations" if design.generations > 1 else ""
        yield f"  demonstrations  {design.episodes}{many}; datasets: {sizes}"
        yield from (f"    {line}" for line in _table(design))
    if design.trainings:
        steps = f"{design.steps:,} steps in all" if design.steps else "steps unknown"
        where = "" if design.trainer.command else ", elsewhere: name each policy with --policy CONDITION.R=SPEC"
        at_once = trainings_at_once(design, trainings)
        parallel = f", {at_once} at a time" if at_once > 1 else ""
        yield f"  trainings       {len(design.trainings)}, {steps}{parallel}{where}"
    policies = "1 policy" if len(design.evaluations) == 1 else f"{len(design.evaluations)} policies"
    yield f"  rollouts        {design.rollouts:,} of {policies}"
    cost = known_cost(design, rates, trainings)
    yield f"  time            {_unknown(design, rates, trainings) if cost is None else time_text(cost)}"
    if cost is not None and rates is not None:
        yield f"                  {_success_text(cost, rates)}"
        if named := _named_by_user(design):
            yield f"                  without what {named} take to answer, which is not known here"
        yield f"  disk            {cost.disk_bytes / 1e9:.1f} GB"
        yield f"  rates           of {rates.measured}: {rates.source}; {rates.workers} workers on {rates.machine}"
        rate = rates.at_once(trainings_at_once(design, trainings))
        if rate is not None and rate.trainings > 1 and cost.train_s is not None:
            yield (
                f"                  {rate.trainings} trainings at a time: {rate.steps_per_s:.1f} steps a second each, "
                f"{rates.steps_per_s:.1f} alone; of {rate.measured}: {rate.source}"
            )
    yield from _power_lines(design)
    yield from (f"  warning         {sentence}" for sentence in scene_leakage(design))
    yield from (f"  deviation       {sentence}" for sentence in config.deviations)


def _named_by_user(design: Design) -> str:
    """Return which policies of an experiment the user names; empty: none."""
    elsewhere = design.trainings and not design.trainer.command
    given = any(condition.given for condition in design.config.conditions.values())
    kinds = [*(["are trained elsewhere"] if elsewhere else []), *(["exist already"] if given else [])]
    return f"the policies that {' or '.join(kinds)}" if kinds else ""


def _unknown(design: Design, rates: Rates | None, trainings: int) -> str:
    if rates is None:
        return NO_RATES
    at_once = trainings_at_once(design, trainings)
    return (
        f"unknown: the rate of {at_once} trainings at a time was not measured; 'roboxim experiment calibrate "
        f"--trainings {at_once}' measures it"
    )


def _success_text(cost: Cost, rates: Rates) -> str:
    """Return which share of the rollouts is taken as successful, and why."""
    if cost.succeeded == 0:
        return "as if no rollout succeeded: these trainings are too short to learn anything"
    own = rates.succeeded is not None
    why = f"as in the last run of {rates.experiment}" if own else "an assumption"
    failing = f"{hours(cost.total_s - cost.evaluate_s + cost.failing_s)} if none does"
    return f"if {100 * cost.succeeded:.0f} % of the rollouts succeed, {why}; {failing}"


def time_text(cost: Cost) -> str:
    """Return the time of all stages, e.g. ``3.1 h: 0.3 h demonstrations, 1.2 h trainings, 1.6 h rollouts``."""
    parts = [f"{hours(cost.generate_s)} demonstrations"] if cost.generate_s else []
    if cost.train_s != 0.0:
        parts.append("trainings elsewhere" if cost.train_s is None else f"{hours(cost.train_s)} trainings")
    parts.append(f"{hours(cost.evaluate_s)} rollouts")
    return f"{hours(cost.total_s)}: {', '.join(parts)}"


def hours(seconds: float) -> str:
    """Return a duration in hours, or in minutes below an hour."""
    return f"{seconds / 3600:.1f} h" if seconds >= 3600 else f"{seconds / 60:.0f} min"


def _power_lines(design: Design) -> Iterator[str]:
    from roboxim_eval.statistics.power import SPREAD_AT, TRAINING_SPREAD
    from roboxim_eval.statistics.replicates import MIN_REPLICATES

    scenes, replicates = design.compared_scenes, design.config.replicates.count
    if not scenes:
        return
    drop = detectable_drop(design)
    seen = "no drop" if drop is None else f"a drop from 80 to {100 * (0.8 - drop):.0f} %"
    trainings = "1 training" if replicates == 1 else f"{replicates} trainings"
    yield f"  finds           {seen} with a chance of 80 % ({trainings}, {scenes} rollouts each)"
    many, worst = len(design.config.compare), detectable_drop(design, alone=True)
    if many > 1:
        smallest = "no drop" if worst is None else f"one to {100 * (0.8 - worst):.0f} %"
        others = "the other comparison is not" if many == 2 else f"none of the other {many - 1} comparisons is"
        yield f"                  {smallest} if {others} found (Holm's adjustment)"
    if replicates < MIN_REPLICATES:
        yield (
            f"  warning         fewer than {MIN_REPLICATES} trainings compare checkpoints, not ways to train; "
            "verdicts will say so"
        )
    elif same_checkpoints(design):
        yield "                  if the trainings, the same on both sides, react alike to what differs, an assumption"
    else:
        yield (
            f"                  if trainings of one recipe spread by {100 * TRAINING_SPREAD:.1f} points at "
            f"{100 * SPREAD_AT:.0f} %, an assumption"
        )


def allocation_lines(name: str, chosen: Allocation, before: Allocation, cards: int) -> Iterator[str]:
    """Yield what a budget was spent on, and the interval to expect.

    Args:
        name: Name of the experiment.
        chosen: The chosen size.
        before: The size of the scale, for comparison.
        cards: Number of cards that the components are from.
    """
    many = "1 earlier card" if cards == 1 else f"{cards} earlier cards"
    yield f"{name}, allocated by the variance components of {many}"
    for word, one in (("chosen", chosen), ("as it stands", before)):
        yield (
            f"  {word:<15} {one.trainings} trainings x {one.cells} cells x {one.rollouts} rollouts, "
            f"{hours(one.seconds)}: expects +-{100 * one.half_width:.0f} points over these cells, "
            f"+-{100 * one.half_width_sampled:.0f} with cells as a sample"
        )


def earlier_components(cards: Sequence[Path]) -> Components:
    """Return the components that the primary comparisons of earlier cards have in common.

    Raises:
        ConfigError: When a file is no card, was changed, compares nothing or has one training, or nothing varies.
    """
    from roboxim_runs.experiments.report import stored_card

    found = pooled_components([primary_components(stored_card(path)) for path in cards])
    if not found.variance(1, 1):
        raise ConfigError(
            f"{', '.join(map(str, cards))}: all rollouts of a cell ended alike in both conditions of the primary "
            "comparison, so they show no spread to plan by; give a card in which outcomes vary, or plan without --from"
        )
    return found


def _table(design: Design) -> Iterator[str]:
    """Yield the demonstrations by cell.

    A row is a combination of the first factors, a column a level of the last one. Each place has the numbers of all
    datasets, one for those with the same numbers; held-out cells are in brackets.
    """
    *rows, column = design.config.factors
    levels = list(dict.fromkeys(cell.levels[column] for cell in design.cells))
    alike: dict[str, list[str]] = {}  # datasets that differ in their faults alone have one number
    for name, counts in design.datasets.items():
        alike.setdefault(json.dumps(counts, sort_keys=True), []).append(name)
    shown = {", ".join(names): design.datasets[names[0]] for names in alike.values()}
    if len(shown) > 1:
        yield f"by cell: {' / '.join(shown)}"
    found: dict[str, dict[str, str]] = {}
    for cell in design.cells:
        text = "/".join(str(counts.get(cell.key, "-")) for counts in shown.values())
        row = " ".join(cell.levels[factor] for factor in rows) or "all"
        found.setdefault(row, {})[cell.levels[column]] = f"[{text}]" if cell.unseen else text
    width = max(map(len, found))
    widths = {level: max(len(level), *(len(row.get(level, "")) for row in found.values())) for level in levels}
    yield " ".join((" " * width, *(f"{level:>{widths[level]}}" for level in levels)))
    for row, cells in found.items():
        yield " ".join((f"{row:<{width}}", *(f"{cells.get(level, ''):>{widths[level]}}" for level in levels)))


def plan_data(name: str, scale: str, design: Design, rates: Rates | None, trainings: int = 1) -> Mapping[str, Any]:
    """Return the plan as plain data, for scripts; for the arguments see `plan_lines`."""
    cost = known_cost(design, rates, trainings)
    return {
        "experiment": name,
        "scale": scale,
        "cells": {cell.key: "unseen" if cell.unseen else "seen" for cell in design.cells},
        "demonstrations": design.demonstrations,
        "generations": design.generations,
        "datasets": design.datasets,
        "trainings": len(design.trainings),
        "trainings_at_a_time": trainings_at_once(design, trainings),
        "steps": design.steps,
        "rollouts": design.rollouts,
        "scenes": design.compared_scenes,
        "replicates": design.config.replicates.count,
        "detectable_drop": detectable_drop(design),
        "detectable_drop_if_none_of_the_others_is_found": detectable_drop(design, alone=True),
        "hours": None if cost is None else cost.total_s / 3600,
        "rollouts_taken_as_successful": None if cost is None else cost.succeeded,
        "disk_bytes": None if cost is None else cost.disk_bytes,
        "warnings": list(scene_leakage(design)),
    }
