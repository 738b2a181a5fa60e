"""Names of an experiment's variations in other generalisation suites.

Names are those of the Colosseum's 14 perturbation factors (Pumacay et al. 2024), of the axes of STAR-Gen's taxonomy
(Gao et al. 2025) and of LIBERO-plus' 7 dimensions (Fei et al. 2025). They are matched by the keys of a task that a
factor's levels, a condition or a split of the cells changes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

from roboxim_eval.experiments.cells import Cell
from roboxim_eval.experiments.config import TASK, ExperimentConfig


@dataclass(frozen=True, kw_only=True)
class Names:
    """Names of one kind of change; empty: a suite has none."""

    colosseum: str = ""
    """The Colosseum's factor."""
    star_gen: str = ""
    """STAR-Gen's axis."""
    libero_plus: str = ""
    """LIBERO-plus' dimension."""


@dataclass(frozen=True, kw_only=True)
class Varied:
    """A variation of an experiment."""

    what: str
    """A factor or a condition of the experiment, or factors that held-out cells combine anew."""
    key: str
    """Keys of the task that it changes, or the key of the experiment that defines it."""
    names: Names | None
    """Its names in other suites; none: not known here."""


NOISY = "_noisy"
"""Ending of the names of views with noisy images, which the key alone does not show."""
IMAGES = Names(star_gen="visual: image augmentations", libero_plus="sensor noise")
LIGHT_COLOUR = Names(colosseum="light colour", star_gen="visual: scene", libero_plus="light conditions")
SURROUNDINGS = Names(colosseum="background texture", star_gen="visual: scene", libero_plus="background textures")
TABLE = Names(colosseum="table colour, table texture", star_gen="visual: scene", libero_plus="background textures")
START = Names(colosseum="RLBench variations", star_gen="behavioural: robot pose", libero_plus="robot initial states")
DISTRACTORS = Names(colosseum="distractor", star_gen="visual: scene", libero_plus="objects layout")
PLACES = Names(colosseum="RLBench variations", star_gen="behavioural: object poses", libero_plus="objects layout")
PHYSICS = Names(colosseum="object mass, object friction", star_gen="behavioural: hidden object properties")
SUPPORT = Names(colosseum="receiver object: colour, texture, size", star_gen="visual: object appearance")
WORDS = Names(star_gen="semantic: language rephrase", libero_plus="language instructions")
BY_KEY: tuple[tuple[str, Names], ...] = (
    ("reset.cameras.exposure", IMAGES),
    (NOISY, IMAGES),
    ("reset.cameras", Names(colosseum="camera pose", star_gen="visual: viewpoint", libero_plus="camera viewpoints")),
    ("reset.lights.color", LIGHT_COLOUR),
    ("reset.lights.ambient", LIGHT_COLOUR),
    ("reset.lights", Names(star_gen="visual: scene", libero_plus="light conditions")),
    ("reset.surfaces.table", TABLE),
    ("reset.surfaces", SURROUNDINGS),
    ("reset.background", SURROUNDINGS),
    ("reset.robot", START),
    ("reset.distractors", DISTRACTORS),
    ("distractors", DISTRACTORS),
    ("reset.objects", PLACES),
    ("interaction_area", PLACES),
    ("modifiers.mass", replace(PHYSICS, colosseum="object mass")),
    ("modifiers.friction", replace(PHYSICS, colosseum="object friction")),
    ("reset.physics", PHYSICS),
    ("objects.support", SUPPORT),
    ("modifiers.scale", Names(colosseum="manipulated object: size", star_gen="behavioural: other morphology")),
    ("modifiers", Names(colosseum="manipulated object: colour, texture", star_gen="visual: object appearance")),
    ("paraphrases", WORDS),
    ("templates", WORDS),
    ("arguments", Names(colosseum="RLBench variations", star_gen="semantic: object properties")),
)
"""Part of a key's path to its names; the first one that is in the path counts."""
NO_NAMES = Names()
"""Variations that no other suite has: no instruction, answers that arrive late, the number of a task's steps."""
NEW_COMBINATION = Names(star_gen="combined: seen levels, not seen together")
RANGE = {"values", "lower", "upper", "minimum", "maximum", "names"}
"""Keys of a range of values, below which no further names follow."""
NEW_PAIR = Names(star_gen="combined: unseen verb with seen object")
NEW_OBJECT = Names(star_gen="behavioural: new object")


def vocabulary(config: ExperimentConfig, cells: Iterable[Cell]) -> tuple[Varied, ...]:
    """Return the variations of an experiment, with their names in other suites.

    Args:
        config: The experiment.
        cells: Its cells.
    """
    cells = tuple(cells)
    found = []
    for factor, levels in config.factors.items():
        if factor != TASK and _is_mapping(levels):
            keys = sorted({path for level in levels.values() for path in _paths(level)})
            found.append(Varied(what=factor, key=", ".join(keys) or factor, names=_names([factor, *keys])))
        elif len(levels) > 1:
            key = "tasks" if factor == TASK else f"objects.{factor}.models"
            new = factor != TASK and _only_held_out(cells, factor)
            found.append(Varied(what=factor, key=key, names=NEW_OBJECT if new else NO_NAMES))
    for factors in _new_together(config, cells):
        of_object = TASK in factors and any(f != TASK and not _is_mapping(config.factors[f]) for f in factors)
        names = NEW_PAIR if of_object and len(factors) == 2 else NEW_COMBINATION
        found.append(Varied(what=" and ".join(factors), key="unseen", names=names))
    for name, condition in config.conditions.items():
        if condition.instruction is not None:
            found.append(Varied(what=name, key="instruction", names=WORDS if condition.instruction else NO_NAMES))
        if condition.latency_ticks:
            found.append(Varied(what=name, key="latency_ticks", names=NO_NAMES))
        if keys := sorted(_paths(condition.set)):
            found.append(Varied(what=name, key=", ".join(keys), names=_names(keys)))
    return tuple(found)


def _new_together(config: ExperimentConfig, cells: tuple[Cell, ...]) -> Iterable[tuple[str, ...]]:
    """Yield the smallest groups of factors whose levels are seen one by one, but not together."""
    seen = [cell.levels for cell in cells if not cell.unseen]
    found: set[tuple[str, ...]] = set()
    for levels in (cell.levels for cell in cells if cell.unseen):
        known: list[tuple[str, ...]] = []
        for size in range(1, len(levels) + 1):
            for factors in combinations(levels, size):
                new = all(any(other[f] != levels[f] for f in factors) for other in seen)
                if new and not any(set(one) <= set(factors) for one in known):
                    known.append(factors)
        found.update(factors for factors in known if len(factors) > 1)
    yield from sorted(found, key=lambda factors: [list(config.factors).index(factor) for factor in factors])


def _only_held_out(cells: Iterable[Cell], factor: str) -> bool:
    """Return whether a level of a factor occurs only in held-out cells."""
    levels: dict[bool, set[str]] = {True: set(), False: set()}
    for cell in cells:
        levels[cell.unseen].add(cell.levels[factor])
    return bool(levels[True] - levels[False])


def _is_mapping(value: Any) -> bool:
    return isinstance(value, Mapping)


def _paths(changes: Any, start: str = "") -> Iterable[str]:
    """Yield the paths of the keys that changes replace, four names deep at most."""
    if not isinstance(changes, Mapping) or start.count(".") >= 3 or RANGE & changes.keys():
        if start:
            yield start + (f"={NOISY}" if ".cameras.views." in start and _noisy(changes) else "")
        return
    for key, value in changes.items():
        yield from _paths(value, f"{start}.{key}" if start else str(key))


def _noisy(view: Any) -> bool:
    return _is_mapping(view) and all(str(name).endswith(NOISY) for name in view.get("values", ("",)))


def _names(paths: Iterable[str]) -> Names | None:
    paths = tuple(paths)
    if "steps" in paths:
        return NO_NAMES  # its sentence follows from its steps
    return next((names for part, names in BY_KEY if any(part in path for path in paths)), None)
