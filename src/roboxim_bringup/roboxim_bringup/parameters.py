"""Parameters on the command line, in ROS 2's spelling."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from roboxim_bringup.graph import PolicyLaunch
from roboxim_core.errors import ConfigError


def parse_assignments(assignments: Iterable[str], *, node: str = "") -> dict[str, dict[str, Any]]:
    """Parse ``name:=value`` and ``node:name:=value`` with YAML values.

    Args:
        assignments: The words.
        node: Node of the parameters that are given without one; empty: every node that declares them.

    Returns:
        Node name to parameter name to value.

    Raises:
        ConfigError: When a word is not of this form.
    """
    from roboxim_core.plain_data.yaml_text import parse

    found: dict[str, dict[str, Any]] = {}
    for word in assignments:
        match = re.fullmatch(r"(?:/?([\w/]+):)?([\w.]+):=(.*)", word, re.DOTALL)
        if match is None:
            raise ConfigError(f"'{word}' is not a parameter; expected name:=value or node:name:=value")
        value = parse(match[3], source=f"value of parameter '{match[2]}'")
        found.setdefault(match[1] or node, {})[match[2]] = value
    return found


def parse_policy(word: str) -> PolicyLaunch:
    """Parse ``spec`` or ``namespace=spec``."""
    namespace, equals, spec = word.partition("=")
    return PolicyLaunch(spec=spec, namespace=namespace) if equals else PolicyLaunch(spec=word)


def parse_options(assignments: Iterable[str]) -> dict[str, Any]:
    """Parse ``key=value`` words with YAML values.

    Raises:
        ConfigError: When a word is not of this form, or a key is given twice.
    """
    from roboxim_core.plain_data.yaml_text import parse

    options: dict[str, Any] = {}
    for word in assignments:
        key, equals, value = word.partition("=")
        if not equals or not key.isidentifier():
            raise ConfigError(f"'{word}' is not an option; expected key=value")
        if key in options:
            raise ConfigError(f"'{key}' was given twice; it takes one value")
        options[key] = parse(value, source=f"value of option '{key}'")
    return options


def read_params_files(files: Iterable[str | Path], *, namespace: str = "") -> dict[str, dict[str, Any]]:
    """Read ROS 2 parameter files: ``node: {ros__parameters: {name: value}}``, ``/**`` for every node.

    Args:
        files: The files; later ones override earlier ones.
        namespace: Namespace of the graph; the files may give node names with or without it.

    Returns:
        Node name to parameter name to value; nested names are joined with dots.

    Raises:
        ConfigError: When a file is missing or is not of this form.
    """
    from roboxim_core.config import load_yaml
    from roboxim_core.plain_data.yaml_text import plain

    found: dict[str, dict[str, Any]] = {}
    for file in files:
        data = plain(load_yaml(file))
        for node, content in _sections(data, file):
            name = node.removeprefix(namespace).strip("/")
            name = "" if name in ("**", "*") else name.removeprefix("**/")
            found.setdefault(name, {}).update(_flat(content))
    return found


def _sections(data: Any, file: str | Path) -> Iterable[tuple[str, dict[str, Any]]]:
    if not isinstance(data, dict) or not data:
        raise ConfigError(f"{file}: expected a mapping of nodes to ros__parameters")
    for node, content in data.items():
        parameters = content.get("ros__parameters") if isinstance(content, dict) else None
        if not isinstance(parameters, dict):
            raise ConfigError(f"{file}: node '{node}' has no mapping ros__parameters")
        yield str(node), parameters


def _flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            flat.update(_flat(value, f"{prefix}{key}."))
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def merge(*parts: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Merge parameters by node; later ones override earlier ones."""
    merged: dict[str, dict[str, Any]] = {}
    for part in parts:
        for node, values in part.items():
            merged.setdefault(node, {}).update(values)
    return merged
