"""Compares models: runs of an experiment, on the scenes that they shared where their results are there."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from roboxim_bringup.experiment_card import results_of, stage_name
from roboxim_bringup.runs.experiment_report import ExperimentFolder, folder_card, stored_card
from roboxim_core.errors import ConfigError
from roboxim_eval.experiments import ExperimentConfig
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
    shared = _same_scenes(cards, scenes, condition)
    return compare_models(cards, condition=condition, where=where, scenes=shared), cards


def _wins(folder: ExperimentFolder, condition: str) -> list[Wins]:
    config = folder.design.config
    condition = _condition(config, condition)
    if condition not in config.conditions:
        return []
    results = results_of(folder.design, folder.path)
    found: list[Wins] = []
    for replicate in range(config.replicates.count):
        rows = results[stage_name(condition, replicate)].items()
        found.append({(cell, str(number)): result.outcome == "success" for (cell, number), result in rows})
    return found


def _condition(config: ExperimentConfig, condition: str) -> str:
    return condition or (config.primary.first if config.primary else next(iter(config.conditions)))


def _same_scenes(cards: dict[str, Card], scenes: dict[str, list[Wins]], condition: str) -> dict[str, list[Wins]]:
    """Return the outcomes of runs whose scenes are the same: equal tasks, changes and seeds of final evaluations."""

    def drawn(card: Card) -> tuple[object, ...]:
        config = card.experiment.config
        name = _condition(config, condition)
        seeds = [e.seed for e in card.evaluations if e.condition == name and not e.checkpoint]
        changes = config.conditions[name].set if name in config.conditions else {}
        return config.factors, config.set, changes, seeds

    first = drawn(next(iter(cards.values())))
    return {name: wins for name, wins in scenes.items() if drawn(cards[name]) == first}
