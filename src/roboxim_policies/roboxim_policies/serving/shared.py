"""A policy that one process serves to the simulators of a run: `roboxim_policies.served` is the other side.

It uses openpi's wire, but no convention: observations and actions are the same as in the simulator's process. So an
evaluation's results do not depend on where its policy runs.

Non-obvious: answers of a *batch* may differ from single ones in the last bits, because a model may sum numbers in
another order. Only a policy that has ``act_batch`` is called in batches.
"""

from __future__ import annotations

import hmac
import http
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from roboxim_core.config import to_plain
from roboxim_core.errors import ConfigError, InvalidRequestError
from roboxim_core.policies import ActionChunk, EpisodeStart, Observation, ObservationWindow, Policy
from roboxim_core.policy_guard import GuardedPolicy
from roboxim_policies.base import BasePolicy
from roboxim_policies.serving.batches import Batched, Batcher
from roboxim_policies.serving.instances import Instances
from roboxim_policies.serving.websocket import OpenPiServer
from roboxim_policies.wires import openpi
from roboxim_policies.wires.openpi import OWN_SERVER
from roboxim_policies.wires.own import extras_in

MAX_SESSIONS = 256
"""Largest number of simulators at the same time."""
IMAGES = "images"
"""Key of a request: camera to the pictures of the window, uint8, shape (window, height, width, 3)."""


class SharedSessions:
    """Episodes of many simulators with one model, as far as the policy shares it."""

    def __init__(self, make: Callable[[], Policy], *, log: Callable[[str], None] = lambda text: None) -> None:
        """Make the policy.

        Args:
            make: Makes an instance.
            log: Receives the policy's tracebacks.

        Raises:
            ConfigError: When the policy is privileged.
        """
        self._log = log
        first = make()
        self.description = GuardedPolicy(first).description
        if self.description.privileged:
            raise ConfigError(
                f"policy '{self.description.name}' is privileged: it reads the task, the scene and the state, which no "
                "wire carries; leave --policy-servers out"
            )
        self.batcher = Batcher(type(first)) if answers_batches(type(first)) else None
        self._instances = Instances(first, lambda: _another(first) or make(), max_instances=MAX_SESSIONS)

    @contextmanager
    def session(self) -> Iterator[GuardedPolicy]:
        """Yield a policy for one episode.

        Raises:
            UnavailableError: When there are too many.
        """
        with self._instances.taken() as policy:
            if self.batcher is None:
                yield GuardedPolicy(policy, log=self._log)
                return
            self.batcher.join()
            try:
                yield GuardedPolicy(Batched(policy, self.batcher), log=self._log)
            finally:
                self.batcher.leave()

    def close(self) -> None:
        """End the batches, and forget the instances."""
        if self.batcher is not None:
            self.batcher.close()
        self._instances.close()


def _another(first: Policy) -> Policy | None:
    """Return one more instance with the first one's model, if the policy can share it."""
    another = getattr(first, "another", None)
    return another() if callable(another) else None


def answers_batches(kind: type[Any]) -> bool:
    """Return whether a policy's class defines ``act_batch``."""
    own = getattr(kind, "act_batch", None)
    return callable(own) and getattr(own, "__func__", own) is not vars(BasePolicy)["act_batch"].__func__


class SharedServer(OpenPiServer):
    """The server; each connection is one simulator."""

    sessions: SharedSessions  # type: ignore[assignment]

    def __init__(self, sessions: SharedSessions, *, key: str, **options: Any) -> None:
        """Prepare a server.

        Args:
            sessions: The policy's sessions.
            key: What clients must send as ``Authorization: Api-Key``; others are refused.
            **options: Arguments of `PolicyServer`.
        """
        super().__init__(sessions, **options)  # type: ignore[arg-type]
        self._key = key

    @property
    def metadata(self) -> dict[str, Any]:
        """What the server declares of itself."""
        return {OWN_SERVER: {"description": to_plain(self.sessions.description), "shared": True}}

    def _health(self, connection: Any, request: Any) -> Any:
        given = request.headers.get("Authorization", "")
        if not hmac.compare_digest(given.encode(), f"Api-Key {self._key}".encode()):
            return connection.respond(http.HTTPStatus.UNAUTHORIZED, "the key is wrong\n")
        return super()._health(connection, request)

    def _reply(self, session: Any, message: bytes | str) -> bytes | str:
        request = openpi.decode(message) if isinstance(message, bytes) else None
        if not isinstance(request, dict) or not isinstance(request.get("prompt"), str):
            raise InvalidRequestError("a request must be a binary MessagePack map with a prompt")
        if request.get("endpoint") == "reset":
            session.reset(
                EpisodeStart(
                    episode_id=str(request.get("session_id", "")), instruction=request["prompt"],
                    seed=int(request.get("seed", 0)),
                )
            )  # fmt: skip
            return openpi.RESET
        return openpi.encode(_plain(session.act(window_of(request))))


def window_of(request: Mapping[str, Any]) -> ObservationWindow:
    """Return the observation window of a request, as `roboxim_policies.served.request_of` made it.

    Raises:
        InvalidRequestError: When it is damaged.
    """
    own, images = extras_in(request), request.get(IMAGES)
    if own is None or not isinstance(images, dict):
        raise InvalidRequestError(f"a request needs '{IMAGES}' and '{OWN_SERVER}' with observations")
    for camera, frames in images.items():
        count = len(own.observations)
        rgb = isinstance(frames, np.ndarray) and frames.ndim == 4 and frames.shape[0] == count and frames.shape[3] == 3
        if not rgb or frames.dtype != np.uint8 or not frames.size:
            raise InvalidRequestError(f"'{IMAGES}' must have {count} uint8 RGB pictures of camera '{camera}'")
    observations = [
        Observation(
            seq=item.seq, stamp_ns=item.stamp_ns, proprio=item.proprio,
            images={camera: frames[number] for camera, frames in images.items()},
        )
        for number, item in enumerate(own.observations)
    ]  # fmt: skip
    return ObservationWindow(
        instruction=request["prompt"], observations=observations, pad_mask=own.pad_mask, episode_id=own.episode_id,
        seq=own.seq, commanded_opening=own.commanded_opening,
    )  # fmt: skip


def _plain(chunk: ActionChunk) -> dict[str, Any]:
    return {
        "actions": np.asarray(chunk.actions), "done": chunk.done, "phases": list(chunk.phases),
        "received": list(chunk.received),
    }  # fmt: skip
