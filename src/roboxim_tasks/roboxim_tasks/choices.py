"""Configuration of a value that varies: a list in order or at random, or a range.

An ordered list is a function of the episode's index, so that all workers draw the same value and a retried index stays
in its cell. A range or a random list draws from the component's own random stream.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ConfigError, one_of
from roboxim_core.poses import Array
from roboxim_core.specs import Scalar

ORDERS = ("random", "in_order")


@dataclass(frozen=True, kw_only=True)
class Choice:
    """A scalar: one of ``values``, or a number in the range ``lower`` to ``upper``."""

    values: tuple[Scalar, ...] = ()
    """Values to choose from; empty: the range."""
    lower: float | None = None
    """Lower end of the range."""
    upper: float | None = None
    """Upper end of the range."""
    order: str = "random"
    """``random``, or ``in_order``: value ``index % len(values)``."""
    weights: tuple[float, ...] = ()
    """Relative frequency of each of ``values``; empty: all equal."""

    @staticmethod
    def from_short(value: Any) -> Any:
        """Return the mapping for which a list of values or a single value stands, e.g. ``0.6``."""
        return {"values": value if isinstance(value, list) else [value]}

    def __post_init__(self) -> None:
        """Check that there is either a list or a range.

        Raises:
            ConfigError: When both or neither are given, or their values are invalid.
        """
        _check(bool(self.values), self.lower, self.upper, self.order)
        if self.lower is not None and self.upper is not None and self.lower > self.upper:
            raise ConfigError(f"lower must not be above upper, got {self.lower:g} and {self.upper:g}")
        if self.weights:
            if len(self.weights) != len(self.values) or min(self.weights) < 0 or sum(self.weights) <= 0:
                raise ConfigError(
                    f"weights must be one number >= 0 for each of the {len(self.values)} values, not all 0; "
                    f"got {list(self.weights)}"
                )
            if self.order == "in_order":
                raise ConfigError("weights are for values at random, which come in_order here; give one of the two")

    @property
    def ends(self) -> tuple[Scalar, ...]:
        """The values of the list, or both ends of the range."""
        if self.values:
            return self.values
        assert self.lower is not None
        assert self.upper is not None
        return self.lower, self.upper

    @property
    def drawable(self) -> tuple[Scalar, ...]:
        """The values of the list that can be drawn: those whose weight is not 0."""
        return tuple(
            v for v, weight in zip(self.values, self.weights or [1.0] * len(self.values), strict=True) if weight
        )

    @property
    def ordered(self) -> int:
        """Number of values that come in order; 0 when they come at random, or when there is only one."""
        return len(self.values) if self.order == "in_order" and len(self.values) > 1 else 0

    @property
    def varies(self) -> bool:
        """Whether repeated draws may differ."""
        return self.order == "random" and len(self.drawable) != 1

    def require_numbers(self, name: str, lower: float = -math.inf, upper: float = math.inf) -> None:
        """Refuse values that are no numbers, or out of range.

        Raises:
            ConfigError: When a value is invalid; names the key and the range.
        """
        for value in self.ends:
            if isinstance(value, str | bool) or not lower <= value <= upper:
                limits = f" from {lower:g} to {upper:g}" if math.isfinite(upper) else ""
                limits = f" >= {lower:g}" if math.isfinite(lower) and not limits else limits
                raise ConfigError(f"{name} must be a number{limits}, got {value!r}")

    def require_words(self, name: str, of_what: str) -> None:
        """Refuse a range, and values that are no text.

        Raises:
            ConfigError: When a value is invalid; names the key and the expected kind of text.
        """
        wrong = next((value for value in self.ends if not isinstance(value, str)), None)
        if wrong is not None:
            raise ConfigError(f"{name} must be values, {of_what}, not {'a range' if not self.values else repr(wrong)}")

    def only(self, allowed: Collection[Scalar]) -> Choice | None:
        """Return the choice restricted to allowed values; none if no value is left."""
        kept = [i for i, value in enumerate(self.values) if value in allowed]
        weights = tuple(self.weights[i] for i in kept) if self.weights else ()
        if len(kept) == len(self.values):
            return self
        if not kept or (weights and sum(weights) <= 0):
            return None
        return replace(self, values=tuple(self.values[i] for i in kept), weights=weights)

    def draw(self, rng: np.random.Generator, index: int) -> Scalar:
        """Draw a value.

        Args:
            rng: Random stream of the calling component.
            index: Index of the episode.
        """
        if self.weights:
            shares = np.cumsum(self.weights) / np.sum(self.weights)
            return self.values[min(int(np.searchsorted(shares, rng.random(), side="right")), len(self.values) - 1)]
        if self.values:
            return self.values[_pick(len(self.values), self.order, rng, index)]
        assert self.lower is not None
        assert self.upper is not None
        return float(rng.uniform(self.lower, self.upper))

    def draw_number(self, rng: np.random.Generator, index: int) -> float:
        """Draw a value that must be a number.

        Raises:
            ConfigError: When the value is no number.
        """
        value = self.draw(rng, index)
        if isinstance(value, str | bool):
            raise ConfigError(f"expected a number, got {value!r}")
        return float(value)


@dataclass(frozen=True, kw_only=True)
class VectorChoice:
    """A vector: one of ``values``, or uniform in the box ``lower`` to ``upper``."""

    values: tuple[tuple[float, ...], ...] = ()
    """Vectors to choose from; empty: the box."""
    lower: tuple[float, ...] | None = None
    """Lower corner of the box."""
    upper: tuple[float, ...] | None = None
    """Upper corner of the box."""
    order: str = "random"
    """``random``, or ``in_order``: value ``index % len(values)``."""

    @staticmethod
    def from_short(value: Any) -> Any:
        """Return the mapping for which a list of vectors or a single vector stands, e.g. ``[0.5, 0.0, 0.2]``."""
        listed = isinstance(value, list)
        return {"values": value if listed and value and isinstance(value[0], list) else [value]} if listed else value

    def __post_init__(self) -> None:
        """Check that there is either a list or a box, all of one length.

        Raises:
            ConfigError: When both or neither are given, or their values are invalid.
        """
        _check(bool(self.values), self.lower, self.upper, self.order)
        if len({len(vector) for vector in self.ends}) > 1:
            raise ConfigError(f"vectors must have one length, got {[len(vector) for vector in self.ends]}")
        if self.lower is not None and self.upper is not None:
            for axis, (low, high) in enumerate(zip(self.lower, self.upper, strict=True)):
                if low > high:
                    raise ConfigError(f"lower must not be above upper, got {low:g} and {high:g} on axis {axis}")

    @property
    def size(self) -> int:
        """Length of the vectors."""
        return len(self.values[0] if self.values else self.lower or ())

    def require_size(self, size: int, name: str) -> None:
        """Refuse vectors of another length.

        Raises:
            ConfigError: When the length differs; names the key.
        """
        if self.size != size:
            raise ConfigError(f"{name} must be vectors of {size} numbers, got {self.size}")

    @property
    def ends(self) -> tuple[tuple[float, ...], ...]:
        """The vectors of the list, or both corners of the box."""
        return self.values or (self.lower or (), self.upper or ())

    def require_not_negative(self, name: str) -> None:
        """Refuse vectors with a component below 0.

        Raises:
            ConfigError: When a value is invalid; names the key.
        """
        for vector in self.ends:
            if min(vector, default=0.0) < 0:
                raise ConfigError(f"{name} must be numbers >= 0, got {list(vector)}")

    def require_not_zero(self, name: str) -> None:
        """Refuse vectors without a length, and a box that is one.

        Raises:
            ConfigError: When a value is invalid; names the key.
        """
        without = [not any(vector) for vector in self.ends]
        if any(without) if self.values else all(without):
            raise ConfigError(f"{name} must be a vector of any length but 0, got {[0.0] * self.size}")

    def require_color(self, name: str) -> None:
        """Refuse vectors that are no colours.

        Raises:
            ConfigError: When a value is invalid; names the key.
        """
        self.require_size(3, name)
        for vector in self.ends:
            if not all(0.0 <= component <= 1.0 for component in vector):
                raise ConfigError(f"{name} must be red, green and blue from 0 to 1, got {list(vector)}")

    def draw(self, rng: np.random.Generator, index: int) -> Array:
        """Draw a vector of shape (size,).

        Args:
            rng: Random stream of the calling component.
            index: Index of the episode.
        """
        if self.values:
            return np.array(self.values[_pick(len(self.values), self.order, rng, index)], dtype=float)
        drawn: npt.NDArray[np.float64] = rng.uniform(self.lower, self.upper)  # type: ignore[arg-type]
        return drawn


def choice_text(value: object) -> str:
    """Return a drawn value as the text of a task's ``drawn``: numbers with four digits, vectors with spaces."""
    if isinstance(value, str | bool):
        return str(value)
    return " ".join(f"{number:.4g}" for number in np.atleast_1d(np.asarray(value, dtype=float)))


def _pick(count: int, order: str, rng: np.random.Generator, index: int) -> int:
    return index % count if order == "in_order" else int(rng.integers(count))


def _check(listed: bool, lower: object, upper: object, order: str) -> None:
    if listed == (lower is not None or upper is not None) or (lower is None) != (upper is None):
        raise ConfigError("give either values (a list) or lower and upper (a range)")
    if order not in ORDERS:
        raise ConfigError(f"order '{order}' is unknown; {one_of(ORDERS, order)}")
    if order == "in_order" and not listed:
        raise ConfigError("order in_order is for values; a range is drawn at random")
