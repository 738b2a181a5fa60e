"""Waiting for a policy's server that does not answer: time limit, retries, and messages to the user.

An episode whose policy could not be reached has no result. Its worker tries it again, with growing pauses, until the
server is back or the time limit is reached. Then the run stops; the same command continues it.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import UnavailableError
from roboxim_runs.executors import Note

SERVER_WAIT_S = 180.0
"""Default of the longest wait for a server that is away [s]."""
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 10.0
"""Pauses between two tries of an episode [s]; each is twice as long as the one before."""
LOSSES = 3
"""Times that a server may be lost in mid-episode, at the same episode."""
CONTINUES = "No episode that was not played is counted; start the server again, and the same command continues"


class Retries:
    """Retries of one worker for the policy of one episode."""

    def __init__(self, wait_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        """Start the wait.

        Args:
            wait_s: Longest wait for a server that is away [s].
            clock: Returns the time [s].
        """
        self._wait_s, self._clock = wait_s, clock
        self._since: float | None = None
        self._pause_s = FIRST_PAUSE_S
        self._losses = 0

    @property
    def tried(self) -> bool:
        """Whether the policy was lost at least once."""
        return self._since is not None

    def lost(self, result: EpisodeResult) -> float:
        """Return the pause before the next try [s].

        Args:
            result: The episode, which ended because the policy was lost.

        Raises:
            UnavailableError: When the policy was away too long, or was lost too often in mid-episode.
        """
        now = self._clock()
        if self._since is None or result.steps:  # it was there until now
            self._since, self._pause_s = now, FIRST_PAUSE_S
        if result.steps:
            self._losses += 1
        if self._losses >= LOSSES:
            raise UnavailableError(
                f"the policy's server was lost {LOSSES} times in the middle of episode {result.episode_id}, so it "
                f"seems to end there; its own log says why. The last time: {result.message}. {CONTINUES}"
            )
        left_s = self._since + self._wait_s - now
        if left_s <= 0:
            raise UnavailableError(
                f"the policy's server stayed away for {self._wait_s:g} s (--server-wait or server_wait_s): "
                f"{result.message}. {CONTINUES}"
            )
        pause_s = min(self._pause_s, left_s)
        self._pause_s = min(2 * self._pause_s, LONGEST_PAUSE_S)
        return pause_s

    def text(self, result: EpisodeResult) -> str:
        """Return what the user reads while the worker waits."""
        return f"waiting up to {self._wait_s:g} s for the policy's server: {result.message}"


class Waiting:
    """Which workers of a run wait for the policy's server; the user reads when one begins and when one has played."""

    def __init__(self) -> None:
        """Start with none."""
        self._jobs: set[str] = set()

    def notice(self, note: Note) -> str:
        """Return the sentence of a worker's note for the user; empty: nothing new.

        Args:
            note: Its data have ``waiting``: what the worker waits for; empty: for nothing any more.
        """
        if not isinstance(note.data, dict) or "waiting" not in note.data:
            return ""
        waited = bool(self._jobs)
        if text := str(note.data["waiting"]):
            self._jobs.add(note.key)
            return "" if waited else text
        self._jobs.clear()
        return "the policy's server is back; the run continues" if waited else ""
