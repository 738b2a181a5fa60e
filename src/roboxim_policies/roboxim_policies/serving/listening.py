"""A listening socket that decides who may connect.

Servers of `websockets` and `http.server` start a thread for each connection before it has sent a byte, so ten thousand
silent connections would be ten thousand threads. Connections beyond the bound are closed at once.

Clients of openpi, OpenVLA and vla-eval know no token. A server that listens to this machine alone therefore asks the
kernel which user has the other end of a connection, and refuses other users.
"""

from __future__ import annotations

import ipaddress
import logging
import os
import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from roboxim_policies.wires.websocket import OTHERS
from roboxim_ros.peer_user import user_of_peer

MAX_CONNECTIONS = 320
"""Largest number of open connections of a server: more than its sessions, of which a shared policy has 256."""
MAX_REFUSALS, REFUSING_S, RECEIVED_BYTES = 8, 2.0, 65536
"""Number of clients that receive the reason of their refusal at the same time, the time for each of its two messages,
and their size."""
REFUSAL = b"HTTP/1.1 403 Forbidden\r\nContent-Length: %d\r\nConnection: close\r\n\r\n%b" % (len(OTHERS), OTHERS)


QUIET = logging.getLogger("roboxim.websockets")
"""Logger for `websockets`, whose own prints a traceback for whatever connects and is no WebSocket client."""
QUIET.setLevel(logging.CRITICAL)


class BoundedListener(socket.socket):
    """A listening socket that accepts a bounded number of connections, on a loopback address of its own user alone."""

    most: int = MAX_CONNECTIONS
    """Largest number of open connections."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """Make a socket; see `of` and `at`."""
        super().__init__(*arguments, **options)
        self._accepted: list[socket.socket] = []
        self._refusing = threading.BoundedSemaphore(MAX_REFUSALS)
        self._all_users = True
        self._log: Callable[[str], None] = lambda text: None

    @classmethod
    def of(
        cls, listening: socket.socket, *, all_users: bool = False, log: Callable[[str], None] = lambda text: None
    ) -> BoundedListener:
        """Take over a listening socket, which must not be used any more.

        Args:
            listening: The socket.
            all_users: Whether other users of this machine may connect to a loopback address. To another address
                everybody may who can reach it.
            log: Receives a line for each refused user.
        """
        made = cls(listening.family, listening.type, listening.proto, fileno=listening.detach())
        loopback = ipaddress.ip_address(made.getsockname()[0]).is_loopback
        made._all_users = all_users or not loopback or not _kernel_tells(log)
        made._log = log
        return made

    @classmethod
    def at(cls, host: str, port: int, **options: Any) -> BoundedListener:
        """Listen at an address.

        Args:
            host: Name or address.
            port: Port; 0: any.
            **options: As `of`.

        Raises:
            OSError: When the port is taken or the host is not of this machine.
        """
        family = socket.AF_INET6 if ":" in host else socket.AF_INET  # a full queue costs a client 1, 3, 7, ... s
        return cls.of(socket.create_server((host, port), family=family, backlog=socket.SOMAXCONN), **options)

    def accept(self) -> tuple[socket.socket, Any]:
        """Wait for a connection that may come in; close the others.

        Raises:
            OSError: When the socket is closed meanwhile.
        """
        while True:
            accepted, address = super().accept()
            self._accepted = [known for known in self._accepted if known.fileno() != -1]
            if len(self._accepted) >= self.most:
                accepted.close()
            elif not self._all_users and (user := _known_user(accepted)) not in (os.geteuid(), 0):
                self._log(
                    f"refused a connection of {'an unknown user' if user is None else f'the user with id {user}'}"
                )
                self._refuse(accepted)
            else:
                self._accepted.append(accepted)
                return accepted, address

    def _refuse(self, accepted: socket.socket) -> None:
        """Say why, in a thread of a bounded number: a client that is refused before its request may miss the answer."""
        if self._refusing.acquire(blocking=False):
            threading.Thread(target=self._say_why, args=(accepted,), name="refuse", daemon=True).start()
        else:
            accepted.close()

    def _say_why(self, accepted: socket.socket) -> None:
        try:
            with accepted, suppress(OSError):
                accepted.settimeout(REFUSING_S)
                if accepted.recv(RECEIVED_BYTES):
                    accepted.sendall(REFUSAL)
                    accepted.shutdown(socket.SHUT_WR)
                    accepted.recv(RECEIVED_BYTES)  # until the client has read it
        finally:
            self._refusing.release()

    def end(self) -> None:
        """End an `accept` that waits in another thread, which closing alone does not."""
        with suppress(OSError):
            self.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Close the socket, and end an `accept` that waits."""
        self.end()
        super().close()


def _kernel_tells(log: Callable[[str], None]) -> bool:
    """Whether this kernel reports the user at the other end of a connection."""
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()):
        try:
            with server.accept()[0] as accepted:
                return user_of_peer(accepted) is not None
        except (OSError, AttributeError) as error:
            log(f"every user of this machine can connect: the kernel does not report users ({error})")
            return False


def _known_user(connection: socket.socket) -> int | None:
    """Return the user at the other end; None if the kernel cannot report it now, so that no client ends `accept`."""
    try:
        return user_of_peer(connection)
    except OSError:  # e.g. no more file descriptors
        return None
