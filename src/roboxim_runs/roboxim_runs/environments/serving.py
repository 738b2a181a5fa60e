"""Serves Gymnasium environments to programs of other Python environments, over a WebSocket.

Messages are MessagePack maps, arrays as on openpi's wire. A connection is one environment:

- ``{"make": {"task", "size", "control", "rate", "max_steps"}}`` -> ``{"spec": {...}}``, once and first
- ``{"reset": {"seed", "index"}}`` -> ``{"observation", "info"}``
- ``{"step": action}`` -> ``{"observation", "reward", "terminated", "truncated", "info"}``
- an error is answered by ``{"error": text}``; the connection stays open
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from roboxim_core.config_folders import config_names
from roboxim_core.errors import InvalidRequestError, RoboximError, UnavailableError, one_of, printable
from roboxim_policies.serving.websocket import WebSocketServer
from roboxim_policies.wires import openpi
from roboxim_runs.environments.gymnasium_env import RoboXimEnv

ARGUMENTS: Mapping[str, type | tuple[type, ...]] = {
    "task": str, "size": int, "control": str, "rate": (int, float), "max_steps": int,
}  # fmt: skip
"""What a client may choose. It cannot name files: tasks are those of ``config/tasks``."""
LARGEST_SIZE = 1024
"""Largest side of a client's pictures [px]."""


class EnvironmentServer(WebSocketServer):
    """A server of environments, in its own threads; a context manager. Web pages are refused."""

    def __init__(self, *, port: int = 8765, max_environments: int = 8, **options: Any) -> None:
        """Prepare a server.

        Args:
            port: Port to listen at; 0: any.
            max_environments: Largest number of environments at the same time.
            **options: Arguments of `PolicyServer`. Whoever connects can run episodes.
        """
        super().__init__(_Environments(max_environments), port=port, **options)  # type: ignore[arg-type]

    def _talk(self, connection: Any, session: Any) -> None:
        for message in connection:
            connection.send(openpi.encode(self._answered(session, message)))

    def _answered(self, served: _Served, message: bytes | str) -> dict[str, Any]:
        try:
            request = openpi.decode(message) if isinstance(message, bytes) else None
            if not isinstance(request, dict) or len(request) != 1:
                raise InvalidRequestError("a request must be a map with one of: make, reset, step")
            ((kind, value),) = request.items()
            return served.answer(str(kind), value)
        except RoboximError as error:
            return {"error": self._describe_error(error)}


class _Environments:
    """The environments of all connections."""

    def __init__(self, most: int) -> None:
        self._most, self._places = most, threading.Semaphore(most)

    @contextmanager
    def session(self) -> Iterator[_Served]:
        """Yield a place for an environment.

        Raises:
            UnavailableError: When there are too many.
        """
        if not self._places.acquire(blocking=False):
            raise UnavailableError(f"the server has {self._most} environments already")
        served = _Served()
        try:
            yield served
        finally:
            served.close()
            self._places.release()

    def close(self) -> None:
        """Do nothing: each connection frees its own."""


class _Served:
    """The environment of one connection. It lives in the thread of its first request."""

    def __init__(self) -> None:
        self._env: RoboXimEnv | None = None

    def answer(self, kind: str, value: Any) -> dict[str, Any]:
        """Answer a request.

        Raises:
            InvalidRequestError: When it is not one of the protocol.
            RoboximError: As the environment.
        """
        if kind == "make":
            return self._make(value)
        if self._env is None:
            raise InvalidRequestError("the first request must be 'make'")
        if kind == "reset":
            return self._reset(self._env, value)
        if kind == "step":
            if not isinstance(value, np.ndarray):
                raise InvalidRequestError("a step must be an array, the action")
            observation, reward, terminated, truncated, info = self._env.step(value)
            return {
                "observation": observation, "reward": float(reward), "terminated": terminated, "truncated": truncated,
                "info": info,
            }  # fmt: skip
        raise InvalidRequestError(f"unknown request '{printable(kind, 40)}'; {one_of(('make', 'reset', 'step'), kind)}")

    def close(self) -> None:
        """Free the environment."""
        if self._env is not None:
            self._env.close()
        self._env = None

    def _make(self, value: Any) -> dict[str, Any]:
        if self._env is not None:
            raise InvalidRequestError("this connection has an environment already; open another connection")
        given = value if isinstance(value, dict) else {}
        for name, part in given.items():
            kinds = ARGUMENTS.get(name)
            if kinds is None:
                raise InvalidRequestError(f"unknown argument; {one_of(ARGUMENTS, str(name))}")
            if not isinstance(part, kinds) or isinstance(part, bool):
                raise InvalidRequestError(f"argument '{name}' has the wrong type: {printable(repr(part), 60)}")
        tasks = config_names("tasks")
        if given.get("task") not in tasks:
            raise InvalidRequestError(
                f"no task '{printable(given.get('task'), 60)}'; {one_of(tasks, str(given.get('task')))}"
            )
        if not 0 <= given.get("size", 0) <= LARGEST_SIZE:
            raise InvalidRequestError(f"size must be from 0 to {LARGEST_SIZE} px, got {given['size']}")
        env = self._env = RoboXimEnv(**given)
        space = env.action_space
        return {
            "spec": {
                "task": given["task"],
                "pixels": {name: [height, width, 3] for name, (width, height) in env.session.cameras.items()},
                "action_low": np.asarray(space.low),  # type: ignore[attr-defined]
                "action_high": np.asarray(space.high),  # type: ignore[attr-defined]
                "agent_pos": list(env.observation_space["agent_pos"].shape or ()),  # type: ignore[index]
                "rate_hz": float(env.session.rate_hz),
                "max_steps": int(env.session.max_steps),
            }
        }

    def _reset(self, env: RoboXimEnv, value: Any) -> dict[str, Any]:
        given = value if isinstance(value, dict) else {}
        seed, index = given.get("seed"), given.get("index")
        for name, number in (("seed", seed), ("index", index)):
            if number is not None and (type(number) is not int or number < 0):
                raise InvalidRequestError(
                    f"{name} must be a whole number >= 0 or nil, got {printable(repr(number), 40)}"
                )
        observation, info = env.reset(seed=seed, options=None if index is None else {"index": index})
        return {"observation": observation, "info": info}
