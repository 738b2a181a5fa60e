"""Serves Gymnasium environments to programs of other Python environments, over a WebSocket.

Messages are MessagePack maps, arrays as on openpi's wire. A connection is one environment:

- ``{"make": {"task", "size", "control", "rate", "max_steps"}}`` -> ``{"spec": {...}}``, once and first
- ``{"reset": {"seed", "index"}}`` -> ``{"observation", "info"}``
- ``{"step": action}`` -> ``{"observation", "reward", "terminated", "truncated", "info"}``
- an error is answered by ``{"error": text}``; the connection stays open
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any, Self

import numpy as np

from roboxim_core.config_folders import config_names
from roboxim_core.errors import InvalidRequestError, RoboximError, UnavailableError, one_of, printable
from roboxim_policies.serving.listening import QUIET, BoundedListener
from roboxim_policies.wires import openpi
from roboxim_policies.wires.arrays import MESSAGE_BYTES
from roboxim_runs.environments.gymnasium_env import RoboXimEnv

ARGUMENTS: Mapping[str, type | tuple[type, ...]] = {
    "task": str, "size": int, "control": str, "rate": (int, float), "max_steps": int,
}  # fmt: skip
"""What a client may choose. It cannot name files: tasks are those of ``config/tasks``."""
STOPS = "the server stops"
LARGEST_SIZE = 1024
"""Largest side of a client's pictures [px]."""


class EnvironmentServer:
    """A server of environments, in its own threads; a context manager. Web pages are refused."""

    def __init__(
        self, *, host: str = "127.0.0.1", port: int = 8765, max_environments: int = 8, all_users: bool = False,
        log: Callable[[str], None] = lambda text: None,
    ) -> None:  # fmt: skip
        """Prepare a server.

        Args:
            host: Address to listen at. Whoever connects can run episodes.
            port: Port to listen at; 0: any.
            max_environments: Largest number of environments at the same time.
            all_users: Whether other users of this machine may connect to a loopback address.
            log: Receives a line for each connection and each error.
        """
        self.host, self.port = host, port
        self._max_environments, self._all_users, self._log = max_environments, all_users, log
        self._places = threading.Semaphore(max_environments)
        self._connections: set[Any] = set()
        self._stops = False
        self._thread: threading.Thread | None = None

    @property
    def url(self) -> str:
        """Address of the server."""
        return f"ws://[{self.host}]:{self.port}" if ":" in self.host else f"ws://{self.host}:{self.port}"

    def __enter__(self) -> Self:
        """Listen.

        Raises:
            UnavailableError: When the port is taken.
        """
        from websockets.sync.server import serve

        try:
            listener = BoundedListener.at(self.host, self.port, all_users=self._all_users, log=self._log)
            self._server = serve(
                self._connected, sock=listener, compression=None,
                max_size=MESSAGE_BYTES, ping_interval=None,
                close_timeout=1.0, origins=[None], logger=QUIET,
            )  # fmt: skip
        except (OSError, TypeError, UnicodeError) as error:  # the last two: of a host that is no name
            raise UnavailableError(f"cannot listen at {self.url}: {error}; choose another --port") from None
        self.port = self._server.socket.getsockname()[1]
        self._thread = threading.Thread(target=self._server.serve_forever, name=f"serve {self.url}", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop listening, and end all connections."""
        self._stops = True
        self._server.shutdown()
        for connection in list(self._connections):
            connection.close(1001, STOPS)
        if self._thread is not None:
            self._thread.join()

    def _connected(self, connection: Any) -> None:
        from websockets.exceptions import ConnectionClosed

        if not self._places.acquire(blocking=False):
            connection.close(1013, f"the server has {self._max_environments} environments already")
            return
        self._connections.add(connection)
        served = _Served()
        try:
            if self._stops:  # it came while the others were closed
                connection.close(1001, STOPS)
                return
            for message in connection:
                connection.send(openpi.encode(self._answered(served, message)))
        except ConnectionClosed:
            pass
        finally:
            served.close()
            self._connections.discard(connection)
            self._places.release()

    def _answered(self, served: _Served, message: bytes | str) -> dict[str, Any]:
        try:
            request = openpi.decode(message) if isinstance(message, bytes) else None
            if not isinstance(request, dict) or len(request) != 1:
                raise InvalidRequestError("a request must be a map with one of: make, reset, step")
            ((kind, value),) = request.items()
            return served.answer(str(kind), value)
        except RoboximError as error:
            self._log(str(error))
            return {"error": f"{type(error).__name__}: {printable(error)}"}


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
