"""From held keys, a gamepad or a dragged gizmo to an action of the default meaning. Pure: no page, no time."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from roboxim_core.actions import ActionArray
from roboxim_core.kinematics import delta_between
from roboxim_core.poses import Pose
from roboxim_studio.acting.space_mouse import SpaceMouse

KEYS: Mapping[str, tuple[int, float]] = {
    "KeyW": (0, 1.0), "KeyS": (0, -1.0), "KeyA": (1, 1.0), "KeyD": (1, -1.0), "KeyR": (2, 1.0), "KeyF": (2, -1.0),
    "KeyL": (3, 1.0), "KeyJ": (3, -1.0), "KeyI": (4, 1.0), "KeyK": (4, -1.0), "KeyQ": (5, 1.0), "KeyE": (5, -1.0),
}  # fmt: skip
"""Key to the component of the action that it moves, and the direction."""
SLOW_KEYS = ("ShiftLeft", "ShiftRight")
GRIPPER, KEEP, THROW, HAND, BEGIN = "Space", "Enter", "Backspace", "KeyT", "KeyN"
AXES: Mapping[int, tuple[int, float]] = {1: (0, -1.0), 0: (1, -1.0), 3: (2, -1.0), 2: (5, -1.0)}
"""Axis of a standard gamepad to the component of the action and the direction: sticks move along x, y, z and turn."""
ROLL_BUTTONS: Mapping[int, float] = {4: -1.0, 5: 1.0}
GRIPPER_BUTTON, HAND_BUTTON, THROW_BUTTON, KEEP_BUTTON = 0, 3, 8, 9
SLOW_BUTTON = 6
ONCE: Mapping[int, str] = {GRIPPER_BUTTON: GRIPPER, HAND_BUTTON: HAND, KEEP_BUTTON: KEEP, THROW_BUTTON: THROW}
"""Button of a gamepad to the key that does the same, once."""
SPACE_MOUSE_ONCE: Mapping[int, str] = {0: GRIPPER, 1: KEEP}
"""The same of a SpaceMouse, whose smallest models have two buttons."""
DEAD_ZONE = 0.15
"""Deflection of a stick below which it rests."""
SLOW = 0.25
"""Factor of the speeds while slow is held."""
MAX_HELD_KEYS = 16
HELP = (
    "W S: away, back\nA D: left, right\nR F: up, down\nQ E: turn\nI K, J L: tilt\nShift: slowly\n"
    "Space: open or close\nEnter: end and keep\nBackspace: throw away\nN: begin the next, when none runs"
)


@dataclass(frozen=True, kw_only=True)
class Speeds:
    """How fast the tool follows."""

    translation_m_s: float = 0.2
    """Speed along each axis [m/s]."""
    rotation_rad_s: float = 1.0
    """Speed about each axis [rad/s]."""


@dataclass(frozen=True, kw_only=True)
class Steering:
    """What a person holds at a moment."""

    held: frozenset[str] = frozenset()
    """Codes of the held keys."""
    axes: tuple[float, ...] = ()
    """Deflections of a gamepad's sticks, -1..1."""
    buttons: tuple[float, ...] = ()
    """Pressure on its buttons, 0..1."""
    space_mouse: SpaceMouse = SpaceMouse()
    """A SpaceMouse."""
    target: Pose | None = None
    """Pose in the robot's base to which the tool goes while nothing else is held; None: it stays."""

    @staticmethod
    def of_message(message: Mapping[str, Any]) -> Steering:
        """Return what a message of a page says; what is not understood counts as not held."""
        held = message.get("held")
        pad = message.get("pad")
        codes = [code for code in held if isinstance(code, str)][:MAX_HELD_KEYS] if isinstance(held, list) else []
        pad = pad if isinstance(pad, dict) else {}
        return Steering(
            held=frozenset(codes), axes=_numbers(pad.get("axes")), buttons=_numbers(pad.get("buttons")),
            space_mouse=SpaceMouse.of_reports(message.get("hid")),
        )  # fmt: skip

    def pressed(self, button: int) -> bool:
        """Return whether a button of the gamepad is pressed."""
        return button < len(self.buttons) and self.buttons[button] > 0.5

    def once(self) -> frozenset[str]:
        """Return the keys that pressed buttons stand for."""
        mouse = {key for button, key in SPACE_MOUSE_ONCE.items() if button in self.space_mouse.buttons}
        return frozenset(mouse | {key for button, key in ONCE.items() if self.pressed(button)})

    @property
    def slow(self) -> bool:
        """Whether to move slowly."""
        return any(key in self.held for key in SLOW_KEYS) or self.pressed(SLOW_BUTTON)

    def directions(self) -> tuple[float, ...]:
        """Return the wanted direction of each of the six components, -1..1."""
        wanted = [0.0] * 6
        for key in self.held:
            if key in KEYS:
                component, sign = KEYS[key]
                wanted[component] += sign
        for axis, (component, sign) in AXES.items():
            value = self.axes[axis] if axis < len(self.axes) else 0.0
            if abs(value) > DEAD_ZONE:
                wanted[component] += sign * math.copysign((abs(value) - DEAD_ZONE) / (1 - DEAD_ZONE), value)
        for button, sign in ROLL_BUTTONS.items():
            wanted[3] += sign * self.pressed(button)
        for component, value in enumerate(self.space_mouse.directions):
            wanted[component] += value
        return tuple(min(max(value, -1.0), 1.0) for value in wanted)


def action_of(
    steering: Steering, commanded: Pose, opening: float, rate_hz: float, speeds: Speeds | None = None
) -> ActionArray:
    """Return the action of one tick: an end-effector delta and the gripper's opening, float32, shape (7,).

    Args:
        steering: What is held.
        commanded: Commanded pose of the tool in the robot's base.
        opening: Wanted opening of the gripper, 1 = open.
        rate_hz: Control rate [Hz].
        speeds: How fast to move; none: the default.
    """
    speeds = speeds or Speeds()
    factor = (SLOW if steering.slow else 1.0) / rate_hz
    bound = np.array([speeds.translation_m_s] * 3 + [speeds.rotation_rad_s] * 3) * factor
    directions = np.array(steering.directions())
    if not directions.any() and steering.target is not None:
        delta = np.array(delta_between(commanded, steering.target, opening), dtype=float)[:6]
        for part in (slice(0, 3), slice(3, 6)):
            size = float(np.linalg.norm(delta[part]))
            if size > bound[part][0]:
                delta[part] *= bound[part][0] / size
    else:
        delta = directions * bound
    return np.array([*delta, opening], np.float32)


def moves(action: ActionArray, opening: float) -> bool:
    """Return whether an action moves anything, given the gripper's commanded opening."""
    return bool(np.abs(action[:6]).max() > 1e-5 or abs(float(action[6]) - opening) > 1e-3)


def _numbers(values: Any) -> tuple[float, ...]:
    """Return finite numbers within -1..1; anything else is 0."""
    if not isinstance(values, list):
        return ()
    return tuple(
        min(max(float(value), -1.0), 1.0) if isinstance(value, int | float) and math.isfinite(value) else 0.0
        for value in values[:MAX_HELD_KEYS]
    )


def offset_words(base: Pose, tool: tuple[float, ...], aim: tuple[float, ...], name: str) -> str:
    """Return where an object's middle is from the tool, in the directions of the keys, e.g. ``target: 21 mm away``.

    Args:
        base: Pose of the robot's base in the world.
        tool: Position of the tool in the world [m].
        aim: Position of the object in the world [m].
        name: The object.
    """
    turned = Pose(quat_xyzw=base.quat_xyzw).inverse().apply(np.subtract(aim, tool))
    words = (("away", "back"), ("left", "right"), ("up", "down"))
    parts = [f"{abs(v) * 1000:.0f} mm {way[int(v < 0)]}" for v, way in zip(turned, words, strict=True)]
    return f"{name} from the tool: {', '.join(parts)}"
