"""Clocks, and whether state and images are of the same time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from roboxim_datasets.audit.check import AUDIT_CHECKS, AuditCheck
from roboxim_datasets.audit.values import AuditEpisode, CannotCheckError, Finding, Values

CLOCK_S = 1e-4
LAG = 4
PEAK = 0.4
GAIN = 0.1
WEAK = 0.3
SHORT = 16
"""Fewest pairs of changes that are correlated: at 12 the correlation of a clean episode was best at lag 1."""


@AUDIT_CHECKS.register("clock")
class Clock(AuditCheck):
    """Observations that are not one control period apart."""

    title = "The clock is uneven"
    reason = "Readers look images up by time: an uneven clock gives another tick's image, or an error in mid-training."
    threshold = (
        f"a distance between two stamps that differs from 1 / rate by more than {1000 * CLOCK_S:g} ms and the rounding "
        "of stamps to float32, as LeRobot stores them"
    )
    needs = "stamps, which bags and LeRobot datasets have"
    order = 16

    def look(self, episode: AuditEpisode) -> Iterator[Finding]:
        """Find uneven stamps."""
        if episode.stamps_s is None:
            raise CannotCheckError("the format stores no stamps")
        period = 1.0 / episode.rate_hz
        spacing = np.diff(episode.stamps_s)
        rounding = np.spacing(np.abs(episode.stamps_s[1:]).astype(np.float32))
        wrong = np.flatnonzero(np.abs(spacing - period) > CLOCK_S + rounding)
        if len(wrong):
            worst = int(wrong[np.abs(spacing[wrong] - period).argmax()])
            yield episode.finding(
                f"{len(wrong)} of {len(spacing)} distances differ from {1000 * period:.1f} ms, most at tick "
                f"{worst + 1}: {1000 * spacing[worst]:.1f} ms",
                ticks=(worst, worst + 1),
                series={"time between ticks [ms]": tuple(1000 * spacing)},
            )


@AUDIT_CHECKS.register("state_lag")
class StateLag(AuditCheck):
    """State and images of different times.

    Non-obvious: what is compared is how much the image and the state change from tick to tick, without its slow part.
    Measured on 48 clean episodes of all skills with injected noise: the correlation peaks at lag 0 in each.
    """

    title = "State and images are not of the same time"
    reason = "The policy learns the delay of one robot's drivers, and acts too late or too early on another one."
    threshold = (
        f"changes of image and state correlate best at another lag than 0, with {PEAK:g} or more there and at least "
        f"{GAIN:g} less at lag 0"
    )
    needs = "images, the position of the hand, an arm that does not move evenly"
    order = 17

    def look(self, episode: AuditEpisode) -> Iterator[Finding]:
        """Find lags."""
        if not episode.episode.cameras:
            raise CannotCheckError("the dataset has no images")
        speed = np.diff(np.log1p(1000 * _speed(episode)))
        if len(speed) - 2 * LAG < SHORT:
            raise CannotCheckError("the episode is too short for a correlation")
        curves = [_correlations(np.diff(np.log1p(track.motion)), speed) for track in episode.tracks.values()]
        curve = np.mean(curves, axis=0)
        best = int(curve.argmax()) - LAG
        if curve.max() < WEAK:
            raise CannotCheckError("the images' changes do not follow the state's")
        if best and curve.max() >= PEAK and curve.max() - curve[LAG] >= GAIN:
            yield episode.finding(
                f"the state is {abs(best)} {'tick' if abs(best) == 1 else 'ticks'} "
                f"{'late' if best > 0 else 'early'}: correlation {curve.max():.2f}, without lag {curve[LAG]:.2f}",
                ticks=(len(speed) // 2, min(len(speed) // 2 + abs(best), len(episode.episode) - 1)),
                series={f"correlation at lags {-LAG} to {LAG}": tuple(curve)},
            )


def _speed(episode: AuditEpisode) -> Values:
    """Return how much the hand moves from tick to tick, in metres or what looks alike."""
    moved: Values = np.linalg.norm(np.diff(episode.field("tcp_position"), axis=0), axis=1).astype(float)
    if "tcp_rotation_6d" in episode.proprio:
        moved += 0.1 * np.linalg.norm(np.diff(episode.proprio["tcp_rotation_6d"], axis=0), axis=1)
    if "gripper_opening" in episode.proprio:
        moved += 0.02 * np.abs(np.diff(episode.proprio["gripper_opening"][:, 0]))
    return moved


def _correlations(seen: Values, speed: Values) -> Values:
    """Return the correlation of the images' changes with the state's at each lag of the state."""
    inside = np.arange(LAG, len(speed) - LAG)
    found = []
    for lag in range(-LAG, LAG + 1):
        a, b = seen[inside], speed[inside + lag]
        found.append(float(np.corrcoef(a, b)[0, 1]) if a.std() > 0 and b.std() > 0 else 0.0)
    return np.array(found)
