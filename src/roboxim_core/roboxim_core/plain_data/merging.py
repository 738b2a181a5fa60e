"""Changes to plain configuration data, as the key ``set`` of mixes and experiments states them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from roboxim_core.config import LocatedMap, line_of


def merged(base: Any, change: Any) -> Any:
    """Return plain data with keys replaced recursively in mappings; lists and choices are replaced as a whole.

    A key that is changed to None is removed, so that its default applies.

    Every key keeps its line number, see `roboxim_core.config.line_of`.
    """
    if not isinstance(change, Mapping) or "values" in change or "lower" in change:
        return change
    base = base if isinstance(base, Mapping) else {}
    items = {**base, **{key: merged(base.get(key), value) for key, value in change.items()}}
    items = {key: value for key, value in items.items() if key not in change or value is not None}
    lines = {key: line_of(change, key) if key in change else line_of(base, key) for key in items}
    return LocatedMap(items, lines) if any(lines.values()) else items
