"""The base class of policy servers."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Self

from roboxim_core.config import to_plain
from roboxim_core.conventions import Convention
from roboxim_core.errors import UnavailableError
from roboxim_policies.serving.sessions import Sessions
from roboxim_policies.wires.openpi import OWN_SERVER


class PolicyServer(ABC):
    """A server of one policy, in its own threads; a context manager."""

    scheme: str = ""
    """Scheme of its URL."""

    def __init__(
        self, sessions: Sessions, *, host: str = "127.0.0.1", port: int = 8000, all_users: bool = False,
        log: Callable[[str], None] = lambda text: None,
    ) -> None:  # fmt: skip
        """Prepare a server.

        Args:
            sessions: The policy's sessions.
            host: Address to listen at.
            port: Port to listen at; 0: any.
            all_users: Whether other users of this machine may connect to a loopback address; see `BoundedListener`.
            log: Receives a line for each connection and each error.
        """
        self.sessions = sessions
        self.host, self.port = host, port
        self.all_users = all_users
        self.log = log
        self._thread: threading.Thread | None = None

    @classmethod
    def answers_once(cls, convention: Convention | None) -> bool:
        """Return whether an answer has one action, so that clients ask at every tick.

        Args:
            convention: Meaning of requests and answers; None: the policy's own.
        """
        return False

    @property
    def url(self) -> str:
        """Address of the server."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.scheme}://{host}:{self.port}"

    @property
    def metadata(self) -> dict[str, Any]:
        """What the server declares of itself, as far as the wire has a place for it."""
        description = self.sessions.description
        return {
            OWN_SERVER: {
                "policy": description.name,
                "version": description.version,
                "convention": to_plain(self.sessions.convention),
                "own": self.sessions.is_own,
            }
        }

    def __enter__(self) -> Self:
        """Listen.

        Raises:
            UnavailableError: When the port is taken.
        """
        try:
            self._listen()
        except (OSError, TypeError, UnicodeError) as error:  # the last two: of a host that is no name
            raise UnavailableError(f"cannot listen at {self.url}: {error}; choose another --port") from None
        self._thread = threading.Thread(target=self._serve, name=f"serve {self.url}", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop listening and end all sessions."""
        self._stop()
        if self._thread is not None:
            self._thread.join()
        self.sessions.close()

    @abstractmethod
    def _listen(self) -> None:
        """Bind the port, and set ``port``."""

    @abstractmethod
    def _serve(self) -> None:
        """Serve until `_stop`."""

    @abstractmethod
    def _stop(self) -> None:
        """End `_serve`."""
