"""The policy server on OpenVLA's wire: ``POST /act``."""

from __future__ import annotations

import socket
import threading
import traceback
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np

from roboxim_core.conventions import Convention
from roboxim_core.errors import InvalidRequestError
from roboxim_policies.serving.base import PolicyServer
from roboxim_policies.serving.listening import BoundedListener
from roboxim_policies.serving.sessions import MAX_SESSIONS, Session, Sessions, request_of
from roboxim_policies.wires import openvla
from roboxim_policies.wires.arrays import MESSAGE_BYTES
from roboxim_policies.wires.openpi import OWN_SERVER

NOT_FOUND = b'{"detail": "Not Found"}'
OFT_IMAGE = "full_image"
"""Key by which OpenVLA-OFT's clients are known: their answers are chunks."""
IDLE_S = 30.0
"""Time after which a connection that sends nothing is closed [s]."""


class OpenVlaServer(PolicyServer):
    """A server of ``POST /act``.

    The protocol has neither sessions nor episodes. RoboXim's own clients send both beside the request, and find under
    `openvla.DECLARATION` what the server is. All other clients share one session; a new ``episode_id``, a new
    instruction, and a tool that was set back (`Session.answer`) begin an episode.

    As the genuine server does, it answers an error with HTTP status 200 and ``"error"``; its log says why. A request
    with ``full_image``, as OpenVLA-OFT's clients send, is answered with a list of actions, others with one.
    """

    scheme = "http"

    @classmethod
    def answers_once(cls, convention: Convention | None) -> bool:
        """Return True, but for a convention of OFT."""
        return convention is None or all(image.key != OFT_IMAGE for image in convention.images)

    def _listen(self) -> None:
        server = self
        self._clients: OrderedDict[str, _Client] = OrderedDict()
        self._lock = threading.Lock()

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"
            timeout = IDLE_S

            def do_POST(self) -> None:  # noqa: N802 - the name that http.server calls
                self._send(*server._respond(self))

            def do_GET(self) -> None:  # noqa: N802
                if self.path == openvla.DECLARATION:
                    self._send(200, openvla.encode(server.metadata))
                else:
                    self._send(404, NOT_FOUND)

            def _send(self, status: int, body: bytes) -> None:
                self.send_response(status)
                self.send_header("Content-Type", "application/json")
                self.send_header("Content-Length", str(len(body)))
                if status != 200:
                    self.send_header("Connection", "close")
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_: Any) -> None:
                pass

        self._server = _Server((self.host, self.port), Handler)
        self._listener = BoundedListener.of(self._server.socket, all_users=self.all_users, log=self.log)
        self._server.socket = self._listener
        self.port = self._server.server_address[1]

    def _serve(self) -> None:
        self._server.serve_forever(poll_interval=0.05)

    def _stop(self) -> None:
        self._listener.end()
        self._server.shutdown()
        self._server.server_close()
        with self._lock:
            for client in self._clients.values():
                client.close()

    def _respond(self, handler: BaseHTTPRequestHandler) -> tuple[int, bytes]:
        """Return status and body of the answer to a request."""
        length = handler.headers.get("Content-Length", "")
        if handler.path != "/act":
            return 404, NOT_FOUND
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
        own = message.get(OWN_SERVER)
        if isinstance(own, dict):
            request[OWN_SERVER] = own
        with self._client(str(own.get("client", "")) if isinstance(own, dict) else "") as client:
            if (episode := message.get("episode_id")) is not None and str(episode) != client.episode:
                client.episode = str(episode)
                client.session.begin(episode_id=client.episode)
            rows = client.session.answer(request, guess=True)
        reply: Any = list(rows) if OFT_IMAGE in message else rows[0]
        if not double:
            return openvla.encode(reply)
        return openvla.encode(openvla.encode(reply).decode())

    @contextmanager
    def _client(self, name: str) -> Iterator[_Client]:
        """Yield a client's session, alone; the least recently used ones are dropped when there are too many."""
        while True:
            with self._lock:
                if name not in self._clients:
                    while len(self._clients) >= MAX_SESSIONS:
                        self._clients.popitem(last=False)[1].close()
                    self._clients[name] = _Client(self.sessions)
                self._clients.move_to_end(name)
                client = self._clients[name]
            with client.lock:
                if client.is_open:  # otherwise it was dropped meanwhile, and another client has its policy
                    yield client
                    return


class _Server(ThreadingHTTPServer):
    """Threads that end with the process, and a queue of more than the five clients of `socketserver`."""

    daemon_threads = True
    request_queue_size = socket.SOMAXCONN

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore a client that leaves in the middle; what a policy raises is an answer."""


class _Client:
    """One client's session."""

    def __init__(self, sessions: Sessions) -> None:
        self._stack = ExitStack()
        self.session: Session = self._stack.enter_context(sessions.session())
        self.lock = threading.Lock()
        self.is_open = True
        self.episode = ""

    def close(self) -> None:
        """Give the policy's instance back when the session's answer is given."""
        with self.lock:
            self.is_open = False
            self._stack.close()
