"""QoS by intent. All profiles are reliable: on one machine that costs nothing, and best effort loses images."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy


def _profile(depth: int, durability: DurabilityPolicy = DurabilityPolicy.VOLATILE) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=durability
    )


STATE = _profile(1, DurabilityPolicy.TRANSIENT_LOCAL)
"""For publishers of the running graph's state: clock, joint states, tf, ticks. A late subscriber gets
only the newest message, for any depth it requests. An early subscriber gets every message of an episode, because the
loop continues only when the recorder has the tick."""
SENSOR = _profile(1, DurabilityPolicy.TRANSIENT_LOCAL)
"""For publishers of sensor streams. A subscriber that joins during tick 0 still gets tick 0."""
EVENTS = _profile(10, DurabilityPolicy.TRANSIENT_LOCAL)
"""For subscribers that need every message of `STATE` and `SENSOR`, and for acknowledgements. Transient local: a
publisher that has not yet discovered a subscriber still serves it, so a recorder that opens just before tick 0 gets
tick 0."""
RECORDING = _profile(200, DurabilityPolicy.TRANSIENT_LOCAL)
"""For recorders: deep enough for a slow disk. The recorder recognises old messages by their source time."""
LATCHED = _profile(1, DurabilityPolicy.TRANSIENT_LOCAL)
"""For values that a late subscriber also needs: scene, episode info."""


def offered(node: Node, topic: str, depth: int, *, fresh: bool = False) -> QoSProfile:
    """Return a QoS that every publisher of a topic offers, as ros2 chooses it.

    A reliable subscriber hears no best-effort publisher, and a transient local one, which sees latched messages, no
    volatile publisher.

    Args:
        node: The node that subscribes.
        topic: Full name.
        depth: Largest number of messages that wait.
        fresh: Whether to be volatile in any case, and see no latched messages.
    """
    offers = [end.qos_profile for end in node.get_publishers_info_by_topic(topic)]
    reliable = offers and all(offer.reliability == ReliabilityPolicy.RELIABLE for offer in offers)
    latched = offers and all(offer.durability == DurabilityPolicy.TRANSIENT_LOCAL for offer in offers)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched and not fresh else DurabilityPolicy.VOLATILE,
    )
