"""YAML text to plain Python values and back; `documents` has the parser that keeps line numbers."""

from __future__ import annotations

from typing import Any

import yaml

from roboxim_core.plain_data.documents import parse_yaml


def parse(text: str, *, source: str = "YAML") -> Any:
    """Parse YAML 1.2 into dicts, lists and scalars.

    Args:
        text: The YAML.
        source: Description of the text, for messages.

    Raises:
        ConfigError: When the text is not YAML; the message names the line.
    """
    return plain(parse_yaml(text, source=source))


def plain(value: Any) -> Any:
    """Convert the parser's types, which store line numbers, to plain values."""
    if isinstance(value, dict):
        return {plain(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    for kind in (bool, int, float, str):
        if isinstance(value, kind):
            return kind(value)
    return value


class _Dumper(yaml.CSafeDumper):  # type: ignore[misc]  # PyYAML has no types
    """A dumper that keeps texts of several lines readable."""


def _text(dumper: yaml.CSafeDumper, value: str) -> yaml.Node:
    style = "|" if "\n" in value else None
    return dumper.represent_scalar("tag:yaml.org,2002:str", value, style=style)


_Dumper.add_representer(str, _text)


def dump(value: Any) -> str:
    """Write plain values as YAML: leaves on one line, everything else indented."""
    text: str = yaml.dump(
        value, Dumper=_Dumper, sort_keys=False, default_flow_style=None, allow_unicode=True, width=120
    )
    return text.removesuffix("...\n")
