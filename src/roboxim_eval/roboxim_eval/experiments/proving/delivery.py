"""The demands of a cell, the content of an episode's bag, and the checks of one against the other.

A cell's name in a bag is a claim. An episode belongs to its cell only if the states and pictures of tick 0 meet the
demands of the cell's task, and if the policy received the instruction that the condition demands. A NaN is a fault:
comparisons are written so that NaN fails them, e.g. ``not far <= CAMERA_M``. The values here are plain;
`roboxim_runs.experiments.delivery.demands` reads them from task configurations, `reader` beside it from bags.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from string import Formatter
from typing import Any

from roboxim_core.poses import Pose, Vec3, distance

Value = str | float | tuple[float, ...]
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


@dataclass(frozen=True, kw_only=True)
class Allowed:
    """Values that a cell allows: a list, or a range."""

    values: tuple[Value, ...] = ()
    """Allowed values; empty: the range."""
    lower: tuple[float, ...] = ()
    """Lower end, a number for each axis."""
    upper: tuple[float, ...] = ()
    """Upper end."""

    def excess(self, value: Value) -> float:
        """Return the distance of a value from the allowed ones, the maximum over the axes.

        Infinity for another word, and for a NaN, so that it fails every comparison.
        """
        if self.values:
            return min(_apart(value, allowed) for allowed in self.values)
        if isinstance(value, str):
            return math.inf
        numbers = value if isinstance(value, tuple) else (value,)
        axes = list(zip(self.lower, numbers, self.upper, strict=False))
        return _largest([end for a, x, b in axes for end in (a - x, x - b, 0.0)]) if axes else math.inf

    @property
    def boxes(self) -> tuple[tuple[Value, Value], ...]:
        """The least and the largest of each value, or of the range, for each axis."""
        if self.values:
            return tuple((value, value) for value in self.values)
        return ((self.lower, self.upper),) if self.lower else ()

    def __str__(self) -> str:
        """Format the values, or the range."""
        if self.values:
            return " or ".join(_text(value) for value in self.values)
        return f"from {_text(self.lower)} to {_text(self.upper)}"


def plain_value(value: Any) -> Value:
    """Return a value as it is compared, from a configuration, a bag or JSON: text, a float, or a tuple of floats."""
    if isinstance(value, list | tuple):
        return tuple(float(number) for number in value)
    return value if isinstance(value, str) else float(value)


def gap(first: Allowed, second: Allowed) -> float:
    """Return the smallest difference between the values that one allows and those that another allows.

    Returns:
        The difference, the maximum over the axes; infinity for different words, or if no value is allowed; 0 if both
        allow a common value.
    """
    return min((_between(one, other) for one in first.boxes for other in second.boxes), default=math.inf)


def _between(first: tuple[Value, Value], second: tuple[Value, Value]) -> float:
    (low, high), (other_low, other_high) = first, second
    if isinstance(low, str) or isinstance(high, str) or isinstance(other_low, str) or isinstance(other_high, str):
        return _apart(low, other_low)
    axes = zip(*map(_axes, (low, high, other_low, other_high)), strict=False)
    return max((max(c - b, a - d, 0.0) for a, b, c, d in axes), default=math.inf)


def _axes(value: float | tuple[float, ...]) -> tuple[float, ...]:
    return value if isinstance(value, tuple) else (value,)


def _apart(value: Value, allowed: Value) -> float:
    if isinstance(value, str) or isinstance(allowed, str):
        return 0.0 if value == allowed else math.inf
    first, second = _axes(value), _axes(allowed)
    if len(first) != len(second):
        return math.inf
    return _largest([abs(a - b) for a, b in zip(first, second, strict=True)])


def _largest(numbers: Sequence[float]) -> float:
    """Return the largest number; infinity if one is NaN, 0 if there is none."""
    return math.inf if any(map(math.isnan, numbers)) else max(numbers, default=0.0)


def _text(value: Value) -> str:
    if isinstance(value, str):
        return value or "none"
    return " ".join(f"{number:.4g}" for number in (value if isinstance(value, tuple) else (value,)))


@dataclass(frozen=True, kw_only=True)
class View:
    """A pose that a cell allows for a camera."""

    parent: str
    """``world``, or the robot link that the camera is mounted on."""
    pose: Pose
    """Pose of the optical frame in the parent."""


@dataclass(frozen=True, kw_only=True)
class Demand:
    """Demands of a cell's task on every episode."""

    skill: str
    """The skill."""
    arm: str = ""
    """Id of the robot; empty: any."""
    arguments: dict[str, Allowed] = field(default_factory=dict)
    """Argument of the skill to its values."""
    models: dict[str, Allowed] = field(default_factory=dict)
    """Role to object models."""
    modifiers: dict[str, dict[str, Allowed]] = field(default_factory=dict)
    """Role to modifier to its values."""
    physics: dict[str, dict[str, Allowed]] = field(default_factory=dict)
    """Role to ``mass_kg`` and ``friction_coefficient`` to their values; a factor on them is among the modifiers."""
    table_friction: Allowed | None = None
    """Lateral friction coefficient of the table; none: any."""
    distractors: tuple[int, int] = (0, 0)
    """Smallest and largest number of distractors."""
    others: dict[str, dict[str, Allowed]] = field(default_factory=dict)
    """Model of a distractor to the modifiers that it must have, with their values."""
    always: tuple[str, ...] = ()
    """Models of distractors that every scene has, without modifiers."""
    furniture: dict[str, str] = field(default_factory=dict)
    """Entity of the scene that tasks are drawn in to its model. It is no distractor."""
    areas: dict[str, tuple[Allowed, ...]] = field(default_factory=dict)
    """Role to areas, one of which the object lies in, x and y in the robot's base [m]."""
    start: Allowed | None = None
    """Position of the tool centre point at tick 0 in the robot's base [m]; none: joints are given."""
    cameras: dict[str, tuple[View, ...]] = field(default_factory=dict)
    """Camera to poses, one of which it has."""
    shifts: dict[str, Allowed] = field(default_factory=dict)
    """Camera to the allowed shift of that pose in the parent [m]."""
    turned: tuple[str, ...] = ()
    """Cameras whose orientation is drawn."""
    look: dict[str, Allowed] = field(default_factory=dict)
    """Property of light, surfaces or pictures to its values, e.g. ``light.intensity``, ``light.number`` (of lights),
    ``table.texture``, ``background``, ``exposure.workspace``, ``noise.workspace``."""
    templates: tuple[str, ...] = ()
    """Templates of the task's instruction, with roles in braces; empty: any instruction."""
    words: str | None = None
    """Instruction that the policy must receive; none: the task's instruction."""
    latency_ticks: int = 0
    """Ticks by which each of its answers must be late."""


@dataclass(frozen=True, kw_only=True)
class Shown:
    """Content of an episode's bag."""

    bag: str
    """Path of the bag, for messages."""
    cell: str
    """The cell that it claims."""
    number: int
    """Its number in the cell."""
    skill: str
    """The task's skill."""
    arm: str = ""
    """Id of the robot in the scene."""
    arguments: dict[str, Value] = field(default_factory=dict)
    """Arguments of the skill."""
    models: dict[str, str] = field(default_factory=dict)
    """Role to the model of its object in the scene."""
    modifiers: dict[str, dict[str, Value]] = field(default_factory=dict)
    """Role to the modifiers of its object in the scene."""
    descriptions: dict[str, str] = field(default_factory=dict)
    """Role to how an instruction names its object in the scene, e.g. ``red cube``."""
    physics: dict[str, dict[str, float]] = field(default_factory=dict)
    """Role to ``mass_kg`` and ``friction_coefficient`` of its model with its modifiers."""
    weights: dict[str, float] = field(default_factory=dict)
    """Role to the mass that presses on the table at tick 0 [kg], for objects that touch nothing else."""
    table_friction: float = 0.0
    """Lateral friction coefficient of the table."""
    others: dict[str, str] = field(default_factory=dict)
    """Names of the objects on the table that the task is not about, to their models."""
    other_modifiers: dict[str, dict[str, Value]] = field(default_factory=dict)
    """The same names to their modifiers."""
    positions: dict[str, Vec3] = field(default_factory=dict)
    """Role to the position of its object at tick 0, in the robot's base [m]."""
    start: Vec3 = (0.0, 0.0, 0.0)
    """Position of the tool centre point at tick 0, in the robot's base [m]."""
    cameras: dict[str, View] = field(default_factory=dict)
    """Camera to its recorded pose."""
    look: dict[str, Value] = field(default_factory=dict)
    """Properties of light and surfaces, see `Demand.look`."""
    tool_px: dict[str, float] = field(default_factory=dict)
    """Camera to the distance of the tool in the recorded picture from its projection by the demanded camera [px];
    infinity: it is not found there. A camera that does not show the tool, or was not measured, is left out."""
    pixels: dict[str, float] = field(default_factory=dict)
    """Role, or name of a distractor, to its visible pixels in the best fixed camera, scaled to 256 x 256 px."""
    colors: dict[str, float] = field(default_factory=dict)
    """Role, name of a distractor, or ``table``, to the difference of its median colours in the picture and in its
    rendering (CIEDE2000)."""
    brightness: dict[str, float] = field(default_factory=dict)
    """Camera to the mean luminance of the picture minus that of its rendering, of 255."""
    state_hash: str = ""
    """Hash of the state of tick 0."""
    pictures: dict[str, int] = field(default_factory=dict)
    """Camera to the CRC-32 of its picture at tick 0."""
    sizes: dict[str, tuple[int, ...]] = field(default_factory=dict)
    """Camera to the shape of its picture."""
    not_compared: str = ""
    """Why its pictures were not compared with drawings of its state, e.g. ``renderer photo``; empty: they were."""
    thumbnails: dict[str, tuple[int, ...]] = field(default_factory=dict)
    """Camera to its picture at tick 0, reduced to 8 x 8 grey values, for comparisons of looks."""
    instruction: str = ""
    """The task's instruction."""
    received: tuple[str, ...] = ()
    """Instructions that the policy was given during the episode, each once; empty: the bag does not say."""
    latency_ticks: float = 0.0
    """Ticks by which its answers were late, mean of the episode."""


Check = Callable[[Demand, Shown], Iterator[str]]


def _skill(demand: Demand, shown: Shown) -> Iterator[str]:
    if shown.skill != demand.skill:
        yield f"its skill is {shown.skill}, the cell demands {demand.skill}"
    for name, allowed in demand.arguments.items():
        if not allowed.excess(shown.arguments.get(name, "")) <= 1e-6:
            yield f"{name} is {_text(shown.arguments.get(name, ''))}, the cell demands {allowed}"


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
                yield f"{kind} of the {role} is {_text(value)}, the cell demands {allowed}"
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
                yield f"{kind} of the {role} is {_text(value)}, the cell demands {allowed}"
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
                    yield f"{kind} of {name} is {_text(modifiers.get(kind, ''))}, the cell demands {allowed}"
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
            yield f"the {role} lies at {_text(position)} m, {100 * beyond:.1f} cm outside of the cell's area"


def _start(demand: Demand, shown: Shown) -> Iterator[str]:
    if demand.start is not None and not (beyond := demand.start.excess(shown.start)) <= START_M:
        yield f"the tool starts at {_text(shown.start)} m, {100 * beyond:.1f} cm outside of the demanded volume"


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
            yield f"{name} is {_text(shown.look.get(name, ''))}, the condition demands {allowed}"


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
