"""Bounds of every count, size, string and duration in requests and files from outside.

A bound is far above what users need and far below what would stop a node from answering. A larger value is refused with
``INVALID_REQUEST`` (or ``INVALID_CONFIG`` in a file), which names the bound.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import Final

from roboxim_core.errors import InvalidRequestError

NAME_CHARACTERS: Final = 64
"""Characters of the name of an entity, a camera or a role: the name becomes part of a topic or a frame."""
EPISODE_ID_CHARACTERS: Final = 128
"""Characters of an episode's id: with a suffix it is a file name, which has at most 255 bytes."""
FILE_NAME_CHARACTERS: Final = 200
"""Characters of a name that is looked up as a file: a file system allows 255 bytes, suffix included."""
SHORT_TEXT_CHARACTERS: Final = 10_000
"""Characters of a string field of a message, except for those in `LONG_TEXTS`: error messages with suggestions compare
names in quadratic time."""
LONG_TEXT_CHARACTERS: Final = 16 * 2**20
"""Characters of a string field that holds a document."""
LONG_TEXTS: Final = frozenset({"task_config", "task_config_json", "config_json", "snapshot_json", "resource_string"})
"""String fields that hold a document: YAML or JSON."""
ITEMS: Final = 10_000
"""Elements of a sequence of messages or strings in a message, unless `FIELD_ITEMS` names it: handlers loop over it."""
FIELD_ITEMS: Final = {
    "points": 100_000, "indices": 100_000,
    "stages": 100, "goals": 1_000, "waypoints": 1_000, "alternatives": 1_000, "objects": 1_000, "attached": 100,
}  # fmt: skip
"""Sequences with a bound of their own, by the field's name: points of a trajectory are many; each stage, goal and
object costs the planner milliseconds at least."""
MESSAGE_ITEMS: Final = 500_000
"""Elements of all sequences of messages or strings of a message together: sequences inside of sequences multiply."""
MESSAGE_CHARACTERS: Final = 32 * 2**20
"""Characters of all strings of a message together."""
NUMBERS: Final = 2**28
"""Elements of a sequence of numbers in a message: an image of 4096 x 4096 px with 16 bytes a pixel."""

ENTITIES: Final = 200
"""Entities of a scene: PyBullet checks pairs of them, and each costs 5 ms of a reset."""
CAMERAS: Final = 16
"""Cameras of a scene."""
SCENE_PIXELS: Final = 2**24
"""Pixels of all cameras of a scene together: a software renderer draws 6 million of them a second."""
LIGHTS: Final = 16
"""Lights of a scene: each costs time per pixel."""
LENGTH_M: Final = 100.0
"""Largest coordinate, size or distance [m]: beyond it single-precision physics and images lose millimetres."""
SPEED: Final = 1_000.0
"""Largest linear [m/s] or angular [rad/s] speed that an object is set to."""
FORCE_N: Final = 1_000.0
"""Largest force of a gripper [N]."""
PHYSICS_RATE_HZ: Final = (10.0, 10_000.0)
"""Physics steps per simulated second."""
TICK_STEPS: Final = 2_400
"""Physics steps of a tick: 10 s at 240 Hz."""
SETTLE_STEPS: Final = 24_000
"""Physics steps between building a scene and tick 0: 100 s at 240 Hz."""

STEPS: Final = 864_000
"""Physics steps of one request: an hour of simulated time at 240 Hz."""
MOTION_S: Final = 600.0
"""Duration of a trajectory [s]: its set points are held in memory, and a planned one is checked every millisecond."""
JOINT_POSITION: Final = 1_000.0
"""Largest joint position of a path or trajectory [rad] or [m]: collisions are checked along the way to it."""
TRAJECTORY_POINTS: Final = 200_000
"""Points of all trajectories of an answer together: each takes a kilobyte."""
IMPROVE_ITERATIONS: Final = 1_000_000
"""Iterations of a path planner: each may add a state to a tree in memory."""
WALL_TIME_S: Final = 600.0
"""Longest wall-clock time-out that a request may ask for [s]."""
SNAPSHOT_ACTIONS: Final = 100_000
"""Actions of a snapshot: restoring it executes them all."""

EPISODE_STEPS: Final = 100_000
"""Actions of an episode."""
SERVICE_EPISODES: Final = 100
"""Episodes of one request to the blocking service, which cannot be cancelled; the action runs `FIELD_ITEMS`."""
ATTEMPTS: Final = 10_000
"""Attempts at an episode until one is kept."""
WINDOW: Final = 1_000
"""Observations of a request to a policy: they are held in memory."""
POLICY_TIMEOUT_S: Final = 86_400.0
"""Longest wait for a policy's answer [s]."""
IMAGE_PX: Final = 4_096
"""Width and height of an image [px]."""

DOCUMENT_BYTES: Final = 32 * 2**20
"""Size of a YAML or JSON document."""
DOCUMENT_DEPTH: Final = 64
"""Nesting of a YAML or JSON document; Python's own limit is some 300 levels of a recursive reader."""
DOCUMENT_NODES: Final = 1_000_000
"""Values in a document, including those that aliases repeat: nine levels of nine aliases would be 400 million."""
YAML_BYTES: Final = 2 * 2**20
"""Size of a YAML file: the reader that keeps line numbers takes 20 s for a file of this size."""
MIX_CELLS: Final = 10_000
"""Cells of a mix: each is checked when the mix is loaded."""
MIX_EPISODES: Final = 10**12
"""Episodes of a cell of a mix."""

ERROR_CHARACTERS: Final = 4_000
"""Characters of an error's message in an answer."""
LOG_CHARACTERS: Final = 20_000
"""Characters of a log entry."""
ECHO_CHARACTERS: Final = 100
"""Characters of a given value that an error's message repeats."""

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_FREE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_. -]*")
_EPISODE_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


def printable(text: str, characters: int = ERROR_CHARACTERS) -> str:
    """Return a text that fits a message: no longer than the limit, valid UTF-8, without NUL."""
    if len(text) > characters:
        text = f"{text[: characters - 40]} ... ({len(text)} characters)"
    return text.encode("utf-8", "backslashreplace").decode("utf-8").replace("\0", "\\0")


def is_file_name(name: str) -> bool:
    """Return whether a name with an ending is a valid file name that cannot lead out of its folder."""
    return 0 < len(name.encode("utf-8", "replace")) <= FILE_NAME_CHARACTERS and not set(name) & set("/\\\0")


def echo(value: object) -> str:
    """Return a given value for an error message: quoted, and cut if it is long."""
    return printable(repr(value), ECHO_CHARACTERS + 40)


def require_range(what: str, value: float, lower: float, upper: float) -> None:
    """Refuse a number outside a range; NaN is outside every range.

    Raises:
        InvalidRequestError: Naming the number and its range.
    """
    if not lower <= value <= upper:
        raise InvalidRequestError(f"{what} must be from {lower:g} to {upper:g}, got {echo(value)}")


def require_count(what: str, count: int, upper: int) -> None:
    """Refuse a count above its bound.

    Raises:
        InvalidRequestError: Naming the counted items and the bound.
    """
    if count > upper:
        raise InvalidRequestError(f"at most {upper} {what} are allowed, got {count}")


def require_finite(what: str, values: Iterable[float], largest: float = math.inf) -> None:
    """Refuse numbers that are not finite or too large.

    Raises:
        InvalidRequestError: Naming the number.
    """
    for value in values:
        if not (math.isfinite(value) and abs(value) <= largest):
            limit = f" and within +-{largest:g}" if math.isfinite(largest) else ""
            raise InvalidRequestError(f"{what} must be finite{limit}, got {echo(value)}")


def require_name(kind: str, name: str, reserved: Iterable[str] = (), *, topic: bool = False) -> None:
    """Refuse a name that cannot be part of a frame, or that is reserved.

    Args:
        kind: Kind of the named thing, for the message, e.g. ``entity``.
        name: The name.
        reserved: Reserved names.
        topic: Whether the name becomes part of a topic, where fewer characters are allowed.

    Raises:
        InvalidRequestError: The message says which names are valid.
    """
    if len(name) > NAME_CHARACTERS or not (_NAME if topic else _FREE_NAME).fullmatch(name):
        allowed = (
            "a letter followed by letters, digits and underscores"
            if topic
            else ("letters, digits, underscores, dots, hyphens and spaces, beginning with a letter or digit")
        )
        raise InvalidRequestError(f"{kind} name {echo(name)} must be {allowed}, at most {NAME_CHARACTERS} characters")
    taken = sorted(reserved)
    if name in taken:
        raise InvalidRequestError(f"{kind} name '{name}' is reserved; choose a name other than {', '.join(taken)}")


def require_episode_id(episode_id: str) -> None:
    """Refuse an episode's id that cannot be a file name; an empty id means no episode.

    Raises:
        InvalidRequestError: The message says which ids are valid.
    """
    if episode_id and (len(episode_id) > EPISODE_ID_CHARACTERS or not _EPISODE_ID.fullmatch(episode_id)):
        raise InvalidRequestError(
            f"episode_id {echo(episode_id)} must be letters, digits, dots, hyphens and underscores, beginning with a "
            f"letter or digit, at most {EPISODE_ID_CHARACTERS} characters"
        )
