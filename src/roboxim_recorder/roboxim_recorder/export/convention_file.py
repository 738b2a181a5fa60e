"""The file ``convention.yaml`` beside a dataset; ``evaluate --option convention=`` takes it."""

from __future__ import annotations

import dataclasses
import io
from typing import Any

from roboxim_core.config import to_plain
from roboxim_core.conventions import Convention


def convention_text(convention: Convention) -> str:
    """Return a convention as YAML, without the fields that have their default."""
    from ruamel.yaml import YAML

    buffer = io.StringIO()
    yaml = YAML(typ="safe", pure=True)
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    yaml.width = 120
    yaml.dump(_changed(convention), buffer)
    return buffer.getvalue()


def _changed(value: Any) -> Any:
    """Return plain data of a dataclass's fields that differ from their defaults, through all levels."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {
            field.name: _changed(getattr(value, field.name))
            for field in dataclasses.fields(value)
            if getattr(value, field.name) != _default(field)
        }
    if isinstance(value, tuple | list):
        return [_changed(item) for item in value]
    if isinstance(value, dict):
        return {str(key): _changed(item) for key, item in value.items()}
    return str(value) if isinstance(value, str) else to_plain(value)


def _default(field: dataclasses.Field[Any]) -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default
