"""What a cell demands of an episode, what the episode's bag shows, and the checks of one against the other.

A cell's name in a bag is a claim. An episode belongs to its cell only if the states and pictures of tick 0 show what
the cell's task demands, and if the policy received the words that the condition demands. A NaN is a fault: comparisons
are written such that it fails them, e.g. ``not far <= CAMERA_M``. The values here are plain;
`roboxim_bringup.runs.delivery_demands` reads them from task configurations, `delivery_reader` from bags.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
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
CHANGED = 0.25
"""Least mean difference of two pictures of a scene, of 255, at which a change of the look counts as delivered."""


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
        """Return by how much a value is beyond what is allowed, at most over the axes.

        Infinity for another word, and for a NaN, so that no comparison lets it pass.
        """
        if self.values:
            return min(_apart(value, allowed) for allowed in self.values)
        if isinstance(value, str):
            return math.inf
        numbers = value if isinstance(value, tuple) else (value,)
        axes = list(zip(self.lower, numbers, self.upper, strict=False))
        return _largest([end for a, x, b in axes for end in (a - x, x - b, 0.0)]) if axes else math.inf

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


def _apart(value: Value, allowed: Value) -> float:
    if isinstance(value, str) or isinstance(allowed, str):
        return 0.0 if value == allowed else math.inf
    first = value if isinstance(value, tuple) else (value,)
    second = allowed if isinstance(allowed, tuple) else (allowed,)
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
    """What a cell's task demands of every episode."""

    skill: str
    """The skill."""
    arguments: dict[str, Allowed] = field(default_factory=dict)
    """Argument of the skill to its values."""
    models: dict[str, Allowed] = field(default_factory=dict)
    """Role to object models."""
    modifiers: dict[str, dict[str, Allowed]] = field(default_factory=dict)
    """Role to modifier to its values."""
    distractors: tuple[int, int] = (0, 0)
    """Fewest and most objects that the task is not about."""
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
    """Property of light or surfaces to its values, e.g. ``light.intensity``, ``table.texture``, ``background``."""
    words: str | None = None
    """What the policy must receive as instruction; none: the task's instruction."""
    latency_ticks: int = 0
    """Ticks by which each of its answers must be late."""


@dataclass(frozen=True, kw_only=True)
class Shown:
    """What an episode's bag shows."""

    bag: str
    """Path of the bag, for messages."""
    cell: str
    """The cell that it claims."""
    number: int
    """Its number in the cell."""
    skill: str
    """The task's skill."""
    arguments: dict[str, Value] = field(default_factory=dict)
    """Arguments of the skill."""
    models: dict[str, str] = field(default_factory=dict)
    """Role to the model of its object in the scene."""
    modifiers: dict[str, dict[str, Value]] = field(default_factory=dict)
    """Role to the modifiers of its object in the scene."""
    others: tuple[str, ...] = ()
    """Models of the objects on the table that the task is not about."""
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
    """Role to the visible pixels of its object in the best fixed camera, scaled to 256 x 256 px."""
    colors: dict[str, float] = field(default_factory=dict)
    """Role, or ``table``, to the difference of its median colours in the picture and in its rendering (CIEDE2000)."""
    brightness: dict[str, float] = field(default_factory=dict)
    """Camera to the mean luminance of the picture minus that of its rendering, of 255."""
    state_hash: str = ""
    """Hash of the state of tick 0."""
    pictures: dict[str, int] = field(default_factory=dict)
    """Camera to the CRC-32 of its picture at tick 0."""
    sizes: dict[str, tuple[int, ...]] = field(default_factory=dict)
    """Camera to the shape of its picture."""
    thumbnails: dict[str, tuple[int, ...]] = field(default_factory=dict)
    """Camera to its picture at tick 0, reduced to 8 x 8 grey values, for comparisons of looks."""
    instruction: str = ""
    """The task's instruction."""
    received: str = ""
    """The instruction as the policy received it."""
    latency_ticks: float = 0.0
    """Ticks by which its answers were late, mean of the episode."""


Check = Callable[[Demand, Shown], Iterator[str]]


def _skill(demand: Demand, shown: Shown) -> Iterator[str]:
    if shown.skill != demand.skill:
        yield f"its skill is {shown.skill}, the cell demands {demand.skill}"
    for name, allowed in demand.arguments.items():
        if not allowed.excess(shown.arguments.get(name, "")) <= 1e-6:
            yield f"{name} is {_text(shown.arguments.get(name, ''))}, the cell demands {allowed}"


def _object(demand: Demand, shown: Shown) -> Iterator[str]:
    for role, allowed in demand.models.items():
        if allowed.excess(shown.models.get(role, "")):
            yield f"the {role} is {shown.models.get(role) or 'missing'}, the cell demands {allowed}"
    for role, kinds in demand.modifiers.items():
        for kind, allowed in kinds.items():
            value = shown.modifiers.get(role, {}).get(kind, "")
            if not allowed.excess(value) <= 1e-6:
                yield f"{kind} of the {role} is {_text(value)}, the cell demands {allowed}"
    for role, pixels in shown.pixels.items():
        if not pixels >= VISIBLE_PX:
            yield f"the {role} has {pixels:.0f} visible pixels in the best fixed camera, at least {VISIBLE_PX} expected"
    for role, difference in shown.colors.items():
        if role != "table" and not difference <= COLOR_DIFFERENCE:
            yield (
                f"the {role}'s median colour is {difference:.1f} (CIEDE2000) from that of its model, at most "
                f"{COLOR_DIFFERENCE:g} expected"
            )


def _distractors(demand: Demand, shown: Shown) -> Iterator[str]:
    least, most = demand.distractors
    if not least <= len(shown.others) <= most:
        expected = f"{least}" if least == most else f"{least} to {most}"
        yield f"{len(shown.others)} distractors lie on the table, {expected} expected"


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


def _light(demand: Demand, shown: Shown) -> Iterator[str]:
    yield from _within(demand, shown, ("light", "exposure"))
    for name, difference in shown.brightness.items():
        if not abs(difference) <= BRIGHTNESS:
            yield (
                f"the picture of camera '{name}' differs by {difference:+.1f} of 255 from the luminance that its light "
                f"gives, at most {BRIGHTNESS:g} expected"
            )


def _texture(demand: Demand, shown: Shown) -> Iterator[str]:
    yield from _within(demand, shown, ("table", "floor", "wall", "background"))
    if not shown.colors.get("table", 0.0) <= COLOR_DIFFERENCE:
        yield (
            f"the table's median colour is {shown.colors['table']:.1f} (CIEDE2000) from that of its material, at most "
            f"{COLOR_DIFFERENCE:g} expected"
        )


def _words(demand: Demand, shown: Shown) -> Iterator[str]:
    wanted = shown.instruction if demand.words is None else demand.words
    if shown.received != wanted:
        yield f"the policy received '{shown.received}', expected '{wanted}'"


def _latency(demand: Demand, shown: Shown) -> Iterator[str]:
    if not abs(shown.latency_ticks - demand.latency_ticks) <= 1e-6:
        yield f"the policy's answers were {shown.latency_ticks:g} ticks late, {demand.latency_ticks} expected"


CHECKS: Mapping[str, Check] = {
    "skill": _skill, "object": _object, "distractors": _distractors, "area": _area, "start": _start,
    "camera": _camera, "light": _light, "texture": _texture, "words": _words,
    "latency": _latency,
}  # fmt: skip
"""Checks by name. Each yields what is wrong, with figures; nothing: the episode passes."""
OF_CELLS = ("skill", "object", "area", "camera")
"""Checks that tell one cell from another."""


def faults_of(demand: Demand, shown: Shown) -> dict[str, str]:
    """Return what is wrong with an episode: check to the fault, with figures; empty: it belongs to its cell."""
    found = {name: "; ".join(check(demand, shown)) for name, check in CHECKS.items()}
    return {name: text for name, text in found.items() if text}


def belongs_to(demand: Demand, shown: Shown) -> bool:
    """Return whether an episode is one of a cell by its content, whatever cell it claims. Pictures do not count."""
    plain = Shown(
        bag=shown.bag, cell=shown.cell, number=shown.number, skill=shown.skill, arguments=shown.arguments,
        models=shown.models, modifiers=shown.modifiers, positions=shown.positions, cameras=shown.cameras,
    )  # fmt: skip
    return not any(any(CHECKS[name](demand, plain)) for name in OF_CELLS)
