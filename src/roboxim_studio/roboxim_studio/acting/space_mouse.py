"""A SpaceMouse's HID reports as directions of the tool. Pure: the page reads the device by WebHID.

Source of the format: ``devices.toml`` of pyspacemouse 2.1 (MIT), and recorded reports of a SpaceNavigator. Numbers are
int16, little-endian, about 350 at full deflection. Report 1 has the translation, of newer devices the rotation too;
report 2 has the rotation of older ones; report 3 has a bit for each button. The device's axes point right, to the
person and down, and its rotations are right-handed about them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

FULL = 350.0
"""Reading at full deflection."""
DEAD_ZONE = 0.1
"""Deflection below which the cap rests: a hand on it is never quite still."""
MAX_BYTES = 64
TRANSLATION, ROTATION, BUTTONS = "1", "2", "3"
"""Numbers of the reports."""


@dataclass(frozen=True, kw_only=True)
class SpaceMouse:
    """What a hand does with the device."""

    directions: tuple[float, ...] = ()
    """Translation along and rotation about x, y, z of the robot's base, -1..1; empty: it was not touched."""
    buttons: frozenset[int] = frozenset()
    """Numbers of the pressed buttons, from 0."""

    @staticmethod
    def of_reports(reports: Any) -> SpaceMouse:
        """Return what the newest report of each number says; what is not understood counts as rest.

        Args:
            reports: Number of the report to its bytes, as the page sends them.
        """
        if not isinstance(reports, Mapping):
            return SpaceMouse()
        data = {key: _bytes(reports.get(key)) for key in (TRANSLATION, ROTATION, BUTTONS)}
        moved = _numbers(data[TRANSLATION])
        turned = moved[3:6] if len(moved) >= 6 else _numbers(data[ROTATION])[:3]
        bits = int.from_bytes(data[BUTTONS], "little")
        return SpaceMouse(
            directions=(*_in_base(moved[:3]), *_in_base(turned)) if len(moved) >= 3 or len(turned) == 3 else (),
            buttons=frozenset(number for number in range(8 * len(data[BUTTONS])) if bits >> number & 1),
        )


def _in_base(values: tuple[float, ...]) -> tuple[float, ...]:
    """Return a vector right, to the person, down as one along x, y, z of the base: away, left, up."""
    if len(values) != 3:
        return (0.0, 0.0, 0.0)
    right, back, down = (_shaped(value / FULL) for value in values)
    return (-back, -right, -down)


def _shaped(value: float) -> float:
    """Return a deflection beyond the dead zone, -1..1."""
    size = min(abs(value), 1.0)
    return math.copysign(max(0.0, (size - DEAD_ZONE) / (1.0 - DEAD_ZONE)), value)


def _bytes(values: Any) -> bytes:
    """Return a list of bytes; empty when it is none."""
    if not isinstance(values, list) or len(values) > MAX_BYTES:
        return b""
    good = all(isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 256 for value in values)
    return bytes(values) if good else b""


def _numbers(data: bytes) -> tuple[float, ...]:
    return tuple(np.frombuffer(data[: len(data) // 2 * 2], "<i2").astype(float).tolist())
