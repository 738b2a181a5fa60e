"""The errors of a wire. Each ends one episode, by the reason that its code names."""

from __future__ import annotations

import math
import time
from typing import Any

from roboxim_core.errors import ErrorCode, PolicyError, printable

LONGEST_REPLY = 600
"""Characters of a server's text that a message repeats."""
GATEWAY = (502, 503, 504)
"""HTTP statuses by which a proxy says that the server behind it is away."""


def died(message: str) -> PolicyError:
    """Return the error of a server that is missing or was lost: ``policy_died``."""
    return PolicyError(message, ErrorCode.POLICY_DIED)


def late(message: str) -> PolicyError:
    """Return the error of a server that did not answer before the deadline: ``policy_late``."""
    return PolicyError(message, ErrorCode.POLICY_LATE)


def fault(message: str) -> PolicyError:
    """Return the error of a server that reported an error, or broke the protocol: ``policy_fault``."""
    return PolicyError(message, ErrorCode.POLICY_FAULT)


def invalid(message: str) -> PolicyError:
    """Return the error of an answer whose actions cannot be used: ``invalid_action``."""
    return PolicyError(message, ErrorCode.INVALID_ACTION)


def unreadable(message: str) -> PolicyError:
    """Return the error of a message that cannot be decoded: ``policy_fault``."""
    return fault(f"the server's message cannot be read: {message}")


REDIRECTS = (300, 301, 302, 303, 307, 308)
"""HTTP statuses that send a client to another address."""


def redirected(server: str, status: int, location: Any) -> PolicyError:
    """Return the error of a server that redirects its client. No wire follows: others would get its observations.

    Args:
        server: Name of the server, for the message.
        status: HTTP status.
        location: Address that the server named; None: none.
    """
    where = f" to {printable(location, 200)}" if location else ""
    return fault(
        f"{server} redirects{where} (HTTP status {status}); RoboXim follows no redirect. If that is the policy server, "
        "give its address as url"
    )


def quoted(text: Any) -> str:
    """Return the most telling part of a server's text: a traceback's last line, or the beginning."""
    text = printable(text, 20_000).strip()
    if text.startswith("Traceback (most recent call last)"):
        text = text.splitlines()[-1].strip()
    return printable(text, LONGEST_REPLY)


class Deadline:
    """A point in time by which one operation must end, regardless of its number of steps."""

    def __init__(self, seconds: float) -> None:
        """Start the time.

        Args:
            seconds: Time from now [s].
        """
        self.seconds = seconds
        self._end = time.monotonic() + seconds

    def left(self, what: str) -> float:
        """Return the time that is left [s], > 0.

        Args:
            what: What one waits for, for the message, e.g. ``"the reply of ws://host:8000"``.

        Raises:
            PolicyError: With code ``POLICY_LATE`` when no time is left.
        """
        left = self._end - time.monotonic()
        if left <= 0:
            raise self.passed(what)
        return left

    def left_ms(self, what: str) -> int:
        """Return the time that is left [ms], rounded up; see `left`."""
        return math.ceil(self.left(what) * 1000)

    def passed(self, what: str) -> PolicyError:
        """Return the error of a deadline that has passed."""
        return late(f"{what} did not come within {self.seconds:g} s; a slower server needs a longer timeout_s")
