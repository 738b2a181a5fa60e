"""The account of a dataset: every part of its files, and whether it was read.

A reader first lists everything that it finds (`Account.holds`). Then it states for each part whether it reads it,
whether it follows from what is read, or why it leaves it out. A part without a statement is left out as unknown. So the
parts that were read, implied and left out always add up to the content of the files.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

Kind = Literal["key", "metadata", "episode", "row", "task", "split", "rate", "statistics", "file"]
Treatment = Literal["read", "implied", "left out"]

UNITS: dict[Kind, str] = {"key": "frames", "metadata": "episodes", "row": "rows"}
"""Kind of a part to what its number counts; a part of another kind is counted once."""
UNKNOWN = "this reader does not know it"
SHOWN = 16
"""Lines of an account; the others are only counted."""
_NAMED = 4  # names of parts that share a line


@dataclass(frozen=True, kw_only=True)
class Part:
    """A part of a dataset's files, or a share of it."""

    kind: Kind
    """What it is."""
    name: str
    """Its name in the dataset, e.g. ``obs/gripper``."""
    count: int
    """How much of it: frames of a key, episodes with a metadata key, rows; 1 of another kind."""
    treatment: Treatment
    """What became of it."""
    why: str = ""
    """Why it is left out or implied, or how the read values differ from the stored ones; empty: it was read as it
    is."""

    def __str__(self) -> str:
        """Return it as text: name and number."""
        unit = UNITS.get(self.kind, "")
        named = self.name if self.kind in ("key", "row") else f"{self.kind} {self.name}"
        return f"{named}, {self.count} {unit if self.count != 1 else unit[:-1]}" if unit else named


class Account:
    """Collects the parts of a dataset and their treatment; see the module."""

    def __init__(self) -> None:
        """Start with nothing."""
        self._held: dict[tuple[Kind, str], int] = defaultdict(int)
        self._noted: dict[tuple[Kind, str], dict[tuple[Treatment, str], int]] = defaultdict(lambda: defaultdict(int))

    def holds(self, kind: Kind, name: str, count: int = 1) -> None:
        """Note that the files hold a part.

        Args:
            kind: What it is.
            name: Its name in the dataset.
            count: How much of it; it is added to what was noted before.
        """
        self._held[kind, name] += count

    def knows(self, kind: Kind, name: str) -> bool:
        """Return whether a part was noted."""
        return (kind, name) in self._held

    def reads(self, kind: Kind, name: str, count: int | None = None, changed: str = "") -> None:
        """Note that a part is read.

        Args:
            kind: What it is.
            name: Its name.
            count: How much of it; None: all that is not accounted for yet.
            changed: How the read values differ, e.g. ``float64, read as float32``.
        """
        self._note(kind, name, "read", changed, count)

    def implies(self, kind: Kind, name: str, why: str, count: int | None = None) -> None:
        """Note that a part follows from others that are read."""
        self._note(kind, name, "implied", why, count)

    def leaves_out(self, kind: Kind, name: str, why: str, count: int | None = None) -> None:
        """Note that a part is not read, and why."""
        self._note(kind, name, "left out", why, count)

    def _note(self, kind: Kind, name: str, treatment: Treatment, why: str, count: int | None) -> None:
        left = self._left(kind, name)
        number = left if count is None else min(count, left)
        if number > 0:
            self._noted[kind, name][treatment, why] += number

    def _left(self, kind: Kind, name: str) -> int:
        return self._held.get((kind, name), 0) - sum(self._noted.get((kind, name), {}).values())

    @property
    def parts(self) -> list[Part]:
        """All parts of the files, each with its treatment."""
        found = []
        for (kind, name), held in self._held.items():
            named = dict(self._noted.get((kind, name), {}))
            if (left := held - sum(named.values())) > 0:
                named["left out", UNKNOWN] = named.get(("left out", UNKNOWN), 0) + left
            found += [
                Part(kind=kind, name=name, count=count, treatment=treatment, why=why)
                for (treatment, why), count in named.items()
            ]
        return found

    @property
    def left_out(self) -> list[Part]:
        """What was not read."""
        return [part for part in self.parts if part.treatment == "left out"]

    @property
    def changed(self) -> list[Part]:
        """Parts that were read with changed values."""
        return [part for part in self.parts if part.treatment == "read" and part.why]


def to_json(parts: Sequence[Part]) -> list[dict[str, Any]]:
    """Return parts as plain data."""
    return [{"kind": part.kind, "name": part.name, "count": part.count, "why": part.why} for part in parts]


def lines(title: str, parts: Sequence[Part]) -> list[str]:
    """Return parts as lines, those of one kind and one reason together.

    Args:
        title: First words of every line, e.g. ``left out``.
        parts: The parts.
    """
    groups: dict[tuple[Kind, str], list[Part]] = {}
    for part in parts:
        groups.setdefault((part.kind, part.why), []).append(part)
    found = []
    for (kind, why), group in groups.items():
        more = f", ... ({len(group)} in all)" if len(group) > _NAMED else ""
        if kind in UNITS or len(group) == 1:
            names = "; ".join(map(str, group[:_NAMED]))
        else:
            names = f"{len(group)} {kind}s: " + ", ".join(part.name for part in group[:_NAMED])
        found.append(f"{title}: {names}{more}: {why}")
    if len(found) > SHOWN:
        found[SHOWN:] = [f"{title}: {len(found) - SHOWN} more kinds of things (--json lists all)"]
    return found
