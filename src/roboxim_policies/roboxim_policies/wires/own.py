"""What RoboXim's own clients send to its own servers beside a request: the observations, without their pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from roboxim_core.config import from_plain, to_plain
from roboxim_core.errors import InvalidRequestError
from roboxim_core.policies import ObservationWindow
from roboxim_core.proprioception import Proprioception
from roboxim_policies.wires.openpi import OWN_SERVER


@dataclass(frozen=True, kw_only=True)
class OwnObservation:
    """An `Observation` without its pictures."""

    seq: int
    """Tick."""
    stamp_ns: int
    """Simulated time [ns]."""
    proprio: Proprioception
    """The robot's own measurements."""


@dataclass(frozen=True, kw_only=True)
class OwnExtras:
    """An `ObservationWindow` without its pictures and instruction."""

    seq: int
    """Tick of the newest observation."""
    episode_id: str
    """Episode."""
    pad_mask: tuple[bool, ...]
    """For each observation, whether it is real."""
    observations: tuple[OwnObservation, ...]
    """The observations, newest last."""
    commanded_opening: float | None = None
    """See `ObservationWindow`."""
    seed: int | None = None
    """Seed of the policy's own randomness; None: that of the announced episode."""
    client: str = ""
    """Name of the client, on a wire without sessions."""


def own_extras(window: ObservationWindow) -> dict[str, Any]:
    """Return what RoboXim's own server receives beside the convention's request, as plain data."""
    seen = tuple(OwnObservation(seq=o.seq, stamp_ns=o.stamp_ns, proprio=o.proprio) for o in window.observations)
    plain: dict[str, Any] = to_plain(
        OwnExtras(
            seq=window.seq, episode_id=window.episode_id, pad_mask=window.pad_mask, observations=seen,
            commanded_opening=window.commanded_opening,
        )
    )  # fmt: skip
    del plain["seed"], plain["client"]  # of the wire
    return plain


def extras_in(request: Mapping[str, Any], size: int | None = None) -> OwnExtras | None:
    """Return what a client of RoboXim sent beside its request; None: it is another client's.

    Args:
        request: The request.
        size: Number of observations that it must have; None: at least one.

    Raises:
        InvalidRequestError: Naming every wrong field.
    """
    own = request.get(OWN_SERVER)
    if not isinstance(own, dict):
        return None
    known = {field.name for field in fields(OwnExtras)}  # a later version may send more
    read = from_plain(
        {key: value for key, value in own.items() if key in known}, OwnExtras, source=f"'{OWN_SERVER}' of the request"
    )
    if not read.observations or len(read.observations) != (size or len(read.observations)):
        raise InvalidRequestError(
            f"'{OWN_SERVER}' of the request must have {size or 'some'} observations, got {len(read.observations)}"
        )
    return read
