"""Changes that a scale makes to an experiment, in words, for its card."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

from roboxim_core.config import to_plain
from roboxim_eval.experiments.combinations import names_of
from roboxim_eval.experiments.config import ExperimentConfig

WORDING = ("about", "thesis", "deviations", "scales")
"""Keys of an experiment without effect on its work; ``about`` of a condition also has none."""
MANY = 12
"""Entries of a list from which their number is stated instead of the list."""
ZEROS = {"max_steps": "as the task says", "steps": "as the trainer says"}
"""Keys whose value 0 means a number from another file."""


def deciding(config: ExperimentConfig) -> dict[str, Any]:
    """Return the keys that affect an experiment's work, as plain data, without its descriptions."""
    plain: dict[str, Any] = json.loads(json.dumps(to_plain(config)))
    conditions = {name: {**one, "about": ""} for name, one in plain["conditions"].items()}
    return {key: value for key, value in {**plain, "conditions": conditions}.items() if key not in WORDING}


def reductions(whole: ExperimentConfig, small: ExperimentConfig, trainer: str) -> str:
    """Return the differences of an experiment at a scale from the original.

    Args:
        whole: The experiment at full scale.
        small: The same at another scale.
        trainer: The trainer that is chosen; others are left out. Empty: the first one.

    Returns:
        For example ``without factors.task.rotate; evaluate.per_cell 5 instead of 20``; empty: none.
    """
    full, here = (_resolved(config, trainer or next(iter(small.trainers), "")) for config in (whole, small))
    rollouts = [one["evaluate"] for one in (full, here)]
    if all(one["per_unseen_cell"] == one["per_cell"] for one in rollouts):
        for one in rollouts:
            del one["per_unseen_cell"]
    return "; ".join(_changes((), full, here))


def _resolved(config: ExperimentConfig, trainer: str) -> dict[str, Any]:
    """Return the relevant keys with one trainer, and with zeros replaced by the values that they stand for."""
    plain = deciding(config)
    for name in names_of(config.combinations):  # they follow from combinations, which is named itself
        for part in (plain["datasets"], plain["conditions"], plain["evaluate"]["cells"]):
            part.pop(name, None)
        plain["compare"] = [one for one in plain["compare"] if name not in (one["first"], one["second"])]
    plain["trainers"] = {trainer: plain["trainers"][trainer]} if trainer in plain["trainers"] else {}
    evaluate = plain["evaluate"]
    evaluate["per_unseen_cell"] = evaluate["per_unseen_cell"] or evaluate["per_cell"]
    if plain["curve"]:
        plain["curve"]["replicates"] = plain["curve"]["replicates"] or plain["replicates"]["count"]
    return plain


def _changes(path: tuple[str, ...], before: Any, now: Any) -> Iterator[str]:
    if before == now:
        return
    name = ".".join(path)
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        for word, keys in (("without", before.keys() - now), ("with", now.keys() - before)):
            if keys:
                yield f"{word} {', '.join(f'{name}.{key}' if name else key for key in sorted(keys))}"
        for key in now:
            if key in before:
                yield from _changes((*path, key), before[key], now[key])
    elif isinstance(before, Mapping) or isinstance(now, Mapping):
        yield f"{'without' if isinstance(before, Mapping) else 'with'} {name}"
    elif isinstance(now, list) and now and _entries(before):
        yield f"{name} {'other entries' if len(now) == len(before) else f'{len(now)} instead of {len(before)} entries'}"
    else:
        yield f"{name} {_text(path, now)} instead of {_text(path, before)}"


def _entries(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and (isinstance(value[0], Mapping) or len(value) >= MANY)


def _text(path: tuple[str, ...], value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    if value == 0 and path[-1] in ZEROS:
        return ZEROS[path[-1]]
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    return "none" if value in (None, "") else str(value)
