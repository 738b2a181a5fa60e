"""Tracks the newest revision of the simulated scene and returns exactly the revision that a request names."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

from roboxim_core.config import digest
from roboxim_core.errors import ErrorCode, PlannerError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.specs import SceneSpec
from roboxim_core.state import StateRecord
from roboxim_planner.scene import PlanningScene


@dataclass(frozen=True)
class _Tick:
    episode_id: str
    seq: int
    scene_hash: str
    read: Callable[[], StateRecord]


class SceneTracker:
    """Pairs the newest state with its scene, which may arrive before or after it. Safe to use from several threads."""

    def __init__(self, library: ModelLibrary) -> None:
        """Start without a scene.

        Args:
            library: Source of the entities' geometry.
        """
        self._library = library
        self._changed = threading.Condition()
        self._scene: tuple[SceneSpec, str, int] | None = None
        self._state: _Tick | None = None
        self._state_ns = 0
        self._built: tuple[_Tick, PlanningScene] | None = None

    def scene_arrived(self, scene: SceneSpec, sent_ns: int) -> None:
        """Store a scene, unless a newer one is stored.

        Args:
            scene: The scene.
            sent_ns: Time of sending by the sender's clock [ns].
        """
        with self._changed:
            if self._scene is None or sent_ns >= self._scene[2]:
                self._scene = (scene, digest(scene), sent_ns)
                self._changed.notify_all()

    def state_arrived(
        self, episode_id: str, seq: int, scene_hash: str, read: Callable[[], StateRecord], sent_ns: int
    ) -> None:
        """Store a state, unless a newer one is stored.

        Args:
            episode_id: Its episode.
            seq: Its tick.
            scene_hash: Hash of its scene, see `StateRecord`.
            read: Returns the state; called only when a request names this tick, since requests name few ticks.
            sent_ns: Time of sending by the sender's clock [ns].
        """
        with self._changed:
            if sent_ns < self._state_ns:
                return
            self._state, self._state_ns = _Tick(episode_id, seq, scene_hash, read), sent_ns
            self._changed.notify_all()

    def has(self, episode_id: str, seq: int) -> bool:
        """Return whether the revision has arrived, so that `revision` does not wait."""
        with self._changed:
            return self._has(episode_id, seq)

    def knows(self, episode_id: str, seq: int) -> bool:
        """Return whether the revision, or a later one of its episode, has arrived."""
        with self._changed:
            return self._has(episode_id, seq) or self._is_past(episode_id, seq)

    def revision(self, episode_id: str, seq: int, wait_s: float = 0.0) -> PlanningScene:
        """Return the planning scene of a revision.

        Args:
            episode_id: The episode.
            seq: The tick.
            wait_s: Longest wait for a revision that has not arrived yet [s].

        Raises:
            PlannerError: ``STALE_SCENE`` if the named revision is not the newest one.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._has(episode_id, seq) or self._is_past(episode_id, seq), wait_s)
            if not self._has(episode_id, seq):
                raise PlannerError(
                    f"scene of episode '{episode_id}', tick {seq} is not available: the planner has {self._newest()}; "
                    "name the newest tick",
                    ErrorCode.STALE_SCENE,
                )
            assert self._scene is not None
            assert self._state is not None
            if self._built is None or self._built[0] is not self._state:
                built = PlanningScene.from_state(self._scene[0], self._state.read(), self._library)
                self._built = (self._state, built)
            return self._built[1]

    def _has(self, episode_id: str, seq: int) -> bool:
        if self._state is None or self._scene is None or self._scene[1] != self._state.scene_hash:
            return False
        return (self._state.episode_id, self._state.seq) == (episode_id, seq)

    def _is_past(self, episode_id: str, seq: int) -> bool:
        return self._state is not None and self._state.episode_id == episode_id and self._state.seq > seq

    def _newest(self) -> str:
        if self._state is None:
            return "no scene yet; is the sim running?"
        without = ", whose scene has not arrived" * (self._scene is None or self._scene[1] != self._state.scene_hash)
        return f"episode '{self._state.episode_id}', tick {self._state.seq}{without}"
