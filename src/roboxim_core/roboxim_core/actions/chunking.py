"""Execution of chunks: which action a tick executes when a policy answers with several actions, late, or repeatedly.

Non-obvious:

- An answer is made for the tick of its observation (``observed``) and can be used from the tick on which it arrives.
  Without latency these are the same tick.
- An ensemble needs several answers for one tick, so it requests one at every tick unless ``execute`` is set.
- Numbers are averaged unchanged, as in Octo's and ACT's ensembles. Where that would not give a rotation (quaternions,
  6D, absolute poses) the rotations are averaged instead.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from roboxim_core.actions.chunks import ActionArray
from roboxim_core.actions.semantics import ActionSemantics, ControlMode
from roboxim_core.errors import InvalidRequestError
from roboxim_core.plain_data.closed_enum import ClosedEnum
from roboxim_core.rotation.representations import RotationRepresentation, decode, encode, gripper_down


class Ensemble(ClosedEnum):
    """How several answers for the same tick are combined."""

    NEWEST = "newest"
    """The last answer counts."""
    MEAN = "mean"
    """Plain mean of all answers."""
    EXPONENTIAL = "exponential"
    """Mean with the weights exp(-k i), i = 0 the oldest answer: k > 0 prefers older answers (Octo, ACT), k < 0 newer
    ones."""


class LateRows(ClosedEnum):
    """Use of an answer that arrives d ticks after its observation."""

    SHIFT = "shift"
    """Row 0 is executed on arrival: the whole answer is d ticks late."""
    DROP = "drop"
    """Row i is executed i ticks after the observation; the first d rows are left out."""


@dataclass(frozen=True, kw_only=True)
class Chunking:
    """How a policy's chunks become one action per tick."""

    execute: int = 0
    """Actions executed per request; 0: all of an answer, or 1 with an ensemble."""
    ensemble: Ensemble = Ensemble.NEWEST
    """Combination of several answers for one tick."""
    ensemble_decay: float = 0.0
    """k of the weights of `Ensemble.EXPONENTIAL`."""
    late_rows: LateRows = LateRows.SHIFT
    """Use of answers that arrive late."""

    def __post_init__(self) -> None:
        """Check the values; an empty text selects the default.

        Raises:
            InvalidRequestError: On an unknown name, a number out of range, or a decay without weights that use it.
        """
        for name, kind in (("ensemble", Ensemble), ("late_rows", LateRows)):
            try:
                object.__setattr__(self, name, kind(getattr(self, name) or next(iter(kind))))
            except ValueError as error:
                raise InvalidRequestError(f"{name}: {error}") from None
        if self.execute < 0:
            raise InvalidRequestError(f"execute must be >= 0, got {self.execute}")
        if not math.isfinite(self.ensemble_decay):
            raise InvalidRequestError(f"ensemble_decay must be finite, got {self.ensemble_decay}")
        if bool(self.ensemble_decay) != (self.ensemble == Ensemble.EXPONENTIAL):
            raise InvalidRequestError(
                f"ensemble '{self.ensemble}' with ensemble_decay {self.ensemble_decay:g}: 'exponential' needs a decay "
                "other than 0 (k > 0 prefers older answers, k < 0 newer ones), and the others use none"
            )

    def overridden(
        self,
        *,
        execute: int = 0,
        ensemble: str = "",
        ensemble_decay: float = 0.0,
        late_rows: str = "",
    ) -> Chunking:
        """Return this value with those of a run; 0 and empty texts keep the policy's."""
        return Chunking(
            execute=execute or self.execute,
            ensemble=Ensemble(ensemble) if ensemble else self.ensemble,
            ensemble_decay=ensemble_decay if ensemble or ensemble_decay else self.ensemble_decay,
            late_rows=LateRows(late_rows) if late_rows else self.late_rows,
        )

    def rows_per_request(self, rows: int) -> int:
        """Return the number of ticks between two requests after an answer with a number of rows."""
        wanted = self.execute or (rows if self.ensemble == Ensemble.NEWEST else 1)
        return min(wanted, rows)


@dataclass(frozen=True, kw_only=True, eq=False)
class Planned:
    """An action that a tick executes."""

    action: ActionArray
    """float32, shape (D,), in the policy's semantics."""
    phase: str = ""
    """The newest answer's phase."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Answer:
    arrives: int
    start: int
    rows: ActionArray
    phases: tuple[str, ...]


class ActionPlan:
    """The answers of an episode, and the action that each tick executes.

    The episode loop asks whether a request is `due`, adds the answer, and takes the tick's action.
    """

    def __init__(self, chunking: Chunking, semantics: ActionSemantics, *, one_at_a_time: bool = False) -> None:
        """Start an episode.

        Args:
            chunking: How chunks are executed.
            semantics: Meaning of the policy's actions; says how rotations are averaged.
            one_at_a_time: Whether a request waits for the previous answer, and the ticks between two requests count
                from its arrival (real time), not from its request (lockstep).
        """
        self.chunking = chunking
        self._semantics = semantics
        self._one_at_a_time = one_at_a_time
        self._answers: deque[_Answer] = deque()
        self._next_request: int | None = 0

    def due(self, seq: int) -> bool:
        """Return whether a request to the policy is due at a tick."""
        return self._next_request is not None and seq >= self._next_request

    def add(self, observed: int, delay: int, rows: ActionArray, phases: tuple[str, ...], *, done: bool = False) -> None:
        """Add an answer.

        Args:
            observed: Tick of its observation.
            delay: Ticks until it arrives.
            rows: float32, shape (horizon, D).
            phases: A phase per row, or none.
            done: Whether the actor has finished after these rows; ignored unless all of them are executed.
        """
        arrives = observed + delay
        drops = self.chunking.late_rows == LateRows.DROP
        use = self.chunking.rows_per_request(len(rows))
        self._answers.append(
            _Answer(
                arrives=arrives, start=observed if drops else arrives, rows=rows, phases=phases or ("",) * len(rows)
            )
        )
        self._next_request = (arrives if self._one_at_a_time else observed) + use
        if drops and self._one_at_a_time:
            self._next_request = max(arrives, min(self._next_request, observed + len(rows)))
        if done and use == len(rows):
            self._next_request = None

    def finished(self, seq: int) -> bool:
        """Return whether the actor has finished and no action is left for a tick or later ones."""
        return self._next_request is None and not any(seq < a.start + len(a.rows) for a in self._answers)

    def action(self, seq: int) -> Planned | None:
        """Return the action of a tick; None: no answer for it has arrived. Call it with ticks in increasing order."""
        while self._answers and self._answers[0].start + len(self._answers[0].rows) <= seq:
            self._answers.popleft()
        arrived = [answer for answer in self._answers if answer.arrives <= seq]
        if self.chunking.ensemble == Ensemble.NEWEST:
            arrived = arrived[-1:]
        found = [answer for answer in arrived if seq < answer.start + len(answer.rows)]
        if not found:
            return None
        newest = found[-1]
        phase = newest.phases[seq - newest.start]
        if len(found) == 1:
            return Planned(action=newest.rows[seq - newest.start], phase=phase)
        rows = np.stack([answer.rows[seq - answer.start] for answer in found])
        weights = np.exp(-self.chunking.ensemble_decay * np.arange(len(rows)))
        return Planned(action=weighted_mean(rows, weights, self._semantics), phase=phase)


def weighted_mean(rows: ActionArray, weights: np.ndarray, semantics: ActionSemantics) -> ActionArray:
    """Return the weighted mean of actions for one tick.

    Args:
        rows: Shape (n, D).
        weights: Shape (n,), positive.
        semantics: Meaning of the actions.

    Returns:
        float32, shape (D,).
    """
    from scipy.spatial.transform import Rotation

    mean = np.average(np.asarray(rows, dtype=float), axis=0, weights=weights)
    if not semantics.control.is_joint_space and not _is_linear(semantics):
        turns = Rotation.concatenate([decode(row[3:-1], semantics.rotation) for row in np.asarray(rows, dtype=float)])
        mean[3:-1] = encode(turns.mean(weights), semantics.rotation, gripper_down())
    return mean.astype(np.float32)


def _is_linear(semantics: ActionSemantics) -> bool:
    """Return whether the mean of the numbers of small rotations is the mean rotation."""
    return semantics.control == ControlMode.END_EFFECTOR_DELTA and semantics.rotation in (
        RotationRepresentation.EULER_XYZ_EXTRINSIC,
        RotationRepresentation.EULER_XYZ_INTRINSIC,
        RotationRepresentation.ROTATION_VECTOR,
    )
