"""Wires: how RoboXim talks to policy servers in other processes. Each module is one protocol.

A wire takes the request of a convention (`roboxim_core.conventions`), a plain map of arrays and texts, and returns the
server's raw actions. `roboxim_policies.remote` joins a wire and a convention to a policy. No wire uses pickle.
"""

from __future__ import annotations

from roboxim_core.errors import ConfigError
from roboxim_policies.wires import groot, openpi, openvla, vla_eval, xvla  # importing a module registers its wire
from roboxim_policies.wires.base import REFUSED, WIRES, Answer, Metadata, Request, Rows, Wire


def find_wire(name: str) -> type[Wire]:
    """Return the class of a wire.

    Args:
        name: Registered name; hyphens count as underscores.

    Raises:
        ConfigError: When there is no such wire, or RoboXim refuses its protocol; the message gives the reason.
    """
    name = name.replace("-", "_")
    if name in REFUSED:
        raise ConfigError(f"the wire '{name}' is refused: {REFUSED[name]}")
    return WIRES[name]


__all__ = [
    "REFUSED",
    "WIRES",
    "Answer",
    "Metadata",
    "Request",
    "Rows",
    "Wire",
    "find_wire",
    "groot",
    "openpi",
    "openvla",
    "vla_eval",
    "xvla",
]
