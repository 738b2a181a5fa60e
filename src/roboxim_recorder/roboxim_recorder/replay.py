"""Re-executes a recorded episode and names the first tick that differs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from roboxim_core.episode import SimPort
from roboxim_core.poses import distance
from roboxim_core.state import StateRecord
from roboxim_recorder.bag import BagReader


@dataclass(frozen=True, kw_only=True)
class ReplayReport:
    """Result of a replay."""

    episode_id: str
    """Episode."""
    ticks: int
    """Ticks that were compared, the first differing one included."""
    diverged_at: int | None = None
    """First tick whose state's hash differs; None: every bit is the same."""
    recorded_hash: str = ""
    """Hash in the bag at that tick."""
    replayed_hash: str = ""
    """Hash of the replay at that tick."""
    difference: str = ""
    """Readable difference of the two states: the body that is farthest off."""

    @property
    def same(self) -> bool:
        """Whether the replay equals the recording, bit for bit."""
        return self.diverged_at is None


def replay(
    reader: BagReader,
    sim: SimPort,
    *,
    episode_id: str | None = None,
    on_tick: Callable[[StateRecord], None] = lambda _: None,
) -> ReplayReport:
    """Rebuild a bag's scene, execute its actions again and compare every tick's hash.

    Args:
        reader: The bag.
        sim: The simulator, free of any lease.
        episode_id: Id to run under; none: the recorded one.
        on_tick: Called with every replayed state, tick 0 included, e.g. to judge it again.

    Returns:
        The first tick at which the replay differs, if any; the replay stops there.

    Raises:
        RoboximError: If the bag is damaged or the sim rejects a request.
    """
    lease = episode_id or reader.info.episode_id
    compared = 0
    try:
        for tick in reader.ticks(cameras=()):
            if tick.seq == 0:
                state = sim.load(lease, reader.info.scene, reader.info.semantics)
            else:
                state = sim.tick(lease, tick.seq, np.array(tick.step.action_executed, np.float32))
            compared += 1
            on_tick(state)
            if state.state_hash != tick.state.state_hash:
                return ReplayReport(
                    episode_id=reader.info.episode_id,
                    ticks=compared,
                    diverged_at=tick.seq,
                    recorded_hash=tick.state.state_hash,
                    replayed_hash=state.state_hash,
                    difference=_difference(tick.state, state),
                )
    finally:
        sim.release(lease)
    return ReplayReport(episode_id=reader.info.episode_id, ticks=compared)


def _difference(recorded: StateRecord, replayed: StateRecord) -> str:
    """Return a phrase that names the body farthest from its recorded pose."""
    pairs = [("tcp", recorded.robot.pose_tcp_measured, replayed.robot.pose_tcp_measured)]
    there = {entity.name: entity.pose for entity in replayed.entities}
    pairs += [(e.name, e.pose, there[e.name]) for e in recorded.entities if e.name in there]
    name, (metres, radians) = max(((n, distance(a, b)) for n, a, b in pairs), key=lambda item: item[1])
    return f"{name} is {metres * 1e3:.3g} mm and {radians:.3g} rad away"
