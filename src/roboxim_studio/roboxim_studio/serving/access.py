"""Who may reach the studio: requests with the token, addressed to this machine, from the studio's own page.

The token is the first part of every path. A cookie would be sent to every other server of this machine too, because
cookies do not distinguish ports.
"""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from urllib.parse import SplitResult, unquote, urlsplit

LOOPBACK = ("127.0.0.1", "localhost", "::1")
"""Hosts by which a browser of this machine, or one behind an SSH tunnel, addresses the studio."""


@dataclass(frozen=True, kw_only=True)
class Access:
    """The rule that every request must meet."""

    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    """Secret of the address."""
    open_network: bool = False
    """Whether other machines may reach the studio, by any name."""

    @property
    def host(self) -> str:
        """Address to listen at."""
        return "0.0.0.0" if self.open_network else LOOPBACK[0]

    def path(self, path: str, headers: Mapping[str, str]) -> str | None:
        """Return the path behind the token of a request that may pass, else None.

        Args:
            path: Path of the request, with or without a query.
            headers: Its headers; names are compared as they are given.

        Returns:
            For example ``""`` for the page and ``control`` for the control channel.
        """
        host = headers.get("Host") or ""
        name = _parts(f"//{host}").hostname if host else None
        if not self.open_network and name not in LOOPBACK:  # DNS rebinding: another name that resolves to this machine
            return None
        origin = headers.get("Origin")
        if origin is not None and _parts(origin).netloc != host:  # a page of another site
            return None
        token, _, rest = unquote(path.partition("?")[0]).lstrip("/").partition("/")
        if not secrets.compare_digest(token.encode(), self.token.encode()):
            return None
        return rest

    def url(self, port: int) -> str:
        """Return the address to open."""
        return f"http://{LOOPBACK[0]}:{port}/{self.token}/"


def _parts(url: str) -> SplitResult:
    """Return the parts of a URL; one that is malformed has none."""
    try:
        return urlsplit(url)
    except ValueError:
        return SplitResult("", "", "", "", "")
