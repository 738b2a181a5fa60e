"""Normalisation of actions by a dataset's statistics, for policies that answer in normalised numbers.

Most servers un-normalise themselves, given a key (``unnorm_key``); their conventions have no `Normalisation`. The
numbers come from the YAML, or from the statistics file that a dataset or a checkpoint has: `Normalisation.resolved`
reads it, so that a loaded convention is complete and no longer depends on the file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from roboxim_core.errors import ConfigError, InvalidRequestError, one_of
from roboxim_core.plain_data.closed_enum import ClosedEnum
from roboxim_core.plain_data.documents import parse_json, read_text
from roboxim_core.rotation.representations import Floats
from roboxim_core.user_folders import expanded


class NormalisationKind(ClosedEnum):
    """How numbers were normalised."""

    QUANTILES = "quantiles"
    """q01 becomes -1 and q99 becomes 1 (OpenVLA's ``bounds_q99``)."""
    BOUNDS = "bounds"
    """min becomes -1 and max becomes 1."""
    MEAN_STD = "mean_std"
    """Mean 0 and standard deviation 1 (Octo's ``normal``)."""


_NAMES = {
    NormalisationKind.QUANTILES: ("q01", "q99"),
    NormalisationKind.BOUNDS: ("min", "max"),
    NormalisationKind.MEAN_STD: ("mean", "std"),
}


@dataclass(frozen=True, kw_only=True)
class Normalisation:
    """Linear map between the policy's numbers and the dataset's."""

    kind: NormalisationKind
    """How numbers were normalised."""
    file: str = ""
    """JSON file with the statistics, relative to the YAML file: ``{"action": {"q01": [...], ...}}``, or the same below
    a dataset's name, as in ``dataset_statistics.json`` of Octo and OpenVLA. Empty: ``first`` and ``second`` are
    given."""
    dataset: str = ""
    """Name of the dataset in the file; empty if the file holds one."""
    feature: str = "action"
    """Name of the action's statistics in the file."""
    first: tuple[float, ...] = ()
    """q01, min or mean, one number per component of the action."""
    second: tuple[float, ...] = ()
    """q99, max or standard deviation, one number per component of the action."""
    mask: tuple[bool, ...] = ()
    """Which components are normalised; empty: all. The gripper usually is not."""

    def __post_init__(self) -> None:
        """Check that there are numbers, or a file to take them from.

        Raises:
            InvalidRequestError: On lists of different lengths, or bounds in the wrong order.
        """
        for name in ("first", "second", "mask"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        low, high = _NAMES[self.kind]
        if not self.first and not self.file:
            raise InvalidRequestError(f"normalisation needs a file, or first ({low}) and second ({high})")
        if len(self.first) != len(self.second) or (self.first and len(self.mask) not in (0, len(self.first))):
            raise InvalidRequestError(
                f"normalisation: first, second and mask must have one length, got {len(self.first)}, "
                f"{len(self.second)} and {len(self.mask)}"
            )
        for index, (a, b) in enumerate(zip(self.first, self.second, strict=True)):
            if not (np.isfinite([a, b]).all() and (b >= 0 if self.kind == NormalisationKind.MEAN_STD else b >= a)):
                raise InvalidRequestError(f"normalisation: component {index} has {low} {a:g} and {high} {b:g}")

    def resolved(self, folder: Path) -> Normalisation:
        """Return the normalisation with the file's numbers.

        Args:
            folder: Folder that a relative path starts at.

        Raises:
            ConfigError: When the file lacks them; the message lists its content.
        """
        if self.first:
            return self
        path = folder / expanded(self.file)
        data = parse_json(read_text(path), source=str(path))
        data = _entry(data, self.dataset, path) if self.dataset else data
        found = _entry(data, self.feature, path)
        first, second = (_numbers(found, name, path) for name in _NAMES[self.kind])
        mask = tuple(bool(m) for m in found["mask"]) if "mask" in found and not self.mask else self.mask
        try:
            return replace(self, first=first, second=second, mask=mask)
        except InvalidRequestError as error:
            raise ConfigError(f"{path}: {error}") from None

    def invert(self, rows: Floats) -> Floats:
        """Un-normalise rows, shape (n, D)."""
        centre, half, mask = self._line()
        return np.where(mask, centre + rows * half, rows)

    def apply(self, rows: Floats) -> Floats:
        """Normalise rows, shape (n, D). A component that was constant in the dataset becomes 0."""
        centre, half, mask = self._line()
        flat = half == 0.0
        return np.where(mask, np.where(flat, 0.0, (rows - centre) / np.where(flat, 1.0, half)), rows)

    def _line(self) -> tuple[Floats, Floats, Any]:
        """Return the value of 0, the distance from 0 to 1, and the mask."""
        first, second = np.array(self.first), np.array(self.second)
        mask = np.array(self.mask or (True,) * len(first))
        if self.kind == NormalisationKind.MEAN_STD:
            return first, second, mask
        return (first + second) / 2, (second - first) / 2, mask


def _entry(data: Any, name: str, path: Path) -> Mapping[str, Any]:
    found = data.get(name) if isinstance(data, Mapping) else None
    if not isinstance(found, Mapping):
        names = [str(key) for key in data] if isinstance(data, Mapping) else []
        raise ConfigError(f"{path} has no statistics '{name}'; {one_of(names, name)}")
    return found


def _numbers(found: Mapping[str, Any], name: str, path: Path) -> tuple[float, ...]:
    values = found.get(name)
    if not isinstance(values, list) or not all(isinstance(v, int | float) for v in values):
        raise ConfigError(f"{path} has no list of numbers '{name}'; {one_of([str(key) for key in found], name)}")
    return tuple(float(value) for value in values)
