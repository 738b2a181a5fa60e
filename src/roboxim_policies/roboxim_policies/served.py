"""A policy of the run that a separate process computes for the simulators; see `roboxim_policies.serving.shared`.

Unlike a remote policy (`roboxim_policies.remote`) it is the user's own policy, with its own description: an evaluation
records the same as if the policy ran in the simulator's process.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from roboxim_core.config import from_plain
from roboxim_core.policies import ActionChunk, EpisodeStart, ObservationWindow, PolicyDescription
from roboxim_policies.base import BasePolicy
from roboxim_policies.serving.shared import IMAGES
from roboxim_policies.wires.base import Answer
from roboxim_policies.wires.openpi import OWN_SERVER, OpenPiWire
from roboxim_policies.wires.own import own_extras

RECONNECT_S = 2.0
"""Time in which a refused connection is tried again [s]; the run finds the server's new address afterwards."""


class ServedPolicy(BasePolicy):
    """A policy behind a server of the same run. Connects when an episode begins."""

    def __init__(self, url: str, description: dict[str, Any], *, key_env: str = "", timeout_s: float = 90.0) -> None:
        """Describe the policy without connecting to its server.

        Args:
            url: Address of the server, ``ws://host:port``.
            description: The policy's `PolicyDescription` as plain data.
            key_env: Environment variable with the server's key.
            timeout_s: Deadline of an answer [s].

        Raises:
            ConfigError: On a wrong argument.
        """
        self._description = from_plain(description, PolicyDescription, source="the description of a served policy")
        self._received: tuple[str, ...] = ()
        self._wire = _SharedWire(url, timeout_s=timeout_s, reconnect_s=RECONNECT_S, key_env=key_env)

    def describe(self) -> PolicyDescription:
        """Return the served policy's own description."""
        return self._description

    def reset(self, start: EpisodeStart) -> None:
        """Begin an episode; connects if there is no connection.

        Raises:
            PolicyError: When the server cannot be reached, or the policy raises.
        """
        self._received = ()
        self._wire.reset(start)

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Ask the server.

        Raises:
            PolicyError: ``POLICY_DIED`` when the server is lost, ``POLICY_LATE`` after the deadline, ``POLICY_FAULT``
                when the policy raises.
        """
        actions = self._wire.ask(request_of(window))["actions"].astype(np.float32)
        reply = self._wire.reply
        self._received = tuple(map(str, reply.get("received") or ()))
        return ActionChunk(
            actions=actions, done=bool(reply.get("done")), phases=tuple(map(str, reply.get("phases") or ()))
        )

    def received_instructions(self) -> tuple[str, ...]:
        """Return the instructions that the served policy was given in this episode, as its server says."""
        return self._received

    def close(self) -> None:
        """Close the connection."""
        self._wire.close()


class _SharedWire(OpenPiWire):
    """openpi's wire, with the additional replies of the shared server."""

    reply: Mapping[str, Any] = {}

    @classmethod
    def name(cls) -> str:
        """Return its name for messages."""
        return "policy"

    def _actions(self, reply: Any) -> Answer:
        self.reply = reply if isinstance(reply, dict) else {}
        return super()._actions(reply)


def request_of(window: ObservationWindow) -> dict[str, Any]:
    """Return the request for a window: pictures and measurements as they are."""
    cameras = window.newest.images
    return {
        "prompt": window.instruction,
        IMAGES: {camera: np.stack([item.images[camera] for item in window.observations]) for camera in cameras},
        OWN_SERVER: own_extras(window),
    }
