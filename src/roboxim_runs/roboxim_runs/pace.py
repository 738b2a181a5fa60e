"""The speed of a running job, and an estimate of its remaining time."""

from __future__ import annotations

from collections import deque

WINDOW_S = 900.0
"""Time over which the rate is measured [s]: long enough for rare units, short enough to follow a lost machine."""
UNITS = ((1.0, "s"), (60.0, "min"), (3600.0, "h"))
"""Rates are given per the first of these times in which at least one unit is done."""


class Pace:
    """Rate of the last `WINDOW_S`, from counts at times that the caller gives.

    The time until the first unit is done does not count: workers start in it, and a job that continues leaps from 0 to
    what was done before.
    """

    def __init__(self) -> None:
        """Begin without any count."""
        self._counts: deque[tuple[float, int]] = deque()

    def add(self, time_s: float, done: int) -> None:
        """Store a count.

        Args:
            time_s: Time of the count, not before the last one [s].
            done: Units done then.
        """
        if self._counts and done < self._counts[-1][1]:  # counted again, e.g. after a worker's death
            self._counts.clear()
        if not done or (self._counts and done == self._counts[-1][1]):
            return
        self._counts.append((time_s, done))
        while len(self._counts) > 2 and self._counts[1][0] < time_s - WINDOW_S:
            self._counts.popleft()

    def per_second(self, now_s: float) -> float | None:
        """Return the rate [1/s]; none before two counts. A unit that is late lowers the rate.

        Args:
            now_s: Present time [s].
        """
        if len(self._counts) < 2:
            return None
        (begun, before), (last, done) = self._counts[0], self._counts[-1]
        late = now_s - last > 2 * (last - begun) / (done - before)
        return (done - before) / max((now_s if late else last) - begun, 1e-9)

    def text(self, now_s: float, left: int) -> str:
        """Return the rate and the remaining time in words, e.g. ``12/min, 3 min left``; empty while unknown.

        Args:
            now_s: Present time [s].
            left: Units that are left.
        """
        rate = self.per_second(now_s)
        if rate is None:
            return ""
        return rate_text(rate) + (f", {duration_text(left / rate)} left" if left else "")


def rate_text(per_second: float) -> str:
    """Return a rate as a few digits per second, minute or hour."""
    seconds, unit = next((unit for unit in UNITS if per_second * unit[0] >= 1), UNITS[-1])
    count = per_second * seconds
    return f"{count:,.0f}/{unit}" if count >= 10 else f"{count:.1f}/{unit}"


def duration_text(seconds: float) -> str:
    """Return a duration in one or two units, e.g. ``45 s``, ``12 min``, ``3 h 20 min`` or ``2 d 4 h``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if minutes < 90:
        return f"{minutes} min"
    hours, minutes = divmod(minutes, 60)
    if hours < 48:
        return f"{hours} h {minutes} min" if minutes else f"{hours} h"
    days, hours = divmod(hours, 24)
    return f"{days} d {hours} h" if hours else f"{days} d"
