"""Policy servers on WebSocket: openpi's wire and vla-eval's."""

from __future__ import annotations

import contextlib
import http
import time
import traceback
from abc import abstractmethod
from typing import Any

import numpy as np

from roboxim_core.config import to_json
from roboxim_core.conventions import Convention
from roboxim_core.errors import InvalidRequestError, RoboximError, printable
from roboxim_policies.serving.base import PolicyServer
from roboxim_policies.serving.listening import QUIET, BoundedListener
from roboxim_policies.serving.sessions import Session, request_of
from roboxim_policies.wires import openpi, vla_eval
from roboxim_policies.wires.arrays import MESSAGE_BYTES

STOPS = "the server stops"


class WebSocketServer(PolicyServer):
    """A server with one session for each connection. Web pages, whose requests name an origin, are refused."""

    scheme = "ws"
    health_path = "/healthz"
    health_text = "OK\n"

    def _listen(self) -> None:
        from websockets.sync.server import serve

        listener = BoundedListener.at(self.host, self.port, all_users=self.all_users, log=self.log)
        self._server = serve(
            self._connected, sock=listener, compression=None,
            max_size=MESSAGE_BYTES, ping_interval=None,
            close_timeout=1.0, origins=[None], logger=QUIET, process_request=self._health,
        )  # fmt: skip
        self.port = self._server.socket.getsockname()[1]
        self._connections: set[Any] = set()
        self._stops = False

    def _serve(self) -> None:
        self._server.serve_forever()

    def _stop(self) -> None:
        self._stops = True
        self._server.shutdown()
        for connection in list(self._connections):
            with contextlib.suppress(OSError):  # the client was faster
                connection.close(1001, STOPS)

    def _health(self, connection: Any, request: Any) -> Any:
        if request.path == self.health_path:
            return connection.respond(http.HTTPStatus.OK, self.health_text)
        return None

    def _connected(self, connection: Any) -> None:
        from websockets.exceptions import ConnectionClosed

        self._connections.add(connection)
        try:
            if self._stops:  # it came while the others were closed
                connection.close(1001, STOPS)
                return
            with self.sessions.session() as session:
                self._talk(connection, session)
        except ConnectionClosed:
            pass
        except RoboximError as error:
            self.log(str(error))
            connection.close(1013, printable(error, 100))
        finally:
            self._connections.discard(connection)

    @abstractmethod
    def _talk(self, connection: Any, session: Session) -> None:
        """Answer a connection's messages until it closes."""

    def _describe_error(self, error: Exception) -> str:
        """Log an error, and return the message for the client."""
        self.log(f"{self.url}: {traceback.format_exc()}" if not isinstance(error, RoboximError) else str(error))
        return f"{type(error).__name__}: {printable(error)}"


class OpenPiServer(WebSocketServer):
    """A server of openpi's wire; ``endpoint: reset`` begins an episode, as RoboArena's does.

    Clients of openpi itself know no episodes, see `Session.answer`.
    """

    def _talk(self, connection: Any, session: Session) -> None:
        connection.send(openpi.encode(self.metadata))
        for message in connection:
            try:
                reply = self._reply(session, message)
            except Exception as error:  # a policy may raise anything
                connection.send(self._describe_error(error))
                connection.close(1011, "Internal server error. The error is in the previous frame.")
                return
            connection.send(reply)

    def _reply(self, session: Session, message: bytes | str) -> bytes | str:
        request = openpi.decode(message) if isinstance(message, bytes) else None
        if not isinstance(request, dict):
            raise InvalidRequestError("a request must be a binary MessagePack map")
        if request.get("endpoint") == "reset":
            session.begin(
                str(request.get("prompt", "")), episode_id=str(request.get("session_id", "")),
                seed=int(request.get("seed", 0)),
            )  # fmt: skip
            return openpi.RESET
        began = time.perf_counter()
        actions = session.answer(request, guess="endpoint" not in request).astype(np.float32)
        elapsed_ms = 1000 * (time.perf_counter() - began)
        return openpi.encode({"actions": actions, "server_timing": {"infer_ms": elapsed_ms}})


class VlaEvalServer(WebSocketServer):
    """A model server of vla-eval's protocol. Its clients ask at every tick and take one action."""

    health_path = "/health"
    health_text = '{"status": "ok"}\n'

    @classmethod
    def answers_once(cls, convention: Convention | None) -> bool:
        """Return True."""
        return True

    def _talk(self, connection: Any, session: Session) -> None:
        for data in connection:
            seq = 0
            try:
                message = vla_eval.decode(data) if isinstance(data, bytes) else None
                if not isinstance(message, dict) or not isinstance(message.get("payload"), dict):
                    raise InvalidRequestError("a message must be a map with type, payload and seq")
                seq = message.get("seq", 0)
                reply = self._reply(session, str(message.get("type")), message["payload"])
            except Exception as error:  # a policy may raise anything
                reply = "error", {"error": self._describe_error(error)}
            if reply is not None:
                kind, payload = reply
                connection.send(
                    vla_eval.encode({"type": kind, "payload": payload, "seq": seq, "timestamp": time.time()})
                )

    def _reply(self, session: Session, kind: str, payload: dict[str, Any]) -> tuple[str, dict[str, Any]] | None:
        convention = self.sessions.convention
        if kind == "hello":
            return "hello", {
                "harness_version": vla_eval.HARNESS_VERSION,
                "protocol_version": vla_eval.PROTOCOL_VERSION,
                "model_server": f"roboxim:{self.sessions.description.name}",
                "capabilities": {},
                "observation_params": {
                    "send_state": bool(convention.states),
                    "send_wrist_image": any("wrist" in image.camera for image in convention.images),
                    # taken by RoboXim's benchmark alone, see `RoboXimBenchmark`; not documented to others
                    **({"server_convention": to_json(convention)} if self.sessions.is_own else {}),
                },
                **self.metadata,
            }
        if kind == "episode_start":
            task = payload.get("task")
            task = task if isinstance(task, dict) else {}
            seed = task.get("seed", 0)
            session.begin(
                episode_id=str(task.get("episode_id", "")), seed=seed if isinstance(seed, int) else 0
            )  # fmt: skip
            return None
        if kind == "episode_end":
            return None
        if kind != "observation":
            raise InvalidRequestError(f"unknown type of message '{printable(kind, 40)}'")
        images = payload.get("images")
        state = payload.get("states", payload.get("state"))
        request = request_of(
            convention, images if isinstance(images, dict) else {}, state, str(payload.get("task_description", "")),
            apart={vla_eval.CONTROLLER_STATES: payload.get(vla_eval.CONTROLLER_STATES)},
        )  # fmt: skip
        if openpi.OWN_SERVER in payload:  # a client of RoboXim sends the measurements as they are
            request[openpi.OWN_SERVER] = payload[openpi.OWN_SERVER]
        return "action", {"actions": session.answer(request).astype(np.float32)[0]}
