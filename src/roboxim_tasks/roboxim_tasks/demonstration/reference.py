"""Reference trajectory of a motion: one commanded pose per tick.

Each leg runs at constant speed. A moving average over the ticks of adjoining legs then bounds the acceleration and
rounds the corners between legs, without a pause. If a path ends at rest, its average ends exactly at the last pose.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from roboxim_core.actions import ActionSemantics
from roboxim_core.policies import DESCENT, FREE
from roboxim_core.poses import Array, Pose, distance
from roboxim_tasks.motion import Stage

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

FINE = "fine"
"""Phase of actions whose exact path matters."""
_SHARE_OF_LIMIT = 0.99
"""Share of the action limits per tick that the expert uses, so that rounding errors never clip an action."""


@dataclass(frozen=True, kw_only=True)
class SpeedConfig:
    """Speeds of the expert."""

    max_tcp_speed_m_s: float = 0.2
    """Largest speed of the tool centre point [m/s]."""
    max_tcp_rot_speed_rad_s: float = 0.8
    """Largest angular speed of the tool [rad/s]."""
    smoothing_s: float = 0.4
    """Time that a leg takes to reach its speed [s]."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ValueError: When a speed is not positive.
        """
        if min(self.max_tcp_speed_m_s, self.max_tcp_rot_speed_rad_s) <= 0 or self.smoothing_s < 0:
            raise ValueError(f"speeds must be > 0 and smoothing_s >= 0, got {self}")

    def within(self, limits: ActionSemantics, rate_hz: float) -> SpeedConfig:
        """Return speeds at which no action exceeds the limits per tick at a control rate [Hz]."""
        return replace(
            self,
            max_tcp_speed_m_s=min(self.max_tcp_speed_m_s, _SHARE_OF_LIMIT * limits.max_translation_m * rate_hz),
            max_tcp_rot_speed_rad_s=min(
                self.max_tcp_rot_speed_rad_s, _SHARE_OF_LIMIT * limits.max_rotation_rad * rate_hz
            ),
        )


@dataclass(frozen=True, kw_only=True)
class ReferencePoint:
    """Command of one tick."""

    pose: Pose
    """Pose of the tool centre point in the base."""
    opening: float
    """1 = open, 0 = closed."""
    stage: int
    """Index of the stage."""
    phase: str
    """``free`` or ``descent``, where noise may be injected, else ``fine``."""


@dataclass(frozen=True, kw_only=True)
class Leg:
    """A stage with its path."""

    stage: Stage
    """The stage."""
    via: tuple[Pose, ...] = ()
    """Poses to pass before the stage's pose where the straight line is blocked."""


def make_reference(start: Pose, legs: Sequence[Leg], config: SpeedConfig, rate_hz: float) -> list[ReferencePoint]:
    """Sample legs as one commanded pose per tick.

    Args:
        start: Commanded pose now, in the base.
        legs: The legs, in order.
        config: Speeds.
        rate_hz: Control rate [Hz].

    Returns:
        The poses from tick 1 on; the last one is the last leg's pose.
    """
    config = config.within(ActionSemantics(), rate_hz)
    points: list[ReferencePoint] = []
    here, first = start, 0
    while first < len(legs):
        last = first
        if legs[first].stage.pose is not None:
            while last + 1 < len(legs) and legs[last + 1].stage.pose is not None:
                last += 1
        poses, stages = _moves(here, legs[first : last + 1], config, rate_hz)
        for pose, offset in zip(poses, stages, strict=True):
            stage = legs[first + offset].stage
            points.append(
                ReferencePoint(pose=pose, opening=stage.opening, stage=first + offset, phase=_phase(stage, pose))
            )
        here = poses[-1] if poses else here
        first = last + 1
    return points


def _phase(stage: Stage, pose: Pose) -> str:
    """Return the phase of a stage's action towards a pose."""
    if stage.free or stage.pose is None:
        return FREE if stage.free else FINE
    return DESCENT if distance(pose, stage.pose)[0] > stage.exact_m else FINE


def _moves(start: Pose, legs: Sequence[Leg], config: SpeedConfig, rate_hz: float) -> tuple[list[Pose], list[int]]:
    """Sample adjoining legs that all move, or one leg that stays; return a pose and the leg's index per tick."""
    from scipy.spatial.transform import Rotation

    if legs[0].stage.pose is None:
        stay = round(legs[0].stage.duration_s * rate_hz)
        return [start] * stay, [0] * stay
    knots, times, owners = [start], [0.0], [0]
    for index, leg in enumerate(legs):
        assert leg.stage.pose is not None
        for pose in (*leg.via, leg.stage.pose):
            times.append(times[-1] + _duration(knots[-1], pose, config) / leg.stage.speed)
            knots.append(pose)
            owners.append(index)
    coordinates, anchor = _coordinates(knots)
    count = max(1, math.ceil(times[-1] * rate_hz - 1e-6))
    ticks = np.minimum(np.arange(1, count + 1) / rate_hz, times[-1])
    raw = np.stack([np.interp(ticks, times, column) for column in coordinates.T], axis=1)
    width = max(1, int(config.smoothing_s * rate_hz + 0.5))
    padded = np.concatenate([np.repeat(coordinates[:1], width - 1, 0), raw, np.repeat(coordinates[-1:], width - 1, 0)])
    smooth = np.stack([np.convolve(column, np.full(width, 1.0 / width), "valid") for column in padded.T], axis=1)
    smooth[-1] = coordinates[-1]
    reached = np.searchsorted(np.array(times), np.append(ticks, [times[-1]] * (width - 1)) - 1e-9)
    quats = (Rotation.from_rotvec(smooth[:, 3:]) * anchor).as_quat(canonical=True).tolist()
    poses = [
        Pose(position=tuple(position), quat_xyzw=tuple(quat))
        for position, quat in zip(smooth[:, :3].tolist(), quats, strict=True)
    ]
    return poses, [owners[min(int(i), len(owners) - 1)] for i in reached]


def _duration(begin: Pose, end: Pose, config: SpeedConfig) -> float:
    translation, angle = distance(begin, end)
    return max(translation / config.max_tcp_speed_m_s, angle / config.max_tcp_rot_speed_rad_s, 1e-6)


def _coordinates(poses: Sequence[Pose]) -> tuple[Array, Rotation]:
    """Return positions with rotation vectors relative to the last pose, shape (n, 6), and the last pose's rotation.

    In these coordinates the shortest arc to the last pose is a straight line.
    """
    from scipy.spatial.transform import Rotation

    anchor = poses[-1].rotation
    positions = np.array([pose.position for pose in poses])
    vectors = (Rotation.from_quat([pose.quat_xyzw for pose in poses]) * anchor.inv()).as_rotvec()
    return np.hstack([positions, vectors]), anchor
