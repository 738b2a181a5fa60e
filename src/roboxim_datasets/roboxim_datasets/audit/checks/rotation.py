"""Rotations that jump although nothing turns (thesis 6.1.2, issue 6)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from roboxim_core.actions import ControlMode
from roboxim_core.errors import InvalidRequestError
from roboxim_core.proprioception import ProprioField
from roboxim_core.rotation.representations import RotationRepresentation, decode
from roboxim_datasets.audit.check import AUDIT_CHECKS, AuditCheck
from roboxim_datasets.audit.values import AuditEpisode, CannotCheckError, Finding
from roboxim_datasets.episode import Floats

TURNED_RAD = 0.2
NEAR_TURN_RAD = 0.3
UNIT = 1e-3
KEPT = 64
QUATERNIONS = (RotationRepresentation.QUATERNION_XYZW, RotationRepresentation.QUATERNION_WXYZ)
FIELDS = {
    "tcp_quaternion_xyzw": RotationRepresentation.QUATERNION_XYZW,
    "tcp_euler_xyz": RotationRepresentation.EULER_XYZ_EXTRINSIC,
}

KNOWN = frozenset(map(str, ProprioField))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Rotations:
    """One rotation of every tick."""

    label: str
    """Where it is, e.g. ``action``."""
    kind: RotationRepresentation | None
    """Its representation; none: unknown numbers, of which each may be an angle."""
    values: Floats
    """Shape (T, n)."""
    names: tuple[str, ...]
    """Names of the components."""


@AUDIT_CHECKS.register("rotation_jump")
class RotationJump(AuditCheck):
    """A jump of a rotation's numbers where the rotation itself hardly changes."""

    title = "Rotations jump"
    reason = "Two very different labels for one rotation: their mean, which a policy learns, is a third rotation."
    threshold = (
        f"a component jumps by more than pi, or a quaternion flips its sign, while the rotation turns by less than "
        f"{TURNED_RAD:g} rad, between ticks or between the starts of episodes; in numbers of unknown meaning, a jump "
        f"of a full turn within {NEAR_TURN_RAD:g} rad, or the sign flip of four that have norm 1"
    )
    order = 6

    def __init__(self) -> None:
        """Remember the starts of episodes."""
        self._starts: dict[str, list[tuple[str, Floats]]] = {}

    def look(self, episode: AuditEpisode) -> Iterator[Finding]:
        """Find jumps in actions and state."""
        found = _rotations(episode)
        if not found:
            raise CannotCheckError("neither actions nor state have a rotation that can jump")
        for rotations in found:
            jumps = [k for k in range(1, len(rotations.values)) if _jumps(rotations, k)]
            shown = {
                f"{rotations.label} {name}": tuple(column)
                for name, column in zip(rotations.names, rotations.values.T, strict=True)
                if any(abs(column[k] - column[k - 1]) > 0.5 for k in jumps)
            }
            if jumps:
                yield episode.finding(
                    f"{rotations.label}: {len(jumps)} jump{'s' * (len(jumps) != 1)}, the first at tick {jumps[0]} "
                    f"from {_shown(rotations.values[jumps[0] - 1])} to {_shown(rotations.values[jumps[0]])}",
                    ticks=(jumps[0] - 1, jumps[0]),
                    series=dict(list(shown.items())[:4]),
                )
            elif other := self._other_side(episode, rotations):
                yield episode.finding(
                    f"{rotations.label} starts at {_shown(rotations.values[0])}, '{other}' with the same rotation "
                    "on the other side of the seam",
                    ticks=(0,),
                )

    def _other_side(self, episode: AuditEpisode, rotations: _Rotations) -> str:
        """Return an earlier episode that starts with the same rotation and other numbers."""
        if rotations.kind is None or rotations.label == "action" and _is_delta(episode):
            return ""
        starts = self._starts.setdefault(rotations.label, [])
        for name, start in starts:
            if len(start) == rotations.values.shape[1]:
                pair = np.stack([start, rotations.values[0]])
                if _jumps(_Rotations(label="", kind=rotations.kind, values=pair, names=()), 1):
                    return name
        if len(starts) < KEPT:
            starts.append((episode.name, rotations.values[0]))
        return ""


def _is_delta(episode: AuditEpisode) -> bool:
    semantics = episode.episode.semantics
    return semantics is not None and semantics.control.is_relative


def _rotations(episode: AuditEpisode) -> list[_Rotations]:
    """Return the rotations of an episode that can jump; 6D ones cannot."""
    semantics, found = episode.episode.semantics, []
    if semantics is None:
        found += _unknown("action", episode.actions)
    elif semantics.control in (ControlMode.END_EFFECTOR_DELTA, ControlMode.END_EFFECTOR_ABSOLUTE):
        kind = semantics.rotation
        if not kind.is_continuous:
            values = episode.actions[:, 3 : 3 + kind.size]
            found.append(_Rotations(label="action", kind=kind, values=values, names=kind.component_names))
    for field, values in episode.proprio.items():
        if field in FIELDS:
            kind = FIELDS[field]
            found.append(_Rotations(label=field, kind=kind, values=values, names=kind.component_names))
        elif field not in KNOWN:
            found += _unknown(field, values)
    return found


def _unknown(label: str, values: Floats) -> list[_Rotations]:
    """Return numbers of unknown meaning: each may be an angle, and four of norm 1 are taken for a quaternion."""
    names = tuple(f"[{i}]" for i in range(values.shape[1]))
    found = [_Rotations(label=label, kind=None, values=values, names=names)]
    for at in range(values.shape[1] - 3):
        four = values[:, at : at + 4]
        if np.abs(np.linalg.norm(four, axis=1) - 1.0).max() < UNIT and np.ptp(four, axis=0).max() > UNIT:
            kind = RotationRepresentation.QUATERNION_XYZW
            found.append(_Rotations(label=f"{label}[{at}:{at + 4}]", kind=kind, values=four, names=names[at : at + 4]))
    return found


def _jumps(rotations: _Rotations, k: int) -> bool:
    """Return whether the numbers of row k jump from those of row k - 1, and the rotation does not."""
    before, after = rotations.values[k - 1].astype(float), rotations.values[k].astype(float)
    kind = rotations.kind
    if kind is None:
        return bool((np.abs(np.abs(after - before) - 2 * math.pi) < NEAR_TURN_RAD).any())
    flips = kind in QUATERNIONS and float(before @ after) < 0
    if not flips and np.abs(after - before).max() <= math.pi:
        return False
    try:
        return float((decode(before, kind).inv() * decode(after, kind)).magnitude()) < TURNED_RAD
    except InvalidRequestError:
        return False


def _shown(values: Floats) -> str:
    return "(" + ", ".join(f"{value:.2f}" for value in values[:8]) + (", ...)" if len(values) > 8 else ")")
