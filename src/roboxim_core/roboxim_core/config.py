"""Conversion of configurations and specs from and to YAML and JSON, with validation and hashing.

`cattrs` converts between plain data and the frozen dataclasses of this package. This module adds the details of error
messages: the path of the wrong key, its line in the file, and the allowed names.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence, Sized
from enum import StrEnum
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import cattrs
import numpy as np
from cattrs.errors import AttributeValidationNote
from cattrs.gen import make_dict_structure_fn, make_dict_unstructure_fn, override

from roboxim_core import limits
from roboxim_core.config_folders import config_dir, config_dirs, named_config
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.plain_data.documents import LocatedList, LocatedMap, line_of, parse_json, parse_yaml, read_text
from roboxim_core.poses import Pose
from roboxim_core.rotation.quaternions import quat_from_euler

T = TypeVar("T")
LEFT_OUT = "LEFT_OUT_AT_DEFAULT"
"""Class variable of a dataclass: names of the fields that plain data omits at their default. A field that is added
later thus leaves existing hashes and files unchanged."""


def _is_scalar_union(kind: Any) -> bool:
    return get_origin(kind) in (Union, type(str | int)) and set(get_args(kind)) <= {str, int, float, bool}


@lru_cache(maxsize=1)
def _converter() -> cattrs.Converter:
    converter = cattrs.Converter(forbid_extra_keys=True, detailed_validation=True)

    def number(value: Any, _: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float | np.floating | np.integer):
            raise ValueError(f"expected a number, got {value!r}")
        if not np.isfinite(value):
            raise ValueError(f"expected a finite number, got {value}")
        return float(value)

    def integer(value: Any, _: Any) -> int:
        if isinstance(value, bool) or not isinstance(value, int | np.integer):
            raise ValueError(f"expected a whole number, got {value!r}")
        if not -(2**63) <= value < 2**64:
            raise ValueError(f"expected a number of 64 bits, got {limits.echo(value)}")
        return int(value)

    def exact(kind: type) -> Any:
        def check(value: Any, _: Any) -> Any:
            if not isinstance(value, kind):
                raise ValueError(f"expected {kind.__name__}, got {value!r}")
            return value

        return check

    converter.register_structure_hook(float, number)
    converter.register_structure_hook(int, integer)
    converter.register_structure_hook(str, exact(str))
    converter.register_structure_hook(bool, exact(bool))
    converter.register_structure_hook(StrEnum, lambda value, kind: kind(value))  # before that of str, its base
    converter.register_structure_hook_func(_is_scalar_union, _scalar)
    converter.register_structure_hook(Path, lambda value, _: Path(value))
    converter.register_unstructure_hook(Path, str)
    converter.register_structure_hook_factory(dataclasses.is_dataclass, lambda cls: _dataclass_hook(cls, converter))
    converter.register_unstructure_hook_factory(
        lambda cls: dataclasses.is_dataclass(cls) and hasattr(cls, LEFT_OUT), lambda cls: _shorter_hook(cls, converter)
    )
    return converter


def _type_mismatches(kind: Any, value: Any, path: tuple[Any, ...]) -> Iterator[tuple[tuple[Any, ...], str]]:
    """Yield path and message of every value that should be a list or a mapping but is not."""
    arms = [arm for arm in get_args(kind) if arm is not type(None)]
    if get_origin(kind) in (Union, type(str | int)) and len(arms) == 1:
        if value is None:
            return
        kind, arms = arms[0], list(get_args(arms[0]))
    origin, given = get_origin(kind), "nothing" if value is None else repr(value)
    if origin in (tuple, list):
        if isinstance(value, str | bytes | Mapping) or not isinstance(value, Iterable):
            yield path, f"expected a list, got {given}"
            return
        if origin is tuple and Ellipsis not in arms and isinstance(value, Sized) and len(value) != len(arms):
            yield path, f"expected {len(arms)} values, got {len(value)}"
            return
        kinds = arms if origin is tuple and Ellipsis not in arms else itertools.repeat(arms[0])
        if any(get_origin(arm) is not None for arm in arms):
            for index, (item, below) in enumerate(zip(value, kinds, strict=False)):
                yield from _type_mismatches(below, item, (*path, index))
    elif origin in (dict, Mapping):
        if not isinstance(value, Mapping):
            yield path, f"expected a mapping, got {given}"
            return
        for key, item in value.items():
            yield from _type_mismatches(arms[1], item, (*path, key))


def _is_list_of_words(kind: Any) -> bool:
    """Return whether a field is a list of words; a single word may then replace the list."""
    arms = [arm for arm in get_args(kind) if arm is not type(None)]
    if get_origin(kind) in (Union, type(str | int)) and len(arms) == 1:
        return _is_list_of_words(arms[0])
    return get_origin(kind) is tuple and arms == [str, Ellipsis]


def _dataclass_hook(cls: Any, converter: cattrs.Converter) -> Any:
    """Return the structure hook of a dataclass, which first checks the places of lists and mappings.

    Without this check, cattrs would accept a string as the list of its letters. In place of a list of words, a single
    word is accepted; a class with a method ``from_short`` accepts other short forms.
    """
    build = make_dict_structure_fn(cls, converter, _cattrs_forbid_extra_keys=True)
    hints = get_type_hints(cls)
    kinds = {field.name: hints[field.name] for field in dataclasses.fields(cls)}

    lists = [name for name, kind in kinds.items() if _is_list_of_words(kind)]

    def structure(value: Any, _: Any) -> Any:
        if not isinstance(value, Mapping) and hasattr(cls, "from_short"):
            value = cls.from_short(value)
        if not isinstance(value, Mapping):
            raise ValueError(f"expected a mapping with keys of {', '.join(kinds)}; got {value!r}")
        if cls is Pose:
            value = _with_quaternion(value)
        if single := {name: [value[name]] for name in lists if isinstance(value.get(name), str)}:
            value = {**value, **single}
        mismatches = [m for name in value if name in kinds for m in _type_mismatches(kinds[name], value[name], (name,))]
        if mismatches:
            errors = [_at_path(ValueError(text), path, cls) for path, text in mismatches]
            raise cattrs.ClassValidationError(f"while structuring {cls.__name__}", errors, cls)
        return build(value, cls)

    return structure


def _shorter_hook(cls: Any, converter: cattrs.Converter) -> Any:
    """Return the unstructure hook of a dataclass with fields that are left out while they have their defaults."""
    shorter: dict[str, Any] = {name: override(omit_if_default=True) for name in getattr(cls, LEFT_OUT)}
    return make_dict_unstructure_fn(cls, converter, **shorter)


def _at_path(error: Exception, path: Sequence[Any], cls: Any) -> Exception:
    """Return an error wrapped as cattrs would raise it for the value at a path."""
    *above, last = path
    error.__notes__ = [AttributeValidationNote(str(last), last, None)]
    return _at_path(cattrs.ClassValidationError(f"at {last}", [error], cls), above, cls) if above else error


def _with_quaternion(pose: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a pose's mapping with ``quat_xyzw`` instead of ``rpy_deg`` (roll, pitch, yaw about the fixed axes)."""
    if "rpy_deg" not in pose:
        return pose
    angles = pose["rpy_deg"]
    if "quat_xyzw" in pose:
        raise ValueError("a pose has rpy_deg or quat_xyzw, not both")
    if not isinstance(angles, list | tuple) or len(angles) != 3 or not all(isinstance(a, int | float) for a in angles):
        raise ValueError(f"rpy_deg must be roll, pitch and yaw in degrees, got {angles!r}")
    quat = quat_from_euler(*(math.radians(angle) for angle in angles))
    rest = {name: pose[name] for name in pose if name != "rpy_deg"}
    return {**rest, "quat_xyzw": [round(q, 12) for q in quat]}


def _scalar(value: Any, kind: Any) -> Any:
    kinds = get_args(kind)
    exact = bool if isinstance(value, bool) else next((k for k in (str, int, float) if isinstance(value, k)), None)
    if exact is int and int not in kinds:
        exact = float
    if exact in (int, float) and not -(2**63) <= value < 2**64:
        raise ValueError(f"expected a finite number of 64 bits, got {limits.echo(value)}")
    if exact is not None and exact in kinds:
        return exact(value)
    raise ValueError(f"expected {' or '.join(k.__name__ for k in kinds)}, got {value!r}")


def to_plain(value: Any) -> Any:
    """Convert a dataclass to dicts, lists and scalars that YAML and JSON can hold."""
    return _converter().unstructure(value)


def from_plain(data: Any, cls: type[T], *, source: str = "configuration", path: str = "", line: str = "") -> T:
    """Build a value of a dataclass from plain data.

    Args:
        data: Dicts, lists, scalars, from `to_plain` or from YAML.
        cls: The class to build.
        source: Origin of the data, for messages, e.g. a file's name.
        path: Path of the data in the source, for messages, e.g. ``reset.lights``; empty: the whole source.
        line: Line of the data, in the format of `line_of`.

    Raises:
        ConfigError: Listing every wrong key with its path, its line if known, the problem, and the allowed values.
    """
    try:
        return _converter().structure(data, cls)
    except Exception as error:  # cattrs raises exception groups and the exceptions of __post_init__
        problems = _explain(error, data, f"{path}." if path else "", line, cls)
        raise ConfigError(f"{source} is not valid: " + "; ".join(problems)) from None


def _explain(error: BaseException, data: Any, path: str, line: str, cls: Any) -> list[str]:
    """Return one message per wrong key.

    Args:
        error: The error that cattrs, or a class, raised for the data.
        data: The part of the data that the error is about.
        path: Path of that part, with a dot at its end; empty: the whole data.
        line: Line of the nearest enclosing key that has one.
        cls: The class to build.
    """
    if isinstance(error, cattrs.errors.ForbiddenExtraKeysError):
        names = [f.name for f in dataclasses.fields(error.cl)]
        return [
            f"{_where(f'{path}{key}', line_of(data, key) or line)}unknown key; {one_of(names, str(key))}"
            for key in sorted(error.extra_fields, key=str)
        ]
    if isinstance(error, cattrs.BaseValidationError):
        problems: list[str] = []
        for sub in error.exceptions:
            note = next((n for n in getattr(sub, "__notes__", []) if hasattr(n, "name") or hasattr(n, "index")), None)
            step = getattr(note, "name", None)
            if step is None:
                step = getattr(note, "index", None)
            below = data
            if step is not None and isinstance(data, Mapping | list | tuple):
                try:
                    below = data[step]
                except (KeyError, IndexError, TypeError):
                    below = None
            nested = isinstance(sub, cattrs.BaseValidationError | cattrs.errors.ForbiddenExtraKeysError)
            if step is None or isinstance(sub, cattrs.errors.ForbiddenExtraKeysError):
                problems += _explain(sub, data, path, line, cls)
            elif nested:
                problems += _explain(sub, below, f"{path}{step}.", line_of(data, step) or line, cls)
            else:
                problems.append(f"{_where(f'{path}{step}', line_of(data, step) or line)}{_error_text(sub)}")
        return problems
    text = _error_text(error)
    return [f"{_where(*complaint_at(text, data, path.rstrip('.'), line))}{text}"]


def complaint_at(complaint: str, data: Any, path: str, line: str) -> tuple[str, str]:
    """Return the path and the line of the key that a class's error message is about.

    Args:
        complaint: The message. It begins with the key, e.g. ``areas.left must be ...``, or names no other key.
        data: The data that the class was built from.
        path: Path of the data.
        line: Line of the data, returned if no line of the key is known.
    """
    mentioned = [key for key in data if str(key) in re.findall(r"\w+", complaint)] if isinstance(data, Mapping) else []
    first = re.match(r"[A-Za-z_][\w.]*", complaint)
    keys: list[Any] = first[0].rstrip(".").split(".") if first else []
    if len(mentioned) == 1 and (not keys or keys[0] not in data):
        keys = mentioned
    for key in keys:
        if not isinstance(data, Mapping) or key not in data:
            break
        path, line = f"{path}.{key}" if path else str(key), line_of(data, key) or line
        data = data[key]
    return path, line


def _error_text(error: BaseException) -> str:
    if isinstance(error, KeyError):
        return "required key is missing"
    return str(error)


def _where(path: str, line: str) -> str:
    if not path:
        return f"{line}: " if line else ""
    return f"{path} ({line}): " if line else f"{path}: "


def located(data: Any, file: str) -> Any:
    """Return YAML data whose lines name their file, so that it can be combined with data of other files."""

    def lines(keys: Iterable[Any]) -> dict[Any, str]:
        return {key: " of ".join(part for part in (line_of(data, key), file) if part) for key in keys}

    if isinstance(data, Mapping):
        return LocatedMap({key: located(value, file) for key, value in data.items()}, lines(data))
    if isinstance(data, list | tuple):
        return LocatedList((located(value, file) for value in data), lines(range(len(data))))
    return data


def place(data: Any, path: Iterable[str | int]) -> str:
    """Return a key's path with the line of the nearest key that has one, e.g. ``objects.target (line 3)``."""
    keys = list(path)
    return _where(".".join(map(str, keys)), section_of(data, keys)[1]).removesuffix(": ")


def section_of(data: Any, path: Iterable[str | int]) -> tuple[Any, str]:
    """Return the value at a path (None if there is none) and its line, or that of the nearest enclosing key."""
    line = ""
    for key in path:
        line = line_of(data, key) or line
        try:
            data = data[key]
        except (KeyError, IndexError, TypeError):
            data = None
    return data, line


def load_yaml(path: Path | str) -> Any:
    """Read a YAML file, keeping line numbers for messages.

    Raises:
        ConfigError: When the file is missing, is not YAML, or exceeds the bounds of `roboxim_core.limits`.
    """
    return parse_yaml(read_text(path), source=str(path))


def load_config(path: Path | str, cls: type[T]) -> T:
    """Read a YAML file into a dataclass.

    Raises:
        ConfigError: When the file is missing, is not YAML, or does not fit the class.
    """
    data = load_yaml(path)
    return from_plain({} if data is None else data, cls, source=str(path))


def to_json(value: Any) -> str:
    """Serialise a spec as canonical JSON: sorted keys, no spaces, shortest floats."""
    return json.dumps(to_plain(value), sort_keys=True, separators=(",", ":"), allow_nan=False)


def from_json(text: str, cls: type[T], *, source: str = "JSON") -> T:
    """Build a value of a dataclass from JSON text.

    Raises:
        ConfigError: When the text is not JSON or does not fit the class.
    """
    data = parse_json(text, source=source)
    return from_plain(data, cls, source=source)


def digest(value: Any) -> str:
    """Return a stable hash of a spec, 16 hexadecimal digits."""
    return hashlib.blake2b(to_json(value).encode(), digest_size=8).hexdigest()


__all__ = [
    "LocatedMap",
    "complaint_at",
    "config_dir",
    "config_dirs",
    "digest",
    "from_json",
    "from_plain",
    "line_of",
    "load_config",
    "load_yaml",
    "located",
    "named_config",
    "parse_yaml",
    "place",
    "section_of",
    "to_json",
    "to_plain",
]
