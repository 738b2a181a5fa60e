"""Readers of untrusted YAML and JSON text, with bounds, so that no document fills the memory or causes a traceback.

A few lines of YAML whose aliases repeat each other can expand to billions of values, and deep nesting makes a recursive
reader raise ``RecursionError``. Values and levels are therefore counted before anything is built.

YAML is parsed by libyaml: it takes a thirteenth of the time of a parser in Python, and a command reads up to a hundred
files. libyaml's grammar is that of YAML 1.1. Plain scalars, however, have the meaning of YAML 1.2: ``yes`` and ``on``
are text, ``017`` is 17.
"""

from __future__ import annotations

import codecs
import json
import os
import re
import stat
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NoReturn

import yaml

from roboxim_core import limits
from roboxim_core.errors import ConfigError

_BYTE_ORDER_MARKS = (
    (codecs.BOM_UTF32_LE, "UTF-32"), (codecs.BOM_UTF32_BE, "UTF-32"),  # before those of UTF-16, which they begin with
    (codecs.BOM_UTF16_LE, "UTF-16"), (codecs.BOM_UTF16_BE, "UTF-16"),
)  # fmt: skip
"""Byte order marks and their encodings."""


def read_text(path: Path | str, max_bytes: int = limits.YAML_BYTES) -> str:
    """Read a text file: UTF-8, or UTF-16 or UTF-32 with a byte order mark, as the YAML specification has it.

    Args:
        path: The file.
        max_bytes: Largest size [bytes].

    Raises:
        ConfigError: When it is missing, too large or of another encoding.
    """
    file = Path(path)
    encoding = "UTF-8"
    try:
        with open(file, "rb") as stream:
            about = os.fstat(stream.fileno())  # read() allocates memory for the requested size
            limit = min(max_bytes, max(about.st_size, 2**16)) if stat.S_ISREG(about.st_mode) else max_bytes
            content = stream.read(limit + 1)
        if len(content) > max_bytes:
            raise ConfigError(f"{file} is larger than {max_bytes} bytes")
        encoding = next((name for mark, name in _BYTE_ORDER_MARKS if content.startswith(mark)), encoding)
        return content.decode(encoding).removeprefix("\ufeff")
    except (OSError, ValueError) as error:
        if isinstance(error, UnicodeDecodeError):
            line = content[: error.start].count(b"\n") + 1
            raise ConfigError(
                f"{file} line {line}: not {encoding} text: {error.reason}; save the file as UTF-8"
            ) from None
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
        return yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        last = max(1, len(text.splitlines()))  # a list that is never closed ends on the line after it
        line = f" line {min(mark.line + 1, last)}" if mark else ""
        problem = ": ".join(part for part in (error.context, error.problem) if part)
        raise ConfigError(f"{source}{line}: not valid YAML: {limits.printable(problem)}") from None
    except yaml.YAMLError as error:
        raise ConfigError(f"{source}: not valid YAML: {limits.printable(str(error))}") from None
    except (ValueError, TypeError, OverflowError) as error:  # e.g. an impossible date, an integer of 5,000 digits
        raise ConfigError(f"{source}: not valid YAML: {limits.printable(str(error))}") from None


class LocatedMap(dict[Any, Any]):
    """A mapping with the line of each key; the keys may come from several files."""

    def __init__(self, items: Mapping[Any, Any], lines: Mapping[Any, str]) -> None:
        """Make a mapping.

        Args:
            items: Its content.
            lines: Key to its line, in the format of `line_of`.
        """
        super().__init__(items)
        self.lines: dict[Any, str] = dict(lines)


class LocatedList(list[Any]):
    """A list with the line of each item."""

    def __init__(self, items: Iterable[Any], lines: Mapping[Any, str]) -> None:
        """Make a list.

        Args:
            items: Its content.
            lines: Index to the item's line, in the format of `line_of`.
        """
        super().__init__(items)
        self.lines: dict[Any, str] = dict(lines)


def line_of(data: Any, key: Any) -> str:
    """Return the line of a mapping's key or a list's item, e.g. ``line 3``; empty if it is not known."""
    return data.lines.get(key, "") if isinstance(data, LocatedMap | LocatedList) else ""


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]  # SafeLoader: PyYAML without libyaml
    """Builds located mappings and lists, with the plain scalars of YAML 1.2; refuses duplicate keys."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012  (not those of YAML 1.1, which PyYAML would inherit)

    def construct_map(self, node: Any) -> LocatedMap:
        """Build a mapping."""
        if not isinstance(node, yaml.MappingNode):
            raise _wrong("expected a mapping", node)
        own = [pair for pair in node.value if pair[0].tag != MERGE]
        node.value = [pair for pair in node.value if pair[0].tag == MERGE]
        self.flatten_mapping(node)  # replaces the keys << by what they name
        items: dict[Any, Any] = {}
        lines: dict[Any, str] = {}
        for key_node, value_node in own:
            key = self.construct_object(key_node, deep=True)
            if isinstance(key, dict | list):
                raise _wrong("a key must be one value, not a mapping or a list", key_node)
            if key in items:
                raise _wrong(f"the key '{key}' occurs twice in one mapping", key_node)
            items[key] = self.construct_object(value_node, deep=True)
            lines[key] = f"line {key_node.start_mark.line + 1}"
        merged = {self.construct_object(pair[0], deep=True): pair for pair in node.value}
        others = [(key, pair) for key, pair in merged.items() if key not in items]
        for key, (key_node, value_node) in others:
            items[key] = self.construct_object(value_node, deep=True)
            lines[key] = f"line {key_node.start_mark.line + 1}"
        node.value = own + [pair for _, pair in others]  # read again where an alias names this mapping
        return LocatedMap(items, lines)

    def construct_list(self, node: Any) -> LocatedList:
        """Build a list."""
        items = self.construct_sequence(node, deep=True)
        return LocatedList(items, {k: f"line {item.start_mark.line + 1}" for k, item in enumerate(node.value)})

    def construct_integer(self, node: Any) -> int:
        """Build an integer: decimal also with zeros in front, ``0o17``, ``0x1f`` or ``0b101``."""
        text = str(self.construct_scalar(node)).replace("_", "")
        return int(text, 0) if re.match(r"[-+]?0[box]", text) else int(text)


def _wrong(problem: str, node: Any) -> yaml.MarkedYAMLError:
    return yaml.constructor.ConstructorError(None, None, problem, node.start_mark)


MERGE = "tag:yaml.org,2002:merge"
_SCALARS = {
    "bool": ("tTfF", r"true|True|TRUE|false|False|FALSE"),
    "int": ("-+0123456789", r"[-+]?0b[01_]+|[-+]?0o[0-7_]+|[-+]?0x[0-9a-fA-F_]+|[-+]?[0-9][0-9_]*"),
    "float": (
        "-+.0123456789",
        r"[-+]?[0-9][0-9_]*\.[0-9_]*([eE][-+]?[0-9]+)?|[-+]?[0-9][0-9_]*[eE][-+]?[0-9]+"
        r"|[-+]?\.[0-9][0-9_]*([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
    ),
    "null": (["~", "n", "N", ""], r"~|null|Null|NULL|"),
    "merge": ("<", r"<<"),
    "timestamp": (
        "0123456789",
        r"\d{4}-\d\d-\d\d|\d{4}-\d\d?-\d\d?([Tt]|[ \t]+)\d\d?:\d\d:\d\d(\.\d*)?([ \t]*(Z|[-+]\d\d?(:\d\d)?))?",
    ),
}
"""Kind of a plain scalar to its first characters and its pattern in YAML 1.2."""
for _kind, (_first, _pattern) in _SCALARS.items():
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_kind}", re.compile(f"(?:{_pattern})$", re.ASCII), list(_first))
_Loader.add_constructor("tag:yaml.org,2002:map", _Loader.construct_map)
_Loader.add_constructor("tag:yaml.org,2002:seq", _Loader.construct_list)
_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_integer)


def _check_size(text: str, source: str) -> None:
    """Refuse a document with too many values or levels, including those that its aliases repeat."""
    known: dict[str, tuple[int, int]] = {}
    open_nodes: list[_Node] = []
    total = 0
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.SequenceStartEvent | yaml.MappingStartEvent):
            open_nodes.append(_Node(event.anchor))
            values, levels = 1, 1
        elif isinstance(event, yaml.AliasEvent):
            if any(node.anchor == event.anchor for node in open_nodes):
                _refuse(source, event, f"alias '*{event.anchor}' is inside the value that it repeats")
            values, levels = known.get(event.anchor, (1, 1))
        elif isinstance(event, yaml.ScalarEvent):
            values, levels = 1, 1
            if event.anchor:
                known[event.anchor] = (1, 1)
        elif isinstance(event, yaml.SequenceEndEvent | yaml.MappingEndEvent):
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
            _refuse(source, event, f"more than {limits.DOCUMENT_NODES} values, including those that aliases repeat")
        if len(open_nodes) + levels - 1 > limits.DOCUMENT_DEPTH:
            _refuse(source, event, f"more than {limits.DOCUMENT_DEPTH} levels of nesting")
        inside = open_nodes[:-1] if isinstance(event, yaml.SequenceStartEvent | yaml.MappingStartEvent) else open_nodes
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


def parse_json(text: str, *, source: str = "JSON", max_bytes: int = limits.DOCUMENT_BYTES) -> Any:
    """Parse JSON text.

    Args:
        text: The text.
        source: Origin of the text, for messages.
        max_bytes: Largest size [characters].

    Raises:
        ConfigError: When it is not JSON (NaN and infinities are not JSON), too large or nested too deep.
    """
    if len(text) > max_bytes:
        raise ConfigError(f"{source} is larger than {max_bytes} characters, got {len(text)}")

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


def read_json(path: Path | str, max_bytes: int = limits.DOCUMENT_BYTES) -> Any:
    """Read a JSON file.

    Args:
        path: The file.
        max_bytes: Largest size [bytes].

    Raises:
        ConfigError: Naming the file, as `read_text` and `parse_json`.
    """
    return parse_json(read_text(path, max_bytes), source=str(path), max_bytes=max_bytes)


def read_json_object(path: Path | str, max_bytes: int = limits.DOCUMENT_BYTES) -> dict[str, Any]:
    """Read a JSON file that holds an object; arguments as `read_json`.

    Raises:
        ConfigError: As `read_json`, and when it holds something else.
    """
    data = read_json(path, max_bytes)
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
