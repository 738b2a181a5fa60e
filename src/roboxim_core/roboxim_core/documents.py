"""Readers of untrusted YAML and JSON text, with bounds, so that no document fills the memory or causes a traceback.

A few lines of YAML whose aliases repeat each other can expand to billions of values, and deep nesting makes a recursive
reader raise ``RecursionError``. Values and levels are therefore counted before anything is built.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NoReturn

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import (
    AliasEvent,
    MappingEndEvent,
    MappingStartEvent,
    ScalarEvent,
    SequenceEndEvent,
    SequenceStartEvent,
)

from roboxim_core import limits
from roboxim_core.errors import ConfigError


def read_text(path: Path | str, most: int = limits.YAML_BYTES) -> str:
    """Read a text file.

    Args:
        path: The file.
        most: Largest size [bytes].

    Raises:
        ConfigError: When it is missing, too large or not UTF-8.
    """
    file = Path(path)
    try:
        with open(file, "rb") as stream:
            content = stream.read(most + 1)
        if len(content) > most:
            raise ConfigError(f"{file} is larger than {most} bytes")
        return content.decode("utf-8")
    except (OSError, ValueError) as error:
        if isinstance(error, UnicodeDecodeError):
            line = content[: error.start].count(b"\n") + 1
            raise ConfigError(f"{file} line {line}: not UTF-8 text: {error.reason}; save the file as UTF-8") from None
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(f"cannot read {limits.echo(str(file))}: {reason}") from None


def parse_yaml(text: str, *, source: str = "YAML") -> Any:
    """Parse YAML text, keeping line numbers for messages.

    Raises:
        ConfigError: When it is not YAML, or exceeds the bounds of `roboxim_core.limits`; the message names the line.
    """
    if len(text) > limits.YAML_BYTES:
        raise ConfigError(f"{source}: larger than {limits.YAML_BYTES} characters, got {len(text)}")
    try:
        _check_size(text, source)
        return YAML(typ="rt", pure=True).load(text)
    except MarkedYAMLError as error:
        line = f" line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise ConfigError(f"{source}{line}: not valid YAML: {error.problem}") from None
    except YAMLError as error:
        raise ConfigError(f"{source}: not valid YAML: {limits.printable(str(error))}") from None
    except (ValueError, TypeError, OverflowError) as error:  # e.g. an impossible date, an integer of 5,000 digits
        raise ConfigError(f"{source}: not valid YAML: {limits.printable(str(error))}") from None


def _check_size(text: str, source: str) -> None:
    """Refuse a document with too many values or levels, including those that its aliases repeat."""
    known: dict[str, tuple[int, int]] = {}
    open_nodes: list[_Node] = []
    total = 0
    for event in YAML(typ="rt", pure=True).parse(text):
        if isinstance(event, SequenceStartEvent | MappingStartEvent):
            open_nodes.append(_Node(event.anchor))
            values, levels = 1, 1
        elif isinstance(event, AliasEvent):
            if any(node.anchor == event.anchor for node in open_nodes):
                _refuse(source, event, f"alias '*{event.anchor}' is inside of what it repeats")
            values, levels = known.get(event.anchor, (1, 1))
        elif isinstance(event, ScalarEvent):
            values, levels = 1, 1
            if event.anchor:
                known[event.anchor] = (1, 1)
        elif isinstance(event, SequenceEndEvent | MappingEndEvent):
            done = open_nodes.pop()
            if done.anchor:
                known[done.anchor] = (done.values, done.levels)
            if open_nodes:
                open_nodes[-1].levels = max(open_nodes[-1].levels, done.levels + 1)
                open_nodes[-1].values += done.values - 1  # the node itself was counted when it began
            continue
        else:
            continue
        total += values
        if total > limits.DOCUMENT_NODES:
            _refuse(source, event, f"more than {limits.DOCUMENT_NODES} values, what aliases repeat included")
        if len(open_nodes) + levels - 1 > limits.DOCUMENT_DEPTH:
            _refuse(source, event, f"more than {limits.DOCUMENT_DEPTH} levels of nesting")
        inside = open_nodes[:-1] if isinstance(event, SequenceStartEvent | MappingStartEvent) else open_nodes
        if inside:
            inside[-1].values += values
            inside[-1].levels = max(inside[-1].levels, levels + 1)


class _Node:
    """A list or mapping that is being read: the number of its values and levels so far."""

    def __init__(self, anchor: str | None) -> None:
        self.anchor = anchor
        self.values = self.levels = 1


def _refuse(source: str, event: Any, problem: str) -> NoReturn:
    raise ConfigError(f"{source} line {event.start_mark.line + 1}: {problem}")


def parse_json(text: str, *, source: str = "JSON", most: int = limits.DOCUMENT_BYTES) -> Any:
    """Parse JSON text.

    Args:
        text: The text.
        source: Origin of the text, for messages.
        most: Largest size [characters].

    Raises:
        ConfigError: When it is not JSON (NaN and infinities are not JSON), too large or nested too deep.
    """
    if len(text) > most:
        raise ConfigError(f"{source} is larger than {most} characters, got {len(text)}")

    def refuse(constant: str) -> NoReturn:
        raise ValueError(f"{constant} is not a number of JSON")

    try:
        data = json.loads(text, parse_constant=refuse)
        if "\\u" in text:
            json.dumps(data, ensure_ascii=False).encode()  # refuses unpaired surrogates
    except RecursionError:
        raise ConfigError(f"{source} is nested too deep; {limits.DOCUMENT_DEPTH} levels are allowed") from None
    except ValueError as error:
        raise ConfigError(f"{source} is not valid JSON: {limits.printable(str(error))}") from None
    if not _shallow(data, limits.DOCUMENT_DEPTH):
        raise ConfigError(f"{source} is nested too deep; {limits.DOCUMENT_DEPTH} levels are allowed")
    return data


def read_json(path: Path | str, most: int = limits.DOCUMENT_BYTES) -> Any:
    """Read a JSON file.

    Args:
        path: The file.
        most: Largest size [bytes].

    Raises:
        ConfigError: Naming the file, as `read_text` and `parse_json`.
    """
    return parse_json(read_text(path, most), source=str(path), most=most)


def read_json_object(path: Path | str, most: int = limits.DOCUMENT_BYTES) -> dict[str, Any]:
    """Read a JSON file that holds an object; arguments as `read_json`.

    Raises:
        ConfigError: As `read_json`, and when it holds something else.
    """
    data = read_json(path, most)
    if not isinstance(data, dict):
        raise ConfigError(f"{path} holds a {type(data).__name__}, expected a JSON object")
    return data


def _shallow(data: Any, levels: int) -> bool:
    layer = [data]
    for _ in range(levels + 1):
        layer = [
            item
            for value in layer
            if isinstance(value, dict | list)
            for item in (value.values() if isinstance(value, dict) else value)
            if isinstance(item, dict | list)
        ]
        if not layer:
            return True
    return False
