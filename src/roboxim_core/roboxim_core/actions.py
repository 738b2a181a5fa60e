"""What an action means, as a value that travels with every dataset, policy and evaluation.

The default: end-effector delta in the robot's base frame, ``[dx, dy, dz, droll, dpitch, dyaw, gripper]``, where droll,
dpitch, dyaw are the extrinsic XYZ Euler angles of ``R_next R_commanded^T`` and the gripper is absolute, 1 = open,
0 = closed, linear in the total opening. A mismatch is refused before the first step.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ErrorCode, EvaluationError, InvalidRequestError

ACTION_SIZE = 7
ActionArray = npt.NDArray[np.float32]
"""One action, shape (7,), or a chunk of them, shape (horizon, 7)."""


@dataclass(frozen=True, kw_only=True)
class ActionSemantics:
    """Meaning of an action vector."""

    control: str = "end_effector_delta"
    """What is commanded."""
    frame: str = "robot_base"
    """Frame that the delta is expressed in."""
    rotation: str = "euler_xyz_extrinsic"
    """Representation of the rotation part."""
    gripper: str = "absolute_open_1_closed_0"
    """Polarity and range of the gripper value."""
    rate_hz: float = 10.0
    """Control rate [Hz]; must divide the physics rate."""
    max_translation_m: float = 0.05
    """Largest translation per tick and axis-free norm [m]; more is clipped and counted."""
    max_rotation_rad: float = 0.25
    """Largest rotation per tick as an angle [rad]; more is clipped and counted."""

    def require_compatible(self, other: ActionSemantics, *, mine: str, theirs: str) -> None:
        """Refuse a mismatch of meaning or rate; the limits may differ.

        Args:
            other: The other side's semantics.
            mine: What this one belongs to, for the message, e.g. ``"policy 'bc'"``.
            theirs: What the other belongs to.

        Raises:
            EvaluationError: With code ``SEMANTICS_MISMATCH``, naming every differing field.
        """
        limits = {"max_translation_m", "max_rotation_rad"}
        a, b = asdict(self), asdict(other)
        differing = [f"{key}: {a[key]!r} against {b[key]!r}" for key in a if key not in limits and a[key] != b[key]]
        if differing:
            raise EvaluationError(
                f"action semantics of {mine} and {theirs} differ ({'; '.join(differing)}); "
                "convert the actions or declare the same semantics on both sides",
                ErrorCode.SEMANTICS_MISMATCH,
            )


def check_chunk(actions: npt.ArrayLike) -> ActionArray:
    """Check a chunk of actions at the door.

    Args:
        actions: Array-like of shape (horizon, 7) or (7,).

    Returns:
        float32 array of shape (horizon, 7).

    Raises:
        InvalidRequestError: With code ``INVALID_ACTION`` on a wrong shape, a NaN or an infinity.
    """
    try:
        chunk = np.atleast_2d(np.asarray(actions, dtype=np.float32))
    except (TypeError, ValueError) as error:
        raise InvalidRequestError(f"actions are not numbers: {error}", ErrorCode.INVALID_ACTION) from None
    if chunk.ndim != 2 or chunk.shape[1] != ACTION_SIZE or chunk.shape[0] == 0:
        raise InvalidRequestError(
            f"actions must have shape (horizon, {ACTION_SIZE}), got {np.shape(actions)}", ErrorCode.INVALID_ACTION
        )
    if not np.isfinite(chunk).all():
        row, column = np.argwhere(~np.isfinite(chunk))[0]
        raise InvalidRequestError(
            f"actions must be finite, got {chunk[row, column]} at step {row}, component {column}",
            ErrorCode.INVALID_ACTION,
        )
    return chunk


def hold_action(gripper: float) -> ActionArray:
    """Return the action that stays: zero delta, gripper as given (repeating a delta would move on)."""
    action = np.zeros(ACTION_SIZE, dtype=np.float32)
    action[6] = gripper
    return action
