"""QoS by intent. Everything is reliable: on one machine that costs nothing, and best effort loses images."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy


def _profile(depth: int, durability: DurabilityPolicy = DurabilityPolicy.VOLATILE) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=durability
    )


STATE = _profile(10)
"""State and events of the running graph: clock, joint states, tf, ticks."""
SENSOR = _profile(5, DurabilityPolicy.TRANSIENT_LOCAL)
"""Sensor streams. Transient local: who subscribes during tick 0 still gets tick 0."""
RECORDING = _profile(200)
"""What a recorder subscribes with: deep enough for a slow disk, volatile so that nothing old comes in."""
LATCHED = _profile(1, DurabilityPolicy.TRANSIENT_LOCAL)
"""The newest value for whoever comes late: scene, episode info."""
