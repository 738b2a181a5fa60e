"""What a scale of an experiment changes, in words, so that a card says how it differs from the whole experiment."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

from roboxim_core.config import to_plain
from roboxim_eval.experiments.config import ExperimentConfig

WORDING = frozenset({"about", "deviations", "scales"})
"""Keys of an experiment that change nothing of what it does."""


def reductions(whole: ExperimentConfig, small: ExperimentConfig) -> str:
    """Return where an experiment at a scale differs from the whole one.

    Args:
        whole: The experiment at full scale.
        small: The same at another scale.

    Returns:
        For example ``without factors.task rotate; evaluate.per_cell 5 instead of 20``; empty: nowhere.
    """
    full, here = (json.loads(json.dumps(to_plain(one))) for one in (whole, small))
    return "; ".join(_changes((), {**full, **dict.fromkeys(WORDING)}, {**here, **dict.fromkeys(WORDING)}))


def _changes(path: tuple[str, ...], before: Any, now: Any) -> Iterator[str]:
    if before == now:
        return
    name = ".".join(path)
    if isinstance(before, Mapping) and now is None:
        yield f"without {name}"
        return
    if not (isinstance(before, Mapping) and isinstance(now, Mapping)):
        yield f"{name} {_text(now)} instead of {_text(before, of=now)}"
        return
    for word, keys in (("without", before.keys() - now), ("with", now.keys() - before)):
        if keys:
            yield f"{word} {name} {', '.join(sorted(keys))}"
    for key in now:
        if key in before:
            yield from _changes((*path, key), before[key], now[key])


def _text(value: Any, *, of: Any = None) -> str:
    """Return a value in words: of a list of mappings their number, or that they are others than those of ``of``."""
    if isinstance(value, list) and any(isinstance(one, Mapping) for one in value):
        return "others" if isinstance(of, list) and len(of) == len(value) else f"{len(value)} entries"
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    return "none" if value in (None, "", {}) else str(value)
