"""Range and polarity of the gripper's commands."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from roboxim_datasets.audit.check import AUDIT_CHECKS, AuditCheck
from roboxim_datasets.audit.values import AuditEpisode, CannotCheckError, Finding
from roboxim_datasets.episode import Floats

SLACK = 0.01
MOVES = 0.1
LAG_S = 0.5
STEADY = 0.02
OPEN, SHUT = 0.9, 0.3


@AUDIT_CHECKS.register("gripper")
class Gripper(AuditCheck):
    """Commands of the gripper that are out of range or inverted."""

    title = "The gripper's commands are out of range or inverted"
    reason = "Datasets and trainers disagree on the gripper's polarity; inverted, a policy opens where it must grasp."
    threshold = (
        f"a command more than {SLACK:g} outside of the declared range; or a correlation of command and measured "
        f"opening below 0 at every lag up to {LAG_S:g} s"
    )
    needs = "the declared meaning of the actions; the measured opening for the polarity"
    order = 13

    def look(self, episode: AuditEpisode) -> Iterator[Finding]:
        """Find wrong ranges and polarities."""
        semantics = episode.episode.semantics
        if semantics is None:
            raise CannotCheckError("the dataset does not declare the gripper's polarity and range")
        command = np.array([semantics.gripper.opening(float(value)) for value in episode.actions[:, -1]], np.float32)
        outside = np.flatnonzero((command < -SLACK) | (command > 1 + SLACK))
        curves = {"commanded opening": tuple(command)}
        if len(outside):
            worst = int(outside[np.abs(command[outside] - 0.5).argmax()])
            yield episode.finding(
                f"{len(outside)} of {len(command)} commands are outside of {semantics.gripper}, e.g. "
                f"{episode.actions[worst, -1]:g} at tick {worst}",
                ticks=(worst,),
                series=curves,
            )
        if "gripper_opening" not in episode.proprio:
            if not len(outside):
                raise CannotCheckError("the range is right; the dataset has no measured opening for the polarity")
            return
        measured = episode.proprio["gripper_opening"][:, 0]
        text = _inverted(command, measured, lags=round(LAG_S * episode.rate_hz) + 1)
        if text:
            turn = int(np.abs(np.diff(command)).argmax()) if len(command) > 1 else 0
            yield episode.finding(
                text,
                ticks=(turn, min(turn + 5, len(command) - 1)),
                series={**curves, "measured opening": tuple(measured)},
            )


def _inverted(command: Floats, measured: Floats, lags: int) -> str:
    """Return how commands and measurements contradict each other at each of the first lags; empty if they do not."""
    if np.ptp(command) > MOVES and np.ptp(measured) > MOVES:
        pairs = [(command[: len(command) - lag], measured[lag:]) for lag in range(min(lags, len(command) - 3))]
        correlations = [_correlation(first, second) for first, second in pairs]
        if correlations and max(correlations) < 0:
            return f"command and measured opening have the correlation {max(correlations):.2f}: the gripper is inverted"
        return ""
    if len(command) > lags and np.ptp(command) <= STEADY and np.ptp(measured) <= STEADY:
        wanted, there = float(command.mean()), float(measured.mean())
        if (wanted > OPEN and there < SHUT) or (wanted < 1 - OPEN and there > OPEN + STEADY):
            return f"the command is {wanted:.2f} throughout, the measured opening {there:.2f}: the gripper is inverted"
    return ""


def _correlation(a: Floats, b: Floats) -> float:
    if a.std() < 1e-6 or b.std() < 1e-6:
        return -1.0
    return float(np.corrcoef(a, b)[0, 1])
