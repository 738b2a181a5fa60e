"""Random messages of the fuzzer, made field by field from the interface definitions."""

from __future__ import annotations

import array
import importlib
import random
import re
from typing import Any

import numpy as np

FLOATS = (
    0.0, -0.0, 1.0, -1.0, 0.5, 1e-9, 1e9, 100.0, float("nan"), float("inf"), float("-inf"), 1e308, -1e308, 5e-324,
)  # fmt: skip
NAMES = (
    "", "robot", "table", "world", "tcp", "latest", "red_cube", "cube", "apple", "panda", "ur5", "raster", "tiny",
    "demo", "eval", "test", "expert", "policy", "sim", "panda_link0", "panda_joint1", "panda_joint7",
    "workspace", "wrist", "pick_up", "all", "none", "successful", "keep", "drop", "RRTConnect", "BITstar", "home",
    "target", "fuzz", "nobody",
)  # fmt: skip
HOSTILE = (
    "x" * 300, "x" * 9_999, "x" * 70_000, "/", "..", "../../../../etc/passwd", "a/b", "a b\n", "\t", "naïve 🤖", "%s%n",
    "(a+)+$", "[", "{", "[" * 5_000, '{"a": NaN}', "null", "1e999", '"\\ud800"', "&a [*a]", "{scene: {}}",
    "a: &a [x, x, x]\nb: &b [*a, *a, *a]\nc: [*b, *b]", "cells: [{tasks: [pick_cube], episodes: 1000000000}]",
    "skill: pick_up", "skill: nonsense", "!!python/object/apply:os.system ['true']", "roboxim://cube?scale=nan",
    "roboxim://cube?color=red&scale=1e9", "http://cube",
)  # fmt: skip
INT_BITS = re.compile(r"(u?)int(\d+)")


class Maker:
    """Creates random messages from their definitions."""

    def __init__(self, rng: random.Random) -> None:
        """Make nothing yet."""
        self.rng = rng
        self._small = False

    def message(self, cls: Any, depth: int = 0) -> Any:
        """Return a message with random values in every field."""
        msg = cls()
        for name, kind in cls.get_fields_and_field_types().items():
            setattr(msg, name, self.value(kind, depth))
        return msg

    def value(self, kind: str, depth: int = 0) -> Any:
        """Return a random value of a type, named as in `get_fields_and_field_types`."""
        if found := re.fullmatch(r"sequence<(.+?)(?:, *(\d+))?>", kind):
            return self._sequence(found[1], int(found[2]) if found[2] else None, depth)
        if found := re.fullmatch(r"(.+)\[(\d+)\]", kind):
            items = [self.value(found[1], depth + 1) for _ in range(int(found[2]))]
            return np.array(items, dtype=_numpy_type(found[1])) if "/" not in found[1] else items
        if "/" in kind:
            return self.message(_message_class(kind), depth + 1)
        return self._scalar(kind)

    def _scalar(self, kind: str) -> Any:
        rng = self.rng
        if kind == "boolean":
            return rng.random() < 0.5
        if kind in ("float", "double"):
            return rng.choice(FLOATS) if rng.random() < 0.7 else rng.uniform(-2, 2)
        if kind.startswith(("string", "wstring")):
            roll = rng.random()
            if roll < 0.6 or self._small:
                return rng.choice(NAMES)
            if roll < 0.9:
                return rng.choice(HOSTILE)
            return rng.randbytes(rng.randrange(200)).decode("utf-8", "replace").replace("\0", "?")
        if kind == "octet":
            return bytes([rng.randrange(256)])
        low, high = _int_range(kind)
        value = rng.choice((0, 1, 2, 3, 7, 100, -1, low, high, high - 1, rng.randint(low, high)))
        return min(max(value, low), high)

    def _sequence(self, element: str, most: int | None, depth: int) -> Any:
        composed = "/" in element or element.startswith("string")
        sizes = (0, 0, 1, 1, 2, 3) if depth > 2 else (0, 1, 1, 2, 3, 7)
        size = 0 if self._small else self.rng.choice(sizes)
        if not composed and not self._small and self.rng.random() < 0.1:
            size = self.rng.choice((1_000, 100_000))
        if composed and depth == 0 and self.rng.random() < 0.03:
            size = 12_000
        size = min(size, most) if most is not None else size
        if composed:
            self._small, before = self._small or size > 7, self._small  # a message of gigabytes tests the sender
            first = [self.value(element, depth + 1) for _ in range(min(size, 7))]
            self._small = before
            return first if size <= 7 else (first * (size // 7 + 1))[:size]
        items = [self._scalar(element) for _ in range(min(size, 50))]
        items = items if size <= 50 else (items * (size // 50 + 1))[:size]
        code = _array_code(element)
        return array.array(code, items) if code else items

    def mutate(self, msg: Any) -> str:
        """Change one random field of a message and return the field's path."""
        cls = type(msg)
        name, kind = self.rng.choice(sorted(cls.get_fields_and_field_types().items()) or [("", "")])
        if not name:
            return ""
        value = getattr(msg, name)
        if "/" in kind and not kind.startswith("sequence") and "[" not in kind:
            return f"{name}.{self.mutate(value)}"
        if kind.startswith("sequence") and "/" in kind and len(value) and self.rng.random() < 0.85:
            return f"{name}.{self.mutate(self.rng.choice(list(value)))}"
        setattr(msg, name, self.value(kind))
        return name


def _int_range(kind: str) -> tuple[int, int]:
    found = INT_BITS.fullmatch(kind)
    if found is None:
        return (0, 255)
    bits = int(found[2])
    return (0, 2**bits - 1) if found[1] else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)


def _numpy_type(kind: str) -> Any:
    return {"double": np.float64, "float": np.float32, "boolean": np.bool_}.get(kind) or np.dtype(kind)


def _array_code(kind: str) -> str:
    codes = {"double": "d", "float": "f", "uint8": "B", "int8": "b", "uint16": "H", "int16": "h"}
    return {**codes, "uint32": "I", "int32": "i", "uint64": "Q", "int64": "q"}.get(kind, "")


def _message_class(kind: str) -> Any:
    package, _, name = kind.partition("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def interface(kind: str) -> Any:
    """Import the class of ``package/srv/Name`` or ``package/action/Name``."""
    package, middle, name = kind.split("/")
    return getattr(importlib.import_module(f"{package}.{middle}"), name)
