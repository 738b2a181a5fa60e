"""The demands of a cell, and the content of an episode's bag, as plain values.

`roboxim_runs.experiments.delivery.demands` reads them from task configurations, `reader` beside it from bags.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from roboxim_core.poses import Pose, Vec3

Value = str | float | tuple[float, ...]


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
            return " or ".join(value_text(value) for value in self.values)
        return f"from {value_text(self.lower)} to {value_text(self.upper)}"


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


def value_text(value: Value) -> str:
    """Format a value for messages."""
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
