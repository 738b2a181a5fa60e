"""Checks that distinguish the held-out cells of an experiment from the cells of a dataset.

The proof of training data tests whether an episode belongs to a held-out cell, regardless of the cell that it claims.
It uses checks of the module `delivery` that no episode of the dataset's cells passes for the held-out cell, e.g. the
light if cells differ in their light. If no check distinguishes them, the experiment is refused before it starts.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from string import Formatter
from typing import Any

from roboxim_core.poses import distance
from roboxim_eval.experiments.proving.delivery import AREA_M, CAMERA_M, CAMERA_RAD, CHECKS, LIGHT, START_M, TEXTURE
from roboxim_eval.experiments.proving.demand import Allowed, Demand, Shown, View, gap

OF_CELLS = ("skill", "arm", "object", "area", "camera")
"""Checks that every episode of a cell must pass."""
EXACT = 1e-4
"""Least difference of two drawn values that are recorded as they were drawn."""


def belongs_to(demand: Demand, shown: Shown, checks: Iterable[str] = OF_CELLS) -> bool:
    """Return whether an episode's content belongs to a cell, regardless of the cell that it claims.

    Measurements in its pictures and forces do not count: a fault of delivery does not move it to another cell.

    Args:
        demand: Demands of the cell.
        shown: Content of the episode's bag.
        checks: Checks that it must pass, see `distinguishing_checks`.
    """
    plain = replace(shown, tool_px={}, pixels={}, colors={}, brightness={}, weights={})
    return not any(any(CHECKS[name](demand, plain)) for name in checks)


def distinguishing_checks(held_out: Demand, others: Iterable[Demand]) -> tuple[str, ...]:
    """Return the checks that identify episodes of a held-out cell: no episode of the other cells passes all of them.

    Skill, arm, object, area and camera are always among them. Others are added only if these do not distinguish the
    held-out cell from another one, so a held-out episode is found even if e.g. its instruction was rewritten.

    Args:
        held_out: Demands of the held-out cell.
        others: Demands of the cells from which it must be distinguished.
    """
    needed: set[str] = set()
    for other in others:
        if not any(APART[name](held_out, other) for name in OF_CELLS):
            needed.update(name for name, apart in APART.items() if apart(held_out, other))
    return (*OF_CELLS, *(name for name in APART if name in needed and name not in OF_CELLS))


def distinguishable(held_out: Demand, other: Demand) -> bool:
    """Return whether there is a check that no episode of another cell passes for a held-out one."""
    return any(apart(held_out, other) for apart in APART.values())


def differing(first: Demand, second: Demand) -> tuple[str, ...]:
    """Return the checks for which two cells have other demands; these may overlap."""
    return tuple(name for name, part in PARTS.items() if part(first) != part(second))


# ------------------------------------------------------------------ demands that exclude each other


def _skill(held_out: Demand, other: Demand) -> bool:
    return held_out.skill != other.skill or _any_apart(held_out.arguments, other.arguments)


def _arm(held_out: Demand, other: Demand) -> bool:
    return bool(held_out.arm and other.arm) and held_out.arm != other.arm


def _object(held_out: Demand, other: Demand) -> bool:
    return _any_apart(held_out.models, other.models) or any(
        _any_apart(held_out.modifiers[role], other.modifiers[role])
        for role in held_out.modifiers.keys() & other.modifiers.keys()
    )


def _physics(held_out: Demand, other: Demand) -> bool:
    table, other_table = held_out.table_friction, other.table_friction
    return (table is not None and other_table is not None and gap(table, other_table) > EXACT) or any(
        _any_apart(held_out.physics[role], other.physics[role])
        for role in held_out.physics.keys() & other.physics.keys()
    )


def _distractors(held_out: Demand, other: Demand) -> bool:
    """Numbers exclude each other, one always has a model that the other never has, or no drawn model fits both."""
    (fewest_allowed, largest_allowed), (fewest, largest) = held_out.distractors, other.distractors
    if largest < fewest_allowed or fewest > largest_allowed:
        return True
    for one, another in ((held_out, other), (other, held_out)):
        if not {*one.always} <= {*another.always, *another.others}:
            return True
    if Counter(held_out.always) != Counter(other.always) or max(fewest_allowed, fewest) <= len(held_out.always):
        return False
    return all(
        _any_apart(held_out.others[model], other.others[model])
        for model in held_out.others.keys() & other.others.keys()
    )


def _area(held_out: Demand, other: Demand) -> bool:
    return any(
        min(gap(area, its) for area in held_out.areas[role] for its in other.areas[role]) > AREA_M
        for role in held_out.areas.keys() & other.areas.keys()
    )


def _start(held_out: Demand, other: Demand) -> bool:
    return held_out.start is not None and other.start is not None and gap(held_out.start, other.start) > START_M


def _camera(held_out: Demand, other: Demand) -> bool:
    """The held-out cell has a camera that the other lacks, or a common camera shares no pose."""
    return any(
        name not in other.cameras
        or all(
            _views_apart(name, (held_out, view), (other, its)) for view in views for its in other.cameras[name]
        )
        for name, views in held_out.cameras.items()
    )  # fmt: skip


def _views_apart(name: str, first: tuple[Demand, View], second: tuple[Demand, View]) -> bool:
    (demand, view), (other, its) = first, second
    if view.parent != its.parent or gap(_positions(name, *first), _positions(name, *second)) > CAMERA_M:
        return True
    return name not in (*demand.turned, *other.turned) and distance(view.pose, its.pose)[1] > CAMERA_RAD


def _positions(name: str, demand: Demand, view: View) -> Allowed:
    """Return the positions of a camera that a view and its shift give."""
    shift = demand.shifts.get(name, Allowed(values=((0.0, 0.0, 0.0),)))

    def at(by: Any) -> tuple[float, ...]:
        return tuple(a + b for a, b in zip(view.pose.position, by, strict=False))

    return Allowed(values=tuple(map(at, shift.values)), lower=at(shift.lower), upper=at(shift.upper))


def _look(kinds: tuple[str, ...]) -> Callable[[Demand, Demand], bool]:
    return lambda held_out, other: _any_apart(_of_kinds(held_out, kinds), _of_kinds(other, kinds))


def _of_kinds(demand: Demand, kinds: tuple[str, ...]) -> dict[str, Allowed]:
    return {name: allowed for name, allowed in demand.look.items() if name.startswith(kinds)}


def _instruction(held_out: Demand, other: Demand) -> bool:
    roles = held_out.models.keys() | other.models.keys()
    return bool(held_out.templates and other.templates) and not any(
        _could_say(one, another, roles) or _could_say(another, one, roles)
        for one in held_out.templates
        for another in other.templates
    )


def _could_say(template: str, sentence: str, roles: Iterable[str]) -> bool:
    """Return whether a template may give a sentence of another template; names match any words."""
    names = {name for _, name, _, _ in Formatter().parse(sentence) if name}
    phrasing = "".join(literal + (f"<{name}>" if name else "") for literal, name, _, _ in Formatter().parse(sentence))

    def pattern(name: str) -> str:
        return rf"(?:[\w-]+ drawer of the )?<{re.escape(name)}>" if name in names & {*roles} else ".+"

    parts = Formatter().parse(template)
    wanted = "".join(re.escape(literal) + (pattern(name) if name else "") for literal, name, _, _ in parts)
    return re.fullmatch(wanted, phrasing) is not None


def _any_apart(first: Mapping[str, Allowed], second: Mapping[str, Allowed]) -> bool:
    return any(gap(first[name], second[name]) > EXACT for name in first.keys() & second.keys())


APART: Mapping[str, Callable[[Demand, Demand], bool]] = {
    "skill": _skill, "arm": _arm, "object": _object, "physics": _physics, "distractors": _distractors, "area": _area,
    "start": _start, "camera": _camera, "light": _look(LIGHT), "texture": _look(TEXTURE), "instruction": _instruction,
}  # fmt: skip
"""Check to whether no episode of another cell passes it for a held-out one."""
PARTS: Mapping[str, Callable[[Demand], Any]] = {
    "skill": lambda cell: (cell.skill, cell.arguments),
    "arm": lambda cell: cell.arm,
    "object": lambda cell: (cell.models, cell.modifiers),
    "physics": lambda cell: (cell.physics, cell.table_friction),
    "distractors": lambda cell: (cell.distractors, cell.others, cell.always),
    "area": lambda cell: cell.areas,
    "start": lambda cell: cell.start,
    "camera": lambda cell: (cell.cameras, cell.shifts, cell.turned),
    "light": lambda cell: _of_kinds(cell, LIGHT),
    "texture": lambda cell: _of_kinds(cell, TEXTURE),
    "instruction": lambda cell: cell.templates,
}
"""Check to the part of a demand that it reads."""


def undistinguished(
    demands: Mapping[str, Demand], held_out: Iterable[str], others: Iterable[str]
) -> Iterator[tuple[str, str]]:
    """Yield held-out cells with the cells from which they cannot be distinguished.

    Args:
        demands: Cell to its demands.
        held_out: Held-out cells.
        others: Cells of a dataset.
    """
    others = tuple(others)
    for cell in held_out:
        for other in others:
            if not distinguishable(demands[cell], demands[other]):
                yield cell, other
