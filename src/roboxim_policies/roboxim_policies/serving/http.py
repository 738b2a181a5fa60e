"""The policy server on OpenVLA's wire: ``POST /act``."""

from __future__ import annotations

import threading
import traceback
from contextlib import ExitStack
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np

from roboxim_core.errors import InvalidRequestError
from roboxim_policies.serving.base import PolicyServer
from roboxim_policies.serving.sessions import Session, request_of
from roboxim_policies.wires import openvla
from roboxim_policies.wires.arrays import MESSAGE_BYTES

IDLE_S = 30.0
"""Time after which a connection that sends nothing is closed [s]."""


class OpenVlaServer(PolicyServer):
    """A server of ``POST /act``. It has one session for all clients; a new instruction begins an episode.

    As the genuine server does, it answers an error with HTTP status 200 and ``"error"``; its log says why. A request
    with ``full_image``, as OpenVLA-OFT's clients send, is answered with a list of actions, others with one.
    """

    scheme = "http"

    def _listen(self) -> None:
        server = self
        self._stack = ExitStack()
        self._session: Session = self._stack.enter_context(self.sessions.session())
        self._lock = threading.Lock()

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"
            timeout = IDLE_S

            def do_POST(self) -> None:  # noqa: N802 - the name that http.server calls
                status, body = server._respond(self)
                self.send_response(status)
                self.send_header("Content-Type", "application/json")
                self.send_header("Content-Length", str(len(body)))
                if status != 200:
                    self.send_header("Connection", "close")
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_: Any) -> None:
                pass

        self._server = ThreadingHTTPServer((self.host, self.port), Handler)
        self._server.daemon_threads = True
        self.port = self._server.server_address[1]

    def _serve(self) -> None:
        self._server.serve_forever(poll_interval=0.05)

    def _stop(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._stack.close()

    def _respond(self, handler: BaseHTTPRequestHandler) -> tuple[int, bytes]:
        """Return status and body of the answer to a request."""
        length = handler.headers.get("Content-Length", "")
        if handler.path != "/act":
            return 404, b'{"detail": "Not Found"}'
        if handler.headers.get("Origin") is not None:
            return 403, b'{"detail": "requests of web pages are refused"}'
        if not length.isdigit() or int(length) > MESSAGE_BYTES:
            return 413, b'{"detail": "a request needs a Content-Length within the bound"}'
        body = handler.rfile.read(int(length))
        if not handler.headers.get("Content-Type", "").startswith("application/json"):
            return 422, b'{"detail": "the content type must be application/json"}'
        try:
            return 200, self._answer(openvla.decode(body))
        except Exception as error:  # a policy may raise anything
            self.log(f"{self.url}: {error}\n{traceback.format_exc()}")
            return 200, b'"error"'

    def _answer(self, message: Any) -> bytes:
        if not isinstance(message, dict):
            raise InvalidRequestError("a request must be a map")
        double = set(message) == {"encoded"}
        message = message["encoded"] if double else message
        if not isinstance(message, dict):
            raise InvalidRequestError("a request must be a map")
        images = {key: value for key, value in message.items() if isinstance(value, np.ndarray) and value.ndim >= 3}
        convention = self.sessions.convention
        text = message.get("instruction", message.get(convention.prompt.key))
        if not isinstance(text, str):
            raise InvalidRequestError("a request needs an instruction")
        request = request_of(convention, images, message.get("state"), text)
        request |= {key: value for key, value in message.items() if key in {s.key for s in convention.states}}
        with self._lock:
            rows = self._session.answer(request)
        reply: Any = list(rows) if "full_image" in message else rows[0]
        if not double:
            return openvla.encode(reply)
        return openvla.encode(openvla.encode(reply).decode())
