"""A listening socket with a bound on open connections.

Servers of `websockets` and `http.server` start a thread for each connection before it has sent a byte. Ten thousand
connections that stay silent would be ten thousand threads. Connections beyond the bound are closed at once.
"""

from __future__ import annotations

import logging
import socket
from typing import Any

MOST_CONNECTIONS = 320
"""Largest number of open connections of a server: more than its sessions, of which a shared policy has 256."""


QUIET = logging.getLogger("roboxim.websockets")
"""Logger for `websockets`, whose own prints a traceback for whatever connects and is no WebSocket client."""
QUIET.setLevel(logging.CRITICAL)


class BoundedListener(socket.socket):
    """A listening socket that accepts no more than a number of connections at the same time."""

    most: int = MOST_CONNECTIONS
    """Largest number of open connections."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """Make a socket; see `of` and `at`."""
        super().__init__(*arguments, **options)
        self._accepted: list[socket.socket] = []

    @classmethod
    def of(cls, listening: socket.socket) -> BoundedListener:
        """Take over a listening socket, which must not be used any more."""
        return cls(listening.family, listening.type, listening.proto, fileno=listening.detach())

    @classmethod
    def at(cls, host: str, port: int) -> BoundedListener:
        """Listen at an address.

        Args:
            host: Name or address.
            port: Port; 0: any.

        Raises:
            OSError: When the port is taken or the host is not of this machine.
        """
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return cls.of(socket.create_server((host, port), family=family))

    def accept(self) -> tuple[socket.socket, Any]:
        """Wait for a connection for which there is room; close the others."""
        while True:
            accepted, address = super().accept()
            self._accepted = [known for known in self._accepted if known.fileno() != -1]
            if len(self._accepted) < self.most:
                self._accepted.append(accepted)
                return accepted, address
            accepted.close()
