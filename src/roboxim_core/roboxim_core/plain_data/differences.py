"""Short descriptions of the differences between two configurations, for error messages."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from typing import Any

from roboxim_core.config import parse_yaml
from roboxim_core.errors import ConfigError

SHOWN = 5
"""Number of differences that are described; further ones are only counted."""
SHOWN_CHARACTERS = 60
"""Largest length of a shown value [characters]; longer ones are cut."""
_MISSING = object()


def differences(
    stored: Mapping[str, Any],
    requested: Mapping[str, Any],
    *,
    ignore: Collection[str] = (),
    words: tuple[str, str] = ("stored", "requested"),
) -> str:
    """Describe the differences between two configurations, by their innermost keys.

    YAML text, such as a run's ``task_config``, is compared key by key.

    Args:
        stored: The existing configuration, plain data.
        requested: The requested configuration, plain data.
        ignore: Outermost keys that may differ.
        words: What follows a value of the first and of the second configuration.

    Returns:
        For example ``seed: 0 stored, 1 requested; task_config.skill: "rotate" stored, "pick_up" requested``; empty
        when they are equal.
    """
    keys = [
        key
        for key in dict.fromkeys((*requested, *stored))
        if key not in ignore and stored.get(key) != requested.get(key)
    ]
    found: list[str] = []
    for key in sorted(keys):
        old, new = (_leaves(key, data[key]) if key in data else {} for data in (stored, requested))
        inner = [name for name in dict.fromkeys((*new, *old)) if old.get(name, _MISSING) != new.get(name, _MISSING)]
        found += [f"{name}: {_shown(old, name)} {words[0]}, {_shown(new, name)} {words[1]}" for name in inner] or [
            f"{key}: the same values in another order or with other comments"
        ]
    more = [f"and {len(found) - SHOWN} more"] if len(found) > SHOWN else []
    return "; ".join(found[:SHOWN] + more)


def _leaves(path: str, value: Any) -> dict[str, Any]:
    """Map innermost keys to their values; a list of plain values counts as one value."""
    if isinstance(value, str) and "\n" in value:
        try:
            parsed = parse_yaml(value)
        except ConfigError:
            parsed = value
        value = parsed if isinstance(parsed, Mapping) else value
    if isinstance(value, Mapping) and value:
        return {leaf: v for key in value for leaf, v in _leaves(f"{path}.{key}", value[key]).items()}
    if isinstance(value, list) and any(isinstance(item, Mapping) for item in value):
        return {leaf: v for i, item in enumerate(value) for leaf, v in _leaves(f"{path}[{i}]", item).items()}
    return {path: value}


def _shown(leaves: Mapping[str, Any], name: str) -> str:
    value = leaves.get(name)
    if value is None:
        return "nothing"
    text = json.dumps(value, default=str)
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[: SHOWN_CHARACTERS - 3]}..."
