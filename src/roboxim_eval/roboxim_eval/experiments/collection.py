"""Compares two ways to collect further demonstrations: more where a policy is weak, or spread evenly.

A round begins with the card of a finished experiment. Its success by cell determines an experiment with two arms. Both
contain the existing demonstrations and the same number of new ones. The arm ``made_to_order`` distributes the new ones
in proportion to the cells' failures, the arm ``uniform`` evenly. Trainings and scenes have new seeds, so the scenes
that showed the weak cells do not judge the result. The card of a round is the start of the next one, in which each arm
continues from its own demonstrations.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from roboxim_core.errors import ConfigError, one_of
from roboxim_eval.experiments.card import Card
from roboxim_eval.experiments.card_checks import design_of_card, outcomes_of_card
from roboxim_eval.experiments.config import CompareConfig, EvaluateConfig, ExperimentConfig
from roboxim_eval.statistics.replicates import MIN_REPLICATES
from roboxim_eval.statistics.tables import Count

ARMS = ("made_to_order", "uniform")
"""Names of the arms: conditions and datasets."""


@dataclass(frozen=True, kw_only=True)
class Round:
    """A round of demonstrations."""

    config: ExperimentConfig
    """The experiment that compares both arms."""
    success: Mapping[str, Count]
    """Cell to the outcomes that decided."""
    chosen: Mapping[str, int]
    """Cell to its new demonstrations in the arm made to order."""
    even: Mapping[str, int]
    """Cell to its new demonstrations in the uniform arm."""


def next_round(card: Card, demonstrations: int, condition: str = "") -> Round:
    """Return the next round of demonstrations.

    Args:
        card: Card of a finished experiment, or of the last round.
        demonstrations: New demonstrations of each arm.
        condition: Condition whose weak cells decide; empty: the arm made to order of the last round, else the first
            trained condition of the primary comparison.

    Raises:
        ConfigError: When the condition is not trained, was not evaluated in all cells of its dataset, or is as weak in
            all of them, so that both arms would be the same.
    """
    design = design_of_card(card)
    config = design.config
    trained = [name for name, one in config.conditions.items() if one.train]
    rounds = all(name in trained for name in ARMS)
    condition = condition or (ARMS[0] if rounds else _first(config, trained))
    if not trained:
        raise ConfigError("the experiment trains no condition here, so that it has no datasets to add to")
    if condition not in trained:
        raise ConfigError(f"no condition '{condition}' is trained in this experiment; {one_of(trained, condition)}")
    sources = {arm: arm if rounds else condition for arm in ARMS}
    datasets = {arm: config.datasets[config.conditions[source].train] for arm, source in sources.items()}
    cells = list(design.datasets[config.conditions[condition].train])
    if any(one.fault for one in datasets.values()):
        raise ConfigError(f"the dataset of '{condition}' has planted faults; choose another condition")
    if demonstrations < len(cells):
        raise ConfigError(f"a round needs at least one demonstration a cell, {len(cells)}; got {demonstrations}")
    met = outcomes_of_card(card).arm(condition).by_cell
    if absent := [cell for cell in cells if cell not in met or not met[cell].episodes]:
        raise ConfigError(
            f"'{condition}' was not evaluated in {absent[0]}, a cell of its dataset, so that nobody knows how weak it "
            "is there; evaluate it in all cells"
        )
    success = {cell: met[cell] for cell in cells}
    weights = {cell: (one.episodes - one.successes + 0.5) / (one.episodes + 1) for cell, one in success.items()}
    chosen, even = shared_out(demonstrations, weights), shared_out(demonstrations, dict.fromkeys(cells, 1.0))
    if len(cells) == 1:
        raise ConfigError(
            f"the dataset of '{condition}' has one cell, '{cells[0]}', so that there is nothing to choose; give a "
            "condition or a card of several cells"
        )
    if chosen == even and not rounds:
        raise ConfigError(
            f"'{condition}' is equally weak in all {len(cells)} cells of its dataset, so that both arms would have the "
            "same demonstrations; choose another condition, a card with more cells, or more demonstrations"
        )
    added = dict(zip(ARMS, (chosen, even), strict=True))
    replicates, where = config.replicates, datasets[ARMS[0]].cells
    return Round(
        config=replace(
            config, thesis="", deviations=(), combinations=None, curve=None, scales={},
            about=f"Are {demonstrations} demonstrations made to order better than as many spread evenly?",
            datasets={
                arm: replace(one, more={cell: one.more.get(cell, 0) + added[arm][cell] for cell in cells})
                for arm, one in datasets.items()
            },
            conditions={
                arm: replace(
                    config.conditions[source], train=arm,
                    about=f"{sum(added[arm].values())} more demonstrations, {words}.",
                )
                for (arm, source), words in zip(sources.items(), ("where it failed", "of every cell"), strict=True)
            },
            evaluate=EvaluateConfig(
                per_cell=max(config.evaluate.per_cell, config.evaluate.per_unseen_cell),
                max_steps=config.evaluate.max_steps, cells=dict.fromkeys(ARMS, where),
            ),
            replicates=replace(
                replicates, count=max(MIN_REPLICATES, replicates.count),
                first_seed=replicates.first_seed + replicates.count,
            ),
            compare=(CompareConfig(first=ARMS[0], second=ARMS[1], where=where, primary=True),),
        ),
        success=success, chosen=chosen, even=even,
    )  # fmt: skip


def _first(config: ExperimentConfig, trained: list[str]) -> str:
    primary = config.primary
    if primary is not None and primary.first in trained:
        return primary.first
    return trained[0] if trained else ""


def shared_out(number: int, weights: Mapping[str, float]) -> dict[str, int]:
    """Return whole numbers with a sum, in proportion to weights: by the largest remainders, the first ones if equal."""
    total = math.fsum(weights.values())
    shares = {key: number * weight / total for key, weight in weights.items()}
    found = {key: int(share) for key, share in shares.items()}
    order = sorted(shares, key=lambda key: found[key] - shares[key])  # stable
    for key in order[: number - sum(found.values())]:
        found[key] += 1
    return found
