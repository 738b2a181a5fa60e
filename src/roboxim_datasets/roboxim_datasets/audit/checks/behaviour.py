"""Whether an episode moves like the others with the same instruction."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from roboxim_datasets.audit.check import AUDIT_CHECKS, AuditCheck
from roboxim_datasets.audit.values import AuditEpisode, CannotCheckError, Finding, Severity, Values

FEWEST = 8
"""Fewest episodes of a verb for which an unlike one can be found."""
NEIGHBOURS = 5
FARTHER = 1.6
"""Times the distance to its own verb's nearest episode that is usual."""


@AUDIT_CHECKS.register("behaviour")
class Behaviour(AuditCheck):
    """An instruction whose verb is not what the arm does, judged by the other episodes."""

    title = "The arm does not follow the instruction"
    reason = "The policy learns to act against the instruction, and to ignore the words."
    threshold = (
        f"the {NEIGHBOURS} episodes whose path, gripper and turns are most alike all have another first word in their "
        f"instruction, and the nearest one with the same verb is {FARTHER:g} times as far as is usual: a warning"
    )
    needs = f"positions, the gripper's opening, and at least {FEWEST} episodes of a verb; objects are not recognised"
    order = 5

    def __init__(self) -> None:
        """Remember the episodes."""
        self._seen: list[tuple[str, str, bool]] = []
        self._features: list[Values] = []

    def look(self, episode: AuditEpisode) -> Iterator[Finding]:
        """Keep what the arm does."""
        words = episode.episode.instruction.lower().split()
        if not words:
            raise CannotCheckError("the instruction is empty")
        self._features.append(movement(episode))
        self._seen.append((episode.name, words[0], episode.episode.success is False))
        yield from ()

    def conclude(self) -> Iterator[Finding]:
        """Compare each episode with the others."""
        verbs = np.array([verb for _, verb, _ in self._seen])
        if len(set(verbs.tolist())) < 2:
            return
        rows = np.stack(self._features)
        spread = np.maximum(np.quantile(rows, 0.9, axis=0) - np.quantile(rows, 0.1, axis=0), 1e-6)
        rows = rows / spread
        nearest = np.full(len(rows), np.nan)
        close: list[list[str]] = []
        for i, row in enumerate(rows):
            distance = np.linalg.norm(rows - row, axis=1)
            distance[i] = np.inf
            close.append(verbs[np.argsort(distance)[:NEIGHBOURS]].tolist())
            own = distance[verbs == verbs[i]]
            if np.isfinite(own).sum() >= FEWEST - 1:
                nearest[i] = own.min()
        for i, (name, verb, failed) in enumerate(self._seen):
            usual = nearest[(verbs == verb) & np.isfinite(nearest)]
            if failed or not np.isfinite(nearest[i]) or verb in close[i] or len(set(close[i])) > 1:
                continue
            if nearest[i] > FARTHER * float(np.quantile(usual, 0.75)):
                yield Finding(
                    text=f"its instruction is '{verb} ...', but it moves like the episodes of '{close[i][0]} ...'",
                    episodes=(name,),
                    ticks=(0,),
                    severity=Severity.WARNING,
                )


def movement(episode: AuditEpisode) -> Values:
    """Return what the arm does, in about ten numbers.

    Raises:
        CannotCheckError: When the dataset lacks positions or the gripper's opening, or they are not finite.
    """
    place = episode.field("tcp_position").astype(float)
    opening = episode.field("gripper_opening")[:, 0].astype(float)
    if not (np.isfinite(place).all() and np.isfinite(opening).all()):
        raise CannotCheckError("the state has numbers that are not finite")
    step = np.linalg.norm(np.diff(place, axis=0), axis=1)
    lowest = int(place[:, 2].argmin())
    shut = opening < 0.9
    turned = np.zeros(2)
    if "tcp_rotation_6d" in episode.proprio:
        axes = episode.proprio["tcp_rotation_6d"].astype(float)
        turned = np.array([np.linalg.norm(axes[-1] - axes[0]), np.linalg.norm(axes - axes[0], axis=1).max()])
    closed_path = step[shut[:-1]].sum() if shut.any() else 0.0
    changes = float((np.abs(np.diff(shut.astype(int)))).sum())
    return np.array(
        [place[:, 2].min(), place[-1, 2] - place[:, 2].min(), 0.3 * step.sum(), closed_path,
         np.abs(place[-1] - place[lowest])[:2].max(), place[:, 0].max(), place[-1, 0], 0.3 * changes,
         opening[0], opening[-1], opening.min(), *turned, 0.002 * len(place)]
    )  # fmt: skip
