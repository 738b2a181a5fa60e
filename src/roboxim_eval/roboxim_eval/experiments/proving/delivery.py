"""The checks of an episode's bag against the demands of its cell.

A cell's name in a bag is a claim. An episode belongs to its cell only if the states and pictures of tick 0 meet the
demands of the cell's task, and if the policy received the instruction that the condition demands. A NaN is a fault:
comparisons are written so that NaN fails them, e.g. ``not far <= CAMERA_M``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from string import Formatter

from roboxim_core.poses import distance
from roboxim_eval.experiments.proving.demand import Demand, Shown, value_text

TOOL_PX = 2.0
"""Largest distance between the tool in a picture and its projection by the demanded camera [px]."""
CAMERA_M, CAMERA_RAD = 0.002, 0.005
"""Largest distance of a recorded camera from the demanded pose [m, rad]."""
AREA_M = 0.02
"""Largest distance of an object from the area that it was placed in, after it has come to rest [m]."""
START_M = 0.01
"""Largest distance of the tool from its demanded start [m]."""
VISIBLE_PX = 40
"""Fewest visible pixels of an object, in an image of 256 x 256 px."""
COLOR_DIFFERENCE = 8.0
"""Largest difference between the median colours of a surface in a picture and in its rendering (CIEDE2000)."""
BRIGHTNESS = 4.0
"""Largest difference between the mean luminance of a picture and of its rendering, of 255."""
WEIGHT_SHARE = 0.05
"""Largest deviation of the mass that presses on the table from the mass of the object's model, as a share of it. Of
the shipped models it is at most 0.005."""
CHANGED = 0.25
"""Smallest mean difference of two pictures of a scene, of 255, that counts as a delivered change of the look."""


Check = Callable[[Demand, Shown], Iterator[str]]


def _skill(demand: Demand, shown: Shown) -> Iterator[str]:
    if shown.skill != demand.skill:
        yield f"its skill is {shown.skill}, the cell demands {demand.skill}"
    for name, allowed in demand.arguments.items():
        if not allowed.excess(shown.arguments.get(name, "")) <= 1e-6:
            yield f"{name} is {value_text(shown.arguments.get(name, ''))}, the cell demands {allowed}"


def _arm(demand: Demand, shown: Shown) -> Iterator[str]:
    if demand.arm and shown.arm != demand.arm:
        yield f"the arm is {shown.arm or 'unknown'}, the cell demands {demand.arm}"


def _object(demand: Demand, shown: Shown) -> Iterator[str]:
    for role, allowed in demand.models.items():
        if allowed.excess(shown.models.get(role, "")):
            yield f"the {role} is {shown.models.get(role) or 'missing'}, the cell demands {allowed}"
    for role, kinds in demand.modifiers.items():
        for kind, allowed in kinds.items():
            value = shown.modifiers.get(role, {}).get(kind, "")
            if not allowed.excess(value) <= 1e-6:
                yield f"{kind} of the {role} is {value_text(value)}, the cell demands {allowed}"
    yield from _looks(shown, [role for role in shown.pixels.keys() | shown.colors.keys() if role not in shown.others])


def hidden_distractors(shown: Shown) -> int:
    """Return the number of distractors that no fixed camera sees well; scenes guarantee the task's objects only."""
    return sum(shown.pixels.get(name, math.inf) < VISIBLE_PX for name in shown.others)


def _looks(shown: Shown, names: Sequence[str], *, min_px: float = VISIBLE_PX) -> Iterator[str]:
    """Yield objects with too few visible pixels, or with another colour than their models."""
    for name in sorted(names):
        pixels, difference = shown.pixels.get(name, math.inf), shown.colors.get(name, 0.0)
        if not pixels >= min_px:
            yield f"the {name} has {pixels:.0f} visible pixels in the best fixed camera, at least {min_px:g} expected"
        if name != "table" and not difference <= COLOR_DIFFERENCE:
            yield (
                f"the {name}'s median colour is {difference:.1f} (CIEDE2000) from that of its model, at most "
                f"{COLOR_DIFFERENCE:g} expected"
            )


def _physics(demand: Demand, shown: Shown) -> Iterator[str]:
    for role, kinds in demand.physics.items():
        for kind, allowed in kinds.items():
            value = shown.physics.get(role, {}).get(kind, math.nan)
            if not allowed.excess(value) <= 1e-4:
                yield f"{kind} of the {role} is {value_text(value)}, the cell demands {allowed}"
    if demand.table_friction is not None and not demand.table_friction.excess(shown.table_friction) <= 1e-4:
        yield f"the table's friction is {shown.table_friction:.4g}, the cell demands {demand.table_friction}"
    for role, pressing in shown.weights.items():
        wanted = shown.physics.get(role, {}).get("mass_kg", math.nan)
        if not abs(pressing - wanted) <= WEIGHT_SHARE * wanted:
            yield f"{pressing:.4g} kg of the {role} press on the table, its model has {wanted:.4g} kg"


def _distractors(demand: Demand, shown: Shown) -> Iterator[str]:
    fewest, largest = demand.distractors
    lying = {name: model for name, model in shown.others.items() if demand.furniture.get(name) != model}
    if not fewest <= len(lying) <= largest:
        expected = f"{fewest}" if fewest == largest else f"{fewest} to {largest}"
        yield f"{len(lying)} distractors lie on the table, {expected} expected"
    missing = list(demand.always)
    for name, model in lying.items():
        modifiers = shown.other_modifiers.get(name, {})
        if model in missing and not modifiers.keys() & demand.others.get(model, {}).keys():
            missing.remove(model)
        elif demand.others and model not in demand.others:
            allowed_models = " or ".join(dict.fromkeys((*demand.always, *demand.others)))
            yield f"{name} is a {model}, the cell demands {allowed_models}"
        else:
            for kind, allowed in demand.others.get(model, {}).items():
                if not allowed.excess(modifiers.get(kind, "")) <= 1e-6:
                    yield f"{kind} of {name} is {value_text(modifiers.get(kind, ''))}, the cell demands {allowed}"
    for model in missing:
        yield f"no distractor is a {model}, which every scene has"
    yield from _looks(shown, list(lying), min_px=0)  # see `hidden_distractors`


def _area(demand: Demand, shown: Shown) -> Iterator[str]:
    for role, areas in demand.areas.items():
        if role not in shown.positions:
            yield f"the {role} is missing"
            continue
        position = shown.positions[role][:2]
        beyond = min(area.excess(position) for area in areas)
        if not beyond <= AREA_M:
            yield f"the {role} lies at {value_text(position)} m, {100 * beyond:.1f} cm outside of the cell's area"


def _start(demand: Demand, shown: Shown) -> Iterator[str]:
    if demand.start is not None and not (beyond := demand.start.excess(shown.start)) <= START_M:
        yield f"the tool starts at {value_text(shown.start)} m, {100 * beyond:.1f} cm outside of the demanded volume"


def _camera(demand: Demand, shown: Shown) -> Iterator[str]:
    for name, views in demand.cameras.items():
        if name not in shown.cameras:
            yield f"camera '{name}' is missing"
            continue
        found = shown.cameras[name]
        near = [distance(found.pose, view.pose) for view in views if view.parent == found.parent]
        if not near:
            yield f"camera '{name}' is mounted on {found.parent}, expected {views[0].parent}"
            continue
        far, turned = min(near)
        if name in demand.shifts:
            allowed = demand.shifts[name]
            far = min(
                allowed.excess(tuple(a - b for a, b in zip(found.pose.position, view.pose.position, strict=True)))
                for view in views
            )
        if not far <= CAMERA_M:
            yield f"camera '{name}' is {100 * far:.1f} cm from the demanded pose"
        elif name not in demand.turned and not turned <= CAMERA_RAD:
            yield f"camera '{name}' is turned by {math.degrees(turned):.1f} degrees from the demanded pose"
    for name, offset in shown.tool_px.items():
        if not offset <= TOOL_PX:
            seen = "is not found" if math.isinf(offset) else f"is {offset:.1f} px from its projection"
            yield f"in camera '{name}' the tool {seen}, at most {TOOL_PX:g} px expected"


def _within(demand: Demand, shown: Shown, kinds: tuple[str, ...]) -> Iterator[str]:
    for name, allowed in demand.look.items():
        if name.startswith(kinds) and not allowed.excess(shown.look.get(name, "")) <= 1e-4:
            yield f"{name} is {value_text(shown.look.get(name, ''))}, the condition demands {allowed}"


LIGHT = ("light", "exposure", "noise")
TEXTURE = ("table", "floor", "wall", "background")
"""First words of properties in `Shown.look`, by the check that reads them."""


def _light(demand: Demand, shown: Shown) -> Iterator[str]:
    yield from _within(demand, shown, LIGHT)
    for name, difference in shown.brightness.items():
        if not abs(difference) <= BRIGHTNESS:
            yield (
                f"the picture of camera '{name}' differs by {difference:+.1f} of 255 from the luminance that its light "
                f"gives, at most {BRIGHTNESS:g} expected"
            )


def _texture(demand: Demand, shown: Shown) -> Iterator[str]:
    yield from _within(demand, shown, TEXTURE)
    if not shown.colors.get("table", 0.0) <= COLOR_DIFFERENCE:
        yield (
            f"the table's median colour is {shown.colors['table']:.1f} (CIEDE2000) from that of its material, at most "
            f"{COLOR_DIFFERENCE:g} expected"
        )


def _instruction(demand: Demand, shown: Shown) -> Iterator[str]:
    expected = [_filled(template, shown.descriptions) for template in demand.templates]
    if expected and not any(re.fullmatch(pattern, shown.instruction) for pattern in expected):
        templates = "' or '".join(demand.templates)
        named = ", ".join(f"{role} is the {text}" for role, text in shown.descriptions.items())
        yield f"the instruction is '{shown.instruction}', the cell demands '{templates}', where {named}"


def _filled(template: str, descriptions: Mapping[str, str]) -> str:
    """Return a pattern of a template with the objects' descriptions; other names, e.g. an angle, match any words.

    A description may name a drawer, as in "Put the cube into the top drawer of the white cabinet".
    """

    def pattern(name: str) -> str:
        return rf"(?:[\w-]+ drawer of the )?{re.escape(descriptions[name])}" if name in descriptions else ".+"

    parts = Formatter().parse(template)
    return "".join(re.escape(literal) + (pattern(name) if name else "") for literal, name, _, _ in parts)


def _words(demand: Demand, shown: Shown) -> Iterator[str]:
    wanted = shown.instruction if demand.words is None else demand.words
    if shown.received and set(shown.received) != {wanted}:
        received = " and ".join(f"'{text}'" for text in shown.received)
        yield f"the policy received {received}, expected '{wanted}'"


def _latency(demand: Demand, shown: Shown) -> Iterator[str]:
    if not abs(shown.latency_ticks - demand.latency_ticks) <= 1e-6:
        yield f"the policy's answers were {shown.latency_ticks:g} ticks late, {demand.latency_ticks} expected"


CHECKS: Mapping[str, Check] = {
    "skill": _skill, "arm": _arm, "object": _object, "physics": _physics, "distractors": _distractors, "area": _area,
    "start": _start, "camera": _camera, "light": _light, "texture": _texture, "instruction": _instruction,
    "words": _words, "latency": _latency,
}  # fmt: skip
"""Checks by name. Each yields the faults, with figures; none: the episode passes."""
WORDS = "words"
"""The check of the received instruction; only bags that store it are checked."""


def faults_of(demand: Demand, shown: Shown) -> dict[str, str]:
    """Return the faults of an episode: check to the fault, with figures; empty: no known fault."""
    found = {name: "; ".join(check(demand, shown)) for name, check in CHECKS.items()}
    return {name: text for name, text in found.items() if text}
