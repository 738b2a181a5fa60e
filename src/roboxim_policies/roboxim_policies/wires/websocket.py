"""A WebSocket connection with deadlines and a bound on the size of messages."""

from __future__ import annotations

import contextlib
import socket
import struct
from collections.abc import Mapping
from inspect import signature
from typing import TYPE_CHECKING, Any, ClassVar

from roboxim_policies.wires.arrays import MESSAGE_BYTES
from roboxim_policies.wires.base import Wire
from roboxim_policies.wires.errors import GATEWAY, REDIRECTS, Deadline, died, fault, quoted, redirected

if TYPE_CHECKING:
    from roboxim_core.errors import PolicyError

CLOSING_S = 0.5
"""Time that a server has to answer the closing handshake [s]."""
OTHERS = b"the server belongs to another user of the machine; its owner can start it with --all-users"
"""What RoboXim's servers say to other users."""
LEGACY: dict[str, Any] = {"legacy": True}
"""Option of websockets 17 and later by which `connect` returns a connection, as it always did before."""


class WebSocket:
    """A connection to a policy server.

    It sends no keepalive pings: a server that computes an action does not answer them, and would be taken for dead.
    Messages are not compressed, as the servers ask. A message whose header announces more than the bound is refused
    before its data is read. Proxies are not used, and redirects are not followed.
    """

    def __init__(self, url: str, server: str, deadline: Deadline, headers: Mapping[str, str] | None = None) -> None:
        """Connect.

        Args:
            url: Address, ``ws://`` or ``wss://``.
            server: Name of the server, for messages.
            deadline: Deadline of the connection and its opening handshake.
            headers: Further headers of the handshake.

        Raises:
            PolicyError: ``POLICY_DIED`` when there is no server, ``POLICY_LATE`` after the deadline, ``POLICY_FAULT``
                when the server refuses the handshake.
        """
        from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidMessage, InvalidStatus, InvalidURI
        from websockets.sync.client import ClientConnection, connect

        class Direct(ClientConnection):
            """A connection that follows no redirect, and reads a refusal that arrives before its request is sent."""

            def handshake(self, *arguments: Any, **options: Any) -> None:
                try:
                    super().handshake(*arguments, **options)
                except (InvalidStatus, ConnectionClosed) as error:
                    refused = error if isinstance(error, InvalidStatus) else self.protocol.handshake_exc
                    if not isinstance(refused, InvalidStatus):
                        raise
                    response = refused.response
                    if response.status_code in REDIRECTS:
                        raise redirected(server, response.status_code, response.headers.get("Location")) from None
                    raise refused from None

        self._server = server
        try:
            self._connection = connect(
                url, additional_headers=dict(headers or {}), compression=None, proxy=None, max_size=MESSAGE_BYTES,
                open_timeout=deadline.left(server), ping_interval=None, close_timeout=CLOSING_S,
                create_connection=Direct, **(LEGACY if "legacy" in signature(connect).parameters else {}),
            )  # fmt: skip
        except TimeoutError:
            raise deadline.passed(f"the opening handshake of {server}") from None
        except InvalidStatus as error:
            status = error.response.status_code
            if status in GATEWAY:
                raise died(f"{server} cannot be reached: HTTP status {status} of a gateway before it") from None
            hint = "; pass the server's key with key_env" if status in (401, 403) else ""
            if OTHERS in (error.response.body or b""):
                hint = f": {OTHERS.decode()}"
            raise fault(f"{server} refused the connection with HTTP status {status}{hint}") from None
        except (ConnectionError, socket.gaierror, EOFError) as error:
            raise died(f"{server} cannot be reached: {error}; start the server, or check the url") from None
        except ConnectionClosed:
            raise died(f"{server} closed the connection during the opening handshake") from None
        except InvalidMessage as error:
            if isinstance(error.__cause__, EOFError | ConnectionError):
                raise died(f"{server} closed the connection during the opening handshake") from None
            raise fault(f"{server} is not a WebSocket server: {error}") from None
        except (InvalidHandshake, InvalidURI) as error:
            raise fault(f"{server} is not a WebSocket server: {error}") from None
        except OSError as error:
            raise died(f"{server} cannot be reached: {error}; start the server, or check the url") from None

    @property
    def is_open(self) -> bool:
        """Whether the connection is open, as far as known without sending anything."""
        from websockets.protocol import State

        return self._connection.state is State.OPEN

    def send(self, data: bytes, deadline: Deadline) -> None:
        """Send a binary message.

        Raises:
            PolicyError: ``POLICY_DIED`` when the connection is lost, ``POLICY_LATE`` when the server does not read.
        """
        from websockets.exceptions import ConnectionClosed

        left = deadline.left(f"the reply of {self._server}")
        seconds, rest = divmod(left, 1.0)
        self._connection.socket.setsockopt(  # the connection's thread reads meanwhile: only the writing ends
            socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("ll", int(seconds), int(rest * 1e6) or 1)
        )
        try:
            self._connection.send(data)
        except ConnectionClosed as error:
            if isinstance(error.__cause__, BlockingIOError):
                raise deadline.passed(f"the reply of {self._server}, which does not read its request,") from None
            raise self._lost(error) from None
        except (OSError, TimeoutError):
            raise died(f"the connection to {self._server} was lost while the request was sent") from None

    def receive(self, deadline: Deadline, what: str = "reply") -> bytes | str:
        """Return the next message: bytes, or the text of a text message.

        Raises:
            PolicyError: ``POLICY_LATE`` after the deadline, ``POLICY_DIED`` when the connection is lost,
                ``POLICY_FAULT`` when the server closes it because of an error of its own or of a message too large.
        """
        from websockets.exceptions import ConnectionClosed

        what = f"the {what} of {self._server}"
        try:
            message: bytes | str = self._connection.recv(timeout=deadline.left(what))
            return message
        except TimeoutError:
            raise deadline.passed(what) from None
        except ConnectionClosed as error:
            raise self._lost(error) from None
        except UnicodeDecodeError:
            raise fault(f"{self._server} sent a text message that is not UTF-8") from None

    def require_silence(self) -> None:
        """Refuse an unrequested message: it would be taken for the next reply.

        Raises:
            PolicyError: ``POLICY_FAULT`` when a message waits.
        """
        from websockets.exceptions import ConnectionClosed

        try:
            message = self._connection.recv(timeout=0)
        except TimeoutError:
            return
        except ConnectionClosed as error:
            raise self._lost(error) from None
        raise fault(f"{self._server} sent a message of {len(message)} bytes without a request")

    def abort(self) -> None:
        """Close the connection at once. Its thread ends with it."""
        with contextlib.suppress(OSError, RuntimeError):
            if not self.is_open:
                self._connection.socket.shutdown(socket.SHUT_RDWR)
        with contextlib.suppress(OSError):  # a closing handshake that fails has closed as well
            self._connection.close()

    def _lost(self, error: Exception) -> PolicyError:
        """Return the error of a closed connection, by who closed it and why."""
        from websockets.exceptions import ConnectionClosed

        assert isinstance(error, ConnectionClosed)
        sent, received = error.sent, error.rcvd
        if sent is not None and sent.code == 1009 and not (received and error.rcvd_then_sent):
            return fault(f"{self._server} sent a message of more than {MESSAGE_BYTES} bytes: {sent.reason}")
        if sent is not None and sent.code in (1002, 1007) and not (received and error.rcvd_then_sent):
            return fault(f"{self._server} broke the WebSocket protocol: {sent.reason or sent.code}")
        if received is not None and received.code == 1011:
            return fault(f"{self._server} closed the connection after an error of its own: {quoted(received.reason)}")
        if received is not None:
            return died(f"{self._server} closed the connection (code {received.code} {quoted(received.reason)})")
        return died(f"the connection to {self._server} was lost")


class WebSocketWire(Wire):
    """A session over a WebSocket."""

    schemes: ClassVar[tuple[str, ...]] = ("ws", "wss")
    _socket: WebSocket | None = None

    def _alive(self) -> bool:
        return self._socket is not None and self._socket.is_open

    def _connection(self) -> WebSocket:
        assert self._socket is not None
        return self._socket

    def _shut(self) -> None:
        if self._socket is not None:
            self._socket.abort()
        self._socket = None
