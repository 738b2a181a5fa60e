"""Mutations of files that are read, or refused by a `RoboximError`; 8 run always, more with a marker."""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable
from pathlib import Path

from roboxim_core.errors import RoboximError

FEW, CI, MANY = 8, 100, 2000


def accepted(read: Callable[[], object]) -> bool:
    """Read; return whether it was accepted. Only a `RoboximError` may refuse."""
    try:
        read()
    except RoboximError:
        return False
    return True


def mutated_bytes(data: bytes, rng: random.Random) -> bytes:
    """Return bytes with one change: cut, a gap, a repeat, other bytes, nothing."""
    if not data:
        return b"\0"
    at, size = rng.randrange(len(data)), rng.randint(1, max(1, min(64, len(data))))
    kind = rng.choice(("flip", "cut", "gap", "repeat", "insert", "zero", "empty"))
    if kind == "flip":
        return data[:at] + bytes([data[at] ^ (1 << rng.randrange(8))]) + data[at + 1 :]
    if kind == "cut":
        return data[:at]
    if kind == "gap":
        return data[:at] + data[at + size :]
    if kind == "repeat":
        return data[: at + size] + data[at:]
    if kind == "insert":
        return data[:at] + rng.randbytes(size) + data[at:]
    if kind == "zero":
        return data[:at] + bytes(size) + data[at + size :]
    return b""


def run(fuzz: Callable[[Path, random.Random], None], folder: Path, name: str, numbers: range) -> None:
    """Run numbered mutations of a format, each in a folder of its own."""
    for number in numbers:
        place = folder / f"objects{number}"
        place.mkdir()
        try:
            fuzz(place, random.Random(f"{name} {number}"))
        except Exception as error:
            raise AssertionError(f"mutation {number} of {name}, in {place}") from error
        shutil.rmtree(place)
