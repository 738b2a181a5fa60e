"""Whether runs can be compared as models: their rollouts must have the same tasks; other differences are reported.

Equal names of cells do not show that rollouts were alike: `skill_object` and `skill_object_worded` have the same cells,
but zero and three distractors. The tasks of a cell's rollouts follow from the factors, from ``set``,
``evaluate.max_steps`` and the condition. Only the compared cells' factors are checked, since a scale may have fewer
levels.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import PurePath
from typing import Any

from roboxim_core.errors import ConfigError, listed
from roboxim_core.plain_data.differences import differences
from roboxim_eval.experiments.card import Card
from roboxim_eval.experiments.card_checks import design_of_card
from roboxim_eval.experiments.cells import cells_of
from roboxim_eval.experiments.config import TASK, ExperimentConfig

SHOWN_HASH = 8
"""Length to which hashes are cut in sentences [characters]."""


def require_same_rollouts(cards: Mapping[str, Card], condition: str, cells: Collection[str]) -> None:
    """Check that the rollouts of a condition had the same tasks in all runs.

    Args:
        cards: Name of a model to its card.
        condition: The compared condition; all runs have it.
        cells: The compared cells; all runs have them.

    Raises:
        ConfigError: When a run's rollouts had other tasks than those of the first one; names the keys.
    """
    (first, reference), *others = ((name, _tasks_of(card.experiment.config, condition, cells)) for name, card in
                                   cards.items())  # fmt: skip
    for name, tasks in others:
        if changed := differences(reference, tasks, words=(f"in {first}", f"in {name}")):
            raise ConfigError(
                f"{first} and {name} cannot be compared, since their rollouts of condition '{condition}' had "
                f"different tasks ({changed}); expected equal factors, set, evaluate.max_steps and condition. Compare "
                "runs of one experiment, or name another condition (--condition)"
            )


def _tasks_of(config: ExperimentConfig, condition: str, cells: Collection[str]) -> dict[str, Any]:
    """Return the tasks of a condition's rollouts in some cells, as plain data, by the keys of the file."""
    met = [cell.levels for cell in cells_of(config) if cell.key in cells]
    factors: dict[str, dict[str, Any]] = {}
    for factor, level in dict.fromkeys(item for levels in met for item in levels.items()):
        if settings := _level_settings(config, factor, level):
            factors.setdefault(factor, {})[level] = settings
    own = config.conditions[condition]
    words = {"instruction": own.instruction, "latency_ticks": own.latency_ticks}
    tasks = {
        "factors": factors,
        "set": _named_nulls(config.set),
        "conditions": {condition: words | ({"set": _named_nulls(own.set)} if own.set else {})},
        "evaluate": {"max_steps": config.evaluate.max_steps},
    }
    plain: dict[str, Any] = json.loads(json.dumps({key: value for key, value in tasks.items() if value}))
    return plain


def _level_settings(config: ExperimentConfig, factor: str, level: str) -> Any:
    """Return the settings of a level: keys of the task, an object model, or a task's file; empty: only its name."""
    levels = config.factors[factor]
    if isinstance(levels, Mapping) and levels[level]:
        return _named_nulls(levels[level])
    named = PurePath(level).stem == level if factor == TASK else isinstance(levels, Mapping)
    return "" if named else level


def _named_nulls(changes: Any) -> Any:
    """Return changes of a task with ``null`` as a word, so that messages distinguish a removed key from no change."""
    if isinstance(changes, Mapping):
        return {key: _named_nulls(value) for key, value in changes.items()}
    return "null" if changes is None else changes


# ------------------------------------------------------------------ other differences


def circumstances(cards: Mapping[str, Card], condition: str) -> Iterator[str]:
    """Yield a sentence for each difference between runs, apart from their policies.

    Facts that a card lacks are not compared.

    Args:
        cards: Name of a model to its card.
        condition: The compared condition.
    """
    facts: dict[str, Callable[[Card], str]] = {
        "scale": lambda card: card.experiment.scale,
        "image size": lambda card: card.experiment.config.image_size,
        "renderer": lambda card: card.environment.renderer,
        "version of the code": lambda card: card.code.words,
        "installed packages (by hash)": lambda card: card.environment.packages_sha256[:SHOWN_HASH],
    }
    found = {what: {name: fact(card) for name, card in cards.items()} for what, fact in facts.items()}
    found["training datasets (by hash)"] = _datasets(cards, condition)
    for what, by_model in found.items():
        groups: dict[str, list[str]] = {}
        for name, value in by_model.items():
            if value:
                groups.setdefault(value, []).append(name)
        if len(groups) > 1:
            groups_text = "; ".join(f"{value} ({listed(names)})" for value, names in groups.items())
            yield f"The runs differ in {what}, too: {groups_text}. A difference of the models may be due to that."


def _datasets(cards: Mapping[str, Card], condition: str) -> dict[str, str]:
    """Return the datasets of each model's trainings, of as many replicates as all models have.

    Returns:
        Model to its datasets in words, e.g. ``324 demonstrations as rlds, 7036c27a``; models whose card has no hash of
        them, e.g. because their policies were given, are left out.
    """
    keys = {name: _datasets_of(card, condition) for name, card in cards.items()}
    known = {
        name: datasets for name, datasets in keys.items()
        if datasets and all(key in cards[name].datasets and cards[name].datasets[key].sha256 for key in datasets)
    }  # fmt: skip
    replicates = min(map(len, known.values()), default=0)
    found = {}
    for name, datasets in known.items():
        used = [cards[name].datasets[key] for key in dict.fromkeys(datasets[:replicates])]
        hashes = ", ".join(dataset.sha256[:SHOWN_HASH] for dataset in used)
        trainer = design_of_card(cards[name]).trainer
        found[name] = f"{sum(used[0].by_cell.values())} demonstrations as {trainer.format}, {hashes}"
    return found


def _datasets_of(card: Card, condition: str) -> list[str]:
    """Return the dataset of each training whose policy a condition evaluates, by replicate; empty: not trained."""
    trained = card.experiment.config.conditions[condition].checkpoint_of or condition
    trainings = sorted((t for t in card.trainings if t.condition == trained), key=lambda t: t.replicate)
    return [training.dataset for training in trainings]
