"""Commanded and measured motion of an episode's arm, as increments of the same quantities.

Increments compare whatever the control mode is: a motion that is commanded relative to the last target, relative to
the measured pose, or as an absolute target becomes the step from target to target. Two targets count. The *executed*
one moved the arm. The *label* differs from it where noise was injected; it is what a policy learns.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from roboxim_core.actions import ActionSemantics, ControlMode, DeltaBase, ReferenceFrame
from roboxim_core.rotation.representations import RotationRepresentation, decode_rows
from roboxim_datasets.audit.values import AuditEpisode, CannotCheckError, Values

DEGREE = np.pi / 180
ROTATION_FIELDS: Mapping[str, RotationRepresentation] = {
    "tcp_rotation_6d": RotationRepresentation.ROTATION_6D,
    "tcp_quaternion_xyzw": RotationRepresentation.QUATERNION_XYZW,
    "tcp_euler_xyz": RotationRepresentation.EULER_XYZ_EXTRINSIC,
}
"""Fields of the proprioception that hold the tool's rotation."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Chain:
    """One quantity of the arm through an episode of T steps; increments have n components."""

    name: str
    """``position``, ``rotation`` or ``joints``."""
    unit: str
    """Unit of reports."""
    per_unit: float
    """Value of one such unit in SI units."""
    tolerance: float
    """Difference that matters, in SI units."""
    measured: Values
    """Measured increments from step to step, shape (T - 1, n)."""
    commanded: Values
    """Increments of the executed target, shape (T, n)."""
    labelled: Values
    """Increments of the target that the labels name, shape (T, n)."""
    apart: Values
    """Executed target minus labelled target, shape (T, n)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Targets:
    """Targets after each action, shape (T, 3) or T rotations, and what was measured before it."""

    measured: Any
    executed: Any
    labelled: Any


def chains_of(episode: AuditEpisode) -> tuple[Chain, ...]:
    """Return the chains of an episode whose actions have a declared meaning.

    Raises:
        CannotCheckError: When the meaning is not declared, or the state lacks what the actions command.
    """
    semantics = episode.episode.semantics
    if semantics is None:
        raise CannotCheckError("the dataset does not declare what its actions mean")
    if len(episode.actions) < 3:
        raise CannotCheckError("an episode of fewer than 3 steps shows no motion")
    executed = episode.executed if episode.executed is not None else episode.actions
    rows = {"executed": executed.astype(float), "labelled": episode.actions.astype(float)}
    for values in rows.values():
        if not np.isfinite(values).all():
            raise CannotCheckError("actions that are not finite")
    if semantics.control.is_joint_space:
        return (_joint_chain(episode, semantics, rows),)
    measured = episode.field("tcp_position").astype(float)
    found = [_position_and_rotation(episode, semantics, rows, measured)]
    return tuple(chain for pair in found for chain in pair)


def _joint_chain(episode: AuditEpisode, semantics: ActionSemantics, rows: Mapping[str, Values]) -> Chain:
    measured = episode.field("joint_positions").astype(float)
    if rows["labelled"].shape[1] - 1 != measured.shape[1]:
        raise CannotCheckError("the actions have another number of joints than the state")
    scale = 1.0 / episode.rate_hz if semantics.control == ControlMode.JOINT_VELOCITY else 1.0
    absolute = semantics.control == ControlMode.JOINT_POSITION
    targets: dict[str, list[Values]] = {}
    last = measured[0]
    for k in range(len(measured)):
        base = measured[k] if semantics.delta_base == DeltaBase.MEASURED else last
        for name, values in rows.items():
            motion = scale * values[k, :-1]
            targets.setdefault(name, []).append(motion if absolute else base + motion)
        last = targets["executed"][-1]
    made = _Targets(measured=measured, executed=np.array(targets["executed"]), labelled=np.array(targets["labelled"]))
    return _linear("joints", "degrees", DEGREE, 0.5 * DEGREE, made)


def _position_and_rotation(
    episode: AuditEpisode, semantics: ActionSemantics, rows: Mapping[str, Values], measured: Values
) -> list[Chain]:
    from scipy.spatial.transform import Rotation

    kind = semantics.rotation
    turned = {name: decode_rows(values[:, 3 : 3 + kind.size], kind) for name, values in rows.items()}
    orientation = _measured_rotation(episode)
    if orientation is None and semantics.frame == ReferenceFrame.TOOL:
        raise CannotCheckError(
            "motions in the tool's frame need its measured rotation, which the dataset does not name"
        )
    known = orientation if orientation is not None else Rotation.identity(len(measured))
    places: dict[str, list[Values]] = {name: [] for name in rows}
    turns: dict[str, list[Any]] = {name: [] for name in rows}
    last_place, last_turn = measured[0], known[0]
    for k in range(len(measured)):
        of_measured = semantics.delta_base == DeltaBase.MEASURED
        place, turn = (measured[k], known[k]) if of_measured else (last_place, last_turn)
        for name, values in rows.items():
            shift, rotation = values[k, :3], turned[name][k]
            if semantics.control == ControlMode.END_EFFECTOR_ABSOLUTE:
                places[name].append(shift)
                turns[name].append(rotation)
            elif semantics.frame == ReferenceFrame.TOOL:
                places[name].append(place + turn.apply(shift))
                turns[name].append(turn * rotation)
            else:
                places[name].append(place + shift)
                turns[name].append(rotation * turn)
        last_place, last_turn = places["executed"][-1], turns["executed"][-1]
    made = _Targets(measured=measured, executed=np.array(places["executed"]), labelled=np.array(places["labelled"]))
    found = [_linear("position", "mm", 1e-3, 1e-3, made)]
    if orientation is not None:
        joined = {name: Rotation.concatenate(values) for name, values in turns.items()}
        found.append(_rotational(orientation, joined["executed"], joined["labelled"]))
    return found


def _measured_rotation(episode: AuditEpisode) -> Any:
    """Return the measured rotations of the tool; None: the dataset names none."""
    for field, kind in ROTATION_FIELDS.items():
        if field in episode.proprio:
            return decode_rows(episode.proprio[field].astype(float), kind)
    return None


def _linear(name: str, unit: str, per_unit: float, tolerance: float, made: _Targets) -> Chain:
    before = np.concatenate([made.measured[:1], made.executed[:-1]])
    labels = np.concatenate([made.measured[:1], made.labelled[:-1]])
    return Chain(
        name=name, unit=unit, per_unit=per_unit, tolerance=tolerance, measured=np.diff(made.measured, axis=0),
        commanded=made.executed - before, labelled=made.labelled - labels, apart=made.executed - made.labelled,
    )  # fmt: skip


def _rotational(measured: Any, executed: Any, labelled: Any) -> Chain:
    from scipy.spatial.transform import Rotation

    before = Rotation.concatenate([measured[:1], executed[:-1]])
    labels = Rotation.concatenate([measured[:1], labelled[:-1]])
    return Chain(
        name="rotation", unit="degrees", per_unit=DEGREE, tolerance=0.5 * DEGREE,
        measured=(measured[1:] * measured[:-1].inv()).as_rotvec(), commanded=(executed * before.inv()).as_rotvec(),
        labelled=(labelled * labels.inv()).as_rotvec(), apart=(executed * labelled.inv()).as_rotvec(),
    )  # fmt: skip
