"""Compares models: runs of an experiment, on the scenes that they shared where their results are there."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from roboxim_bringup.experiment_card import results_of, stage_name
from roboxim_bringup.runs.experiment_report import ExperimentFolder, folder_card, stored_card
from roboxim_core.errors import ConfigError
from roboxim_eval.experiments.card import Card
from roboxim_eval.experiments.models import Models, Wins, compare_models


def compared(folders: Sequence[Path], *, condition: str = "", where: str = "") -> tuple[Models, dict[str, Card]]:
    """Compare a condition of several runs.

    Args:
        folders: Folders of runs, or card files; a model is named by its folder, or by its file.
        condition: Condition; empty: the first one of the primary comparison.
        where: ``unseen``, ``seen`` or ``all``; empty: that of the primary comparison.

    Returns:
        The comparison, and name to card.

    Raises:
        ConfigError: When two have the same name, a card was changed, or nothing is common.
    """
    cards: dict[str, Card] = {}
    scenes: dict[str, list[Wins]] = {}
    for path in folders:
        name = path.stem if path.is_file() else path.resolve().name
        if name in cards:
            raise ConfigError(f"two of the runs are named '{name}'; rename a folder")
        if path.is_file():
            cards[name] = stored_card(path)
            continue
        folder = ExperimentFolder.of(path)
        cards[name] = folder_card(folder)
        scenes[name] = _wins(folder, condition)
    return compare_models(cards, condition=condition, where=where, scenes=_same_scenes(cards, scenes)), cards


def _wins(folder: ExperimentFolder, condition: str) -> list[Wins]:
    config = folder.design.config
    condition = condition or (config.primary.first if config.primary else next(iter(config.conditions)))
    if condition not in config.conditions:
        return []
    results = results_of(folder.design, folder.path)
    found: list[Wins] = []
    for replicate in range(config.replicates.count):
        rows = results[stage_name(condition, replicate)].items()
        found.append({(cell, str(number)): result.outcome == "success" for (cell, number), result in rows})
    return found


def _same_scenes(cards: dict[str, Card], scenes: dict[str, list[Wins]]) -> dict[str, list[Wins]]:
    """Return the outcomes of runs whose scenes are the same: equal tasks, changes and seeds."""
    drawn = {
        name: (card.experiment.config.factors, card.experiment.config.set, [e.seed for e in card.evaluations])
        for name, card in cards.items()
    }
    first = next(iter(drawn.values()))
    return {name: wins for name, wins in scenes.items() if drawn[name] == first}
