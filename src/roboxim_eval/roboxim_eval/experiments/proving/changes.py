"""Checks that a condition's change of the task leaves the other properties of a scene unchanged.

Every property of a scene has its own random stream. A condition that changes one property therefore has the same scenes
as the unchanged conditions in all other properties. The exception is the placement of objects: it is drawn again if a
constraint refuses it, and constraints depend on the cameras, the start and the room between the objects. So a moved
camera keeps the objects' places in most scenes, but not where a camera no longer sees the object.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from roboxim_eval.experiments.proving.delivery import CHANGED
from roboxim_eval.experiments.proving.demand import Shown

SAME_M = 0.001
"""Largest distance of an object or the tool from its place in another condition's episode of the scene [m].

Another friction moves the shipped objects by at most 4e-6 m until tick 0, another mass does not move them."""
PICTURES = frozenset({"pictures", "appearance"})
PLACED = PICTURES | {"state", "places"}
"""Aspects that change where objects are placed anew."""
WORDS_SAY_OTHER_ROLES = "roles in templates"
"""Part of a task: the roles that instructions name. Distractors must not have models that they exclude."""


@dataclass(frozen=True, kw_only=True)
class Change:
    """Allowed effects of a change of the task on a scene; every other aspect stays."""

    may: frozenset[str] = frozenset()
    """Aspects that may differ, see `ASPECTS`."""
    seen: bool = False
    """Whether pictures must differ by `CHANGED`. An object's colour, for example, changes a small part of them; they
    must then not be the same, see `shown_difference`."""

    def __add__(self, other: Change) -> Change:
        """Return the union of both."""
        return Change(may=self.may | other.may, seen=self.seen or other.seen)


RULES: tuple[tuple[str, Change], ...] = (
    (r"reset\.(lights|surfaces|background)(\..*)?", Change(may=PICTURES | {"look"}, seen=True)),
    (r"reset\.cameras\.exposure_ev", Change(may=PICTURES | {"exposure"}, seen=True)),
    (r"reset\.cameras\.(shift_m|turn_rad)", Change(may=PLACED | {"cameras"}, seen=True)),
    (r"reset\.cameras\.views", Change(may=PLACED | {"cameras", "exposure"})),
    (r"reset\.robot(\..*)?", Change(may=PLACED | {"start"})),
    (r"reset\.(objects|distractors|interaction_area|toppled|joints)(\..*)?", Change(may=PLACED)),
    (r"reset\.physics(\..*)?|objects\.\w+\.modifiers\.(mass|friction)",
     Change(may=frozenset({"physics", "state", "pictures"}))),
    (r"distractors", Change(may=PLACED | {"others"})),
    (r"objects(\..*)?", Change(may=PLACED | {"objects", "physics", "others"})),
    (r"templates|paraphrases|wordings|max_steps", Change()),
    (WORDS_SAY_OTHER_ROLES, Change(may=PLACED | {"objects", "physics", "others"})),
)  # fmt: skip
"""Parts of a task, as `changed_parts` names them, to the allowed effects of a change. A part that is not listed, e.g.
the scene or the control rate, may change everything."""


def changed_parts(change: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the parts of a task that a condition's ``set`` changes, e.g. ``reset.lights`` or ``distractors``.

    Cameras and the modifiers of objects are named one by one, e.g. ``objects.target.modifiers.mass``.
    """
    parts: list[str] = []
    for key, value in change.items():
        if key == "reset" and isinstance(value, Mapping):
            for name, section in value.items():
                each = name == "cameras" and isinstance(section, Mapping) and section
                parts += [f"reset.{name}.{field}" for field in section] if each else [f"reset.{name}"]
        elif key == "objects" and isinstance(value, Mapping):
            parts += _parts_of_objects(value)
        else:
            parts.append(key)
    return tuple(dict.fromkeys(parts))


def _parts_of_objects(objects: Mapping[str, Any]) -> Iterator[str]:
    for role, config in objects.items():
        if not isinstance(config, Mapping):
            yield f"objects.{role}"
            continue
        for field, value in config.items():
            whole = f"objects.{role}.{field}"
            if field == "modifiers" and isinstance(value, Mapping):
                yield from (f"{whole}.{kind}" for kind in value)
            else:
                yield whole


def change_of(parts: Collection[str]) -> Change | None:
    """Return the allowed effects of changes of several parts of a task; none: everything may differ."""
    found = Change()
    for part in parts:
        rule = next((change for pattern, change in RULES if re.fullmatch(pattern, part)), None)
        if rule is None:
            return None
        found += rule
    return found


# ------------------------------------------------------------------ comparing two episodes of a scene


def differences(change: Change, shown: Shown, right: Shown, condition: str) -> Iterator[str]:
    """Yield the differences that a changed episode must not have from an unchanged one of its scene.

    Args:
        change: What may differ.
        shown: The changed episode.
        right: The unchanged one.
        condition: Condition of the unchanged one, for messages.
    """
    if "state" not in change.may and shown.state_hash != right.state_hash:
        yield f"the state of tick 0 is {shown.state_hash:.8}, that of '{condition}' is {right.state_hash:.8}"
        return  # it explains the later differences
    for aspect in ASPECTS:
        if aspect in change.may:
            continue
        actual, expected = _values(aspect, shown), _values(aspect, right)
        for name in dict.fromkeys((*actual, *expected)):
            if actual.get(name) != expected.get(name):
                value, usual = actual.get(name, "missing"), expected.get(name, "missing")
                yield f"{name} is {value}, with '{condition}' it is {usual}"
    if "start" not in change.may and not (far := _apart(shown.start, right.start)) <= SAME_M:
        yield f"the tool starts {1000 * far:.1f} mm from where it does with '{condition}'"
    if "places" not in change.may:
        for name, far in moved(shown, right).items():
            if not far <= SAME_M:
                yield f"the {name} lies {1000 * far:.1f} mm from where it does with '{condition}'"
    if shown.sizes != right.sizes:
        return  # policies get pictures of different sizes
    if "pictures" not in change.may and shown.pictures != right.pictures:
        yield f"its pictures are not those of '{condition}', although nothing that is seen changes"
    elif "appearance" not in change.may and not (far := seen_change(shown, right)) < CHANGED:
        yield f"its pictures are {far:.2f} of 255 from those of '{condition}', although nothing that is seen changes"


ASPECTS = ("look", "exposure", "cameras", "objects", "physics", "others")
"""Aspects of a scene that are equal or not, beside ``state``, ``start``, ``places``, ``pictures``, ``appearance``."""
INVISIBLE = ("mass", "friction")
OF_CAMERAS = {"exposure", "noise"}
"""Kinds of properties in `Shown.look` that belong to cameras."""
IN_PICTURES = ("look", "exposure", "cameras", "objects", "others")
"""Aspects that pictures show."""


def shown_difference(change: Change, shown: Shown, right: Shown) -> str:
    """Return the visible aspects that a change made different, e.g. ``color of the target``; empty: none.

    Args:
        change: What may differ.
        shown: The changed episode.
        right: The unchanged one.
    """
    for aspect in IN_PICTURES:
        actual, expected = _values(aspect, shown), _values(aspect, right)
        for name in dict.fromkeys((*actual, *expected)) if aspect in change.may else ():
            if actual.get(name) != expected.get(name):
                return name
    return "the start of the tool" if "start" in change.may and _apart(shown.start, right.start) > SAME_M else ""


def _values(aspect: str, shown: Shown) -> dict[str, Any]:
    """Return an aspect of an episode's scene: name, for messages, to value."""
    if aspect in ("look", "exposure"):
        kinds = {"exposure"} if aspect == "exposure" else {name.split(".")[0] for name in shown.look} - OF_CAMERAS
        return {name: value for name, value in shown.look.items() if name.split(".")[0] in kinds}
    if aspect == "cameras":
        noise = {name: value for name, value in shown.look.items() if name.startswith("noise.")}
        return noise | {f"the pose of camera '{name}'": view for name, view in shown.cameras.items()}
    if aspect == "others":
        return {f"the model of {name}": model for name, model in shown.others.items()}
    drawn = {
        f"{kind} of the {role}": value
        for role, modifiers in shown.modifiers.items()
        for kind, value in modifiers.items()
        if (kind in INVISIBLE) == (aspect == "physics")
    }
    if aspect == "physics":
        return drawn | {"the table's friction": shown.table_friction}
    return drawn | {f"the model of the {role}": model for role, model in shown.models.items()}


def moved(shown: Shown, right: Shown) -> dict[str, float]:
    """Return how far each object of both episodes lies from its place in the other one, on the table [m]."""
    both = shown.positions.keys() & right.positions.keys()
    return {name: _apart(shown.positions[name][:2], right.positions[name][:2]) for name in sorted(both)}


def _apart(first: tuple[float, ...], second: tuple[float, ...]) -> float:
    return float(sum((a - b) ** 2 for a, b in zip(first, second, strict=True)) ** 0.5)


def seen_change(shown: Shown, other: Shown) -> float:
    """Return the largest mean difference of two episodes' pictures over the cameras, of 255."""
    found = [0.0]
    for camera in shown.thumbnails.keys() & other.thumbnails.keys():
        first, second = shown.thumbnails[camera], other.thumbnails[camera]
        found.append(sum(abs(a - b) for a, b in zip(first, second, strict=True)) / max(len(first), 1))
    return max(found)
