"""Compares models: runs of the same experiment, paired on shared scenes where their results are available."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from roboxim_core.errors import ConfigError
from roboxim_eval.experiments.card import Card
from roboxim_eval.experiments.models import Models, Wins, compare_models, compared_condition
from roboxim_runs.experiments.card import CARD_FILE, results_of, stage_name
from roboxim_runs.experiments.report import ExperimentFolder, folder_card, has_only_card, stored_card


def compared(folders: Sequence[Path], *, condition: str = "", where: str = "") -> tuple[Models, dict[str, Card]]:
    """Compare a condition of several runs.

    Args:
        folders: Folders of runs or of cards, or card files; a model is named by its folder, or by its file.
        condition: Condition; empty: the first one of the primary comparison.
        where: ``unseen``, ``seen`` or ``all``; empty: that of the primary comparison.

    Returns:
        The comparison, and name to card.

    Raises:
        ConfigError: When two models have the same name, a card was changed, nothing is common, or the rollouts had
            different tasks.
    """
    cards: dict[str, Card] = {}
    runs: dict[str, ExperimentFolder] = {}
    for path in folders:
        name = _name_of(path)
        if name in cards:
            raise ConfigError(f"two of the runs are named '{name}'; rename a folder or a card")
        if path.is_file() or has_only_card(path):
            cards[name] = stored_card(path if path.is_file() else path / CARD_FILE)
            continue
        runs[name] = ExperimentFolder.of(path)
        cards[name] = folder_card(runs[name])
    if cards and not condition:  # of the first run; another run's own may be another one
        condition = compared_condition(next(iter(cards.values())).experiment.config)
    scenes = {name: _wins(folder, condition, cards[name]) for name, folder in runs.items()}
    return compare_models(cards, condition=condition, where=where, scenes=scenes), cards


def _name_of(path: Path) -> str:
    """Return the name of a model: that of its run's folder, also for a card in it, or that of another card's file."""
    if path.is_file() and path.name != CARD_FILE:
        return path.stem
    return (path if path.is_dir() else path.parent).resolve().name


def _wins(folder: ExperimentFolder, condition: str, card: Card) -> list[Wins]:
    """Return the outcomes of each replicate by cell and scene: its number under the evaluation's seed.

    Scenes of one seed and number are the same: `compare_models` refuses runs whose rollouts had different tasks.
    """
    seeds = {e.replicate: e.seed for e in card.evaluations if e.condition == condition and not e.checkpoint}
    config = folder.design.config
    if condition not in config.conditions:
        return []
    results = results_of(folder.design, folder.path)
    found: list[Wins] = []
    for replicate in range(config.replicates.count):
        rows = results[stage_name(condition, replicate)].items()
        seed = seeds.get(replicate)
        found.append({(cell, f"{seed}/{number}"): result.outcome == "success" for (cell, number), result in rows})
    return found
