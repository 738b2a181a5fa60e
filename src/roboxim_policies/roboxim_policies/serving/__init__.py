"""Servers of RoboXim's policies on the wires of other benchmarks: ``roboxim policy serve bc --wire openpi``.

A server has a convention, which defines the meaning of its requests and answers. The default is the policy's own
(`own_convention`). The metadata declare it, so ``--option convention=server`` suffices on RoboXim's side.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from roboxim_core.conventions import Convention
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.policies import Policy
from roboxim_policies.serving.base import PolicyServer
from roboxim_policies.serving.http import OpenVlaServer
from roboxim_policies.serving.sessions import Session, Sessions, own_convention
from roboxim_policies.serving.websocket import OpenPiServer, VlaEvalServer

SERVERS: dict[str, type[PolicyServer]] = {
    "openpi": OpenPiServer,
    "vla_eval": VlaEvalServer,
    "openvla": OpenVlaServer,
}
"""Wires that policies are served over."""


def stand_alone_server() -> Path:
    """Return the file that serves a model of another environment over openpi's wire; it imports nothing of RoboXim."""
    package = Path(__file__).parents[1]
    installed = package / "stand_alone" / "openpi_server.py"
    return installed if installed.exists() else package.parent / "servers" / "openpi_server.py"


def policy_server(
    make: Callable[[], Policy], wire: str, *, convention: Convention | None = None, size: int = 256,
    host: str = "127.0.0.1", port: int = 8000, **options: Any,
) -> PolicyServer:  # fmt: skip
    """Return a server that is not started yet.

    Args:
        make: Makes an instance of the policy; called for each connection at the same time.
        wire: ``openpi``, ``vla_eval`` or ``openvla``; hyphens count as underscores.
        convention: Meaning of requests and answers; None: the policy's own.
        size: Side of the pictures of cameras for which the policy names no size [px]; for its own convention.
        host: Address to listen at. Anybody who can connect can use the policy.
        port: Port to listen at; 0: any.
        **options: Further arguments of `PolicyServer`.

    Raises:
        ConfigError: When the wire is unknown, or the policy cannot be served.
    """
    wire = wire.replace("-", "_")
    if wire not in SERVERS:
        raise ConfigError(f"no server for wire '{wire}'; {one_of(SERVERS, wire)}")
    server = SERVERS[wire]
    sessions = Sessions(make, convention=convention, size=size, single=server.answers_once(convention))
    return server(sessions, host=host, port=port, **options)


__all__ = ["SERVERS", "PolicyServer", "Session", "Sessions", "own_convention", "policy_server", "stand_alone_server"]
