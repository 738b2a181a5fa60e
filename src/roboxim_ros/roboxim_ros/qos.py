"""QoS by intent. Everything is reliable: on one machine that costs nothing, and best effort loses images."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy


def _profile(depth: int, durability: DurabilityPolicy = DurabilityPolicy.VOLATILE) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=durability
    )


STATE = _profile(1, DurabilityPolicy.TRANSIENT_LOCAL)
"""For publishers of the running graph's state: clock, joint states, tf, ticks. Whoever subscribes late gets the newest
message and none before it, whatever depth it asks for; who is there gets every message of an episode, because the loop
goes on only when the recorder has the tick."""
SENSOR = _profile(1, DurabilityPolicy.TRANSIENT_LOCAL)
"""For publishers of sensor streams. Who subscribes during tick 0 still gets tick 0."""
EVENTS = _profile(10, DurabilityPolicy.TRANSIENT_LOCAL)
"""For subscribers that need every message of `STATE` and `SENSOR`, and for acknowledgements. Transient local: a
publisher that has not yet discovered a subscriber still serves it, so a recorder that opens just before tick 0 gets
tick 0."""
RECORDING = _profile(200, DurabilityPolicy.TRANSIENT_LOCAL)
"""What a recorder subscribes with: deep enough for a slow disk; it tells old messages by their source's time."""
LATCHED = _profile(1, DurabilityPolicy.TRANSIENT_LOCAL)
"""The newest value for whoever comes late: scene, episode info."""
