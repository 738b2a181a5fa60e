"""Enumerations of words that come from outside."""

from __future__ import annotations

from enum import StrEnum

from roboxim_core.errors import one_of


class ClosedEnum(StrEnum):
    """Enumeration whose error message lists the known values."""

    @classmethod
    def _missing_(cls, value: object) -> None:
        raise ValueError(f"unknown value {value!r}; {one_of(list(cls), str(value))}")
