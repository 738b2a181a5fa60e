"""The hierarchy of errors, and the numeric codes in every service and action result.

Each package raises its own subclass. A node converts it to ``error_code`` and ``error_msg``; a client converts those
back to the same class, so an error looks the same on both sides of a service call. The message
``roboxim_interfaces/msg/ErrorCode`` repeats the codes as constants; a test checks that the two lists are equal.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable
from enum import IntEnum


class ErrorCode(IntEnum):
    """Result codes: 0 OK, 1xx any package, 2xx planner, 3xx sim, 4xx tasks, 5xx recorder, 6xx eval, 7xx policies."""

    OK = 0

    INTERNAL = 100
    INVALID_REQUEST = 101
    INVALID_CONFIG = 102
    TIMEOUT = 103
    UNAVAILABLE = 104
    CANCELLED = 105
    DISK = 106

    PLANNING_FAILED = 200
    STALE_SCENE = 201
    START_IN_COLLISION = 202
    START_OUTSIDE_LIMITS = 203
    GOAL_UNREACHABLE = 204
    GOAL_IN_COLLISION = 205
    PATH_INCOMPLETE = 206
    TRAJECTORY_INVALID = 207
    UNKNOWN_FRAME = 208
    CONSTRAINT_VIOLATED = 209

    SIM_FAULT = 300
    NO_SCENE = 301
    LEASE_HELD = 302
    WRONG_SEQ = 303
    INVALID_ACTION = 304
    UNKNOWN_ENTITY = 305
    UNKNOWN_CAMERA = 306
    RENDERER_UNAVAILABLE = 307
    DIVERGED = 308
    UNKNOWN_MODEL = 309
    LEFT_WORKSPACE = 310

    TASK_FAULT = 400
    UNKNOWN_SKILL = 401
    RESET_INFEASIBLE = 402
    NO_EXPERT = 403
    UNKNOWN_EPISODE = 404

    RECORDER_FAULT = 500
    EPISODE_GAP = 501
    EPISODE_NOT_OPEN = 502
    EPISODE_EXISTS = 503
    BAG_DAMAGED = 504
    EXPORT_REFUSED = 505

    EVALUATION_FAULT = 600
    OBSERVATION_MISSING = 601
    SEMANTICS_MISMATCH = 602

    POLICY_FAULT = 700
    POLICY_DIED = 701
    POLICY_LATE = 702


class RoboximError(Exception):
    """Base class of all errors that RoboXim raises on purpose.

    The message says what was wrong, what was expected and what to do. ``code`` becomes the code of a service result.
    """

    code: ErrorCode = ErrorCode.INTERNAL

    def __init__(self, message: str, code: ErrorCode | int | None = None) -> None:
        """Make the error.

        Args:
            message: What was wrong, what was expected, what to do.
            code: A more specific code than the class's default.
        """
        super().__init__(message)
        if code is not None:
            self.code = ErrorCode(code)


class InvalidRequestError(RoboximError):
    """A request or argument is malformed: NaN, a wrong shape, an unknown name."""

    code = ErrorCode.INVALID_REQUEST


class ConfigError(RoboximError):
    """A configuration (YAML, command line, parameter) is wrong. Raised before anything starts."""

    code = ErrorCode.INVALID_CONFIG


class RequestTimeoutError(RoboximError):
    """A deadline passed. Deadlines never change a result; they only raise this error."""

    code = ErrorCode.TIMEOUT


class UnavailableError(RoboximError):
    """A peer (node, service, policy, library) is missing or has died."""

    code = ErrorCode.UNAVAILABLE


class PlannerError(RoboximError):
    """The planner cannot fulfil a request (2xx)."""

    code = ErrorCode.PLANNING_FAILED


class SimError(RoboximError):
    """The simulator refuses a request or fails (3xx)."""

    code = ErrorCode.SIM_FAULT


class TaskError(RoboximError):
    """A task, a reset, an expert or a judge refuses a request or fails (4xx)."""

    code = ErrorCode.TASK_FAULT


class RecorderError(RoboximError):
    """A bag or a dataset cannot be written, read or exported (5xx)."""

    code = ErrorCode.RECORDER_FAULT


class EvaluationError(RoboximError):
    """An evaluation cannot run (6xx)."""

    code = ErrorCode.EVALUATION_FAULT


class PolicyError(RoboximError):
    """A policy misbehaved (7xx); that episode fails, the run continues."""

    code = ErrorCode.POLICY_FAULT


_FAMILIES: dict[int, type[RoboximError]] = {
    2: PlannerError,
    3: SimError,
    4: TaskError,
    5: RecorderError,
    6: EvaluationError,
    7: PolicyError,
}
_EXACT: dict[int, type[RoboximError]] = {
    cls.code: cls for cls in (InvalidRequestError, ConfigError, RequestTimeoutError, UnavailableError)
}


def raise_for_code(error_code: int, error_msg: str) -> None:
    """Raise the error that a result's code and message describe; return if the code is OK.

    Args:
        error_code: ``error_code`` of a service or action result.
        error_msg: ``error_msg`` of the result.

    Raises:
        RoboximError: The subclass for the code's range, with the code and message.
    """
    if error_code == ErrorCode.OK:
        return
    try:
        code = ErrorCode(error_code)
    except ValueError:
        raise RoboximError(f"unknown error code {error_code}: {error_msg}") from None
    cls = _EXACT.get(error_code) or _FAMILIES.get(error_code // 100, RoboximError)
    raise cls(error_msg, code)


def printable(value: object, limit: int = 2000, *, form: Callable[[object], str] = str) -> str:
    """Return a text that is valid in any message, even if the value's ``__str__`` or ``__repr__`` misbehaves.

    Args:
        value: For example an exception that a user's code raised.
        limit: Largest length [characters]; longer text is cut.
        form: ``str`` or ``repr``.
    """
    try:
        text = form(value)
    except (Exception, SystemExit):
        text = f"(a {type(value).__name__} that cannot be shown)"
    text = text if len(text) <= limit else f"{text[:limit]}..."
    return text.replace("\0", "\\0").encode("utf-8", "backslashreplace").decode("utf-8")


LISTED = 8
"""Largest number of names that a message lists; of more names, it shows the ones nearest to the given one."""


def one_of(choices: Iterable[str], given: str) -> str:
    """Return the end of an error message: which names are valid.

    Args:
        choices: The valid names.
        given: The name that was not among them.

    Returns:
        For example ``"expected one of: apple, cube (did you mean 'cube'?)"``. Of many names only the nearest:
        ``"did you mean 'cube'? (33 names are known)"``, or all of them when none is near.
    """
    names = sorted(choices)
    hint = nearest(names, given)
    if hint and len(names) > LISTED:
        return f"{hint} ({len(names)} names are known)"
    return f"expected one of: {', '.join(names) or '(none registered)'}{f' ({hint})' if hint else ''}"


def counted(number: int, noun: str, nouns: str = "") -> str:
    """Return a number of things in words, e.g. ``1 scene`` or ``0 policies``.

    Args:
        number: How many.
        noun: Word for one of them.
        nouns: Word for several; empty: with an ``s``.
    """
    return f"{number} {noun if number == 1 else nouns or f'{noun}s'}"


def listed(names: Iterable[str]) -> str:
    """Return names as a sentence lists them, e.g. ``a, b and c``."""
    *others, last = names
    return f"{', '.join(others)} and {last}" if others else last


def nearest(choices: Iterable[str], given: str) -> str:
    """Return a hint at what was probably meant, e.g. ``"did you mean 'cube'?"``; empty: none is near, nor holds it."""
    names = [str(name) for name in choices]  # a member of an enumeration would be shown as code
    close = difflib.get_close_matches(given[:200], names, n=1)
    close = close or [name for name in names if len(given) > 2 and given.lower() in name][:3]
    return f"did you mean {' or '.join(repr(name) for name in close)}?" if close else ""
