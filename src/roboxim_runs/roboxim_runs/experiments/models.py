"""Compares models: runs of the same experiment, paired on shared scenes where their results are available."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from roboxim_core.errors import ConfigError
from roboxim_eval.experiments.card import Card
from roboxim_eval.experiments.models import Models, Wins, compare_models, compared_condition
from roboxim_runs.experiments.card import CARD_FILE, results_of, stage_name
from roboxim_runs.experiments.report import ExperimentFolder, folder_card, has_only_card, stored_card
from roboxim_runs.storage.folder import distinct_ends


def compared(folders: Sequence[Path], *, condition: str = "", where: str = "") -> tuple[Models, dict[str, Card]]:
    """Compare a condition of several runs.

    Args:
        folders: Folders of runs or of cards, or card files; a model is named by its folder, or by its file, with as
            many folders above it as distinguish the models.
        condition: Condition; empty: the first one of the primary comparison.
        where: ``unseen``, ``seen`` or ``all``; empty: that of the primary comparison.

    Returns:
        The comparison, and name to card.

    Raises:
        ConfigError: When a run is named twice, a card was changed, nothing is common, or the rollouts had
            different tasks.
    """
    cards: dict[str, Card] = {}
    runs: dict[str, ExperimentFolder] = {}
    models = [_model_of(path) for path in folders]
    for number, model in enumerate(models):
        if model in models[:number]:
            raise ConfigError(f"{folders[number]} is named twice; name each run once")
    for name, path in zip(distinct_ends(models), folders, strict=True):
        if path.is_file() or has_only_card(path):
            cards[name] = stored_card(path if path.is_file() else path / CARD_FILE)
            continue
        runs[name] = ExperimentFolder.of(path)
        cards[name] = folder_card(runs[name])
    if cards and not condition:  # of the first run; another run's own may be another one
        condition = compared_condition(next(iter(cards.values())).experiment.config)
    scenes = {name: _wins(folder, condition, cards[name]) for name, folder in runs.items()}
    return compare_models(cards, condition=condition, where=where, scenes=scenes), cards


def _model_of(path: Path) -> Path:
    """Return the path that names a model: its run's folder, also for a card in it, or another card's file."""
    if path.is_file() and path.name != CARD_FILE:
        return path.resolve().with_suffix("")
    return (path if path.is_dir() else path.parent).resolve()


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
