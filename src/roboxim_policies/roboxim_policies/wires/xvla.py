"""The wire of X-VLA's own server: ``POST /act`` with plain JSON whose arrays are texts of json_numpy.

A request has ``image0`` to ``image2``, ``proprio``, ``language_instruction``, ``domain_id`` and ``steps`` (of
denoising); the reply is ``{"action": [[...], ...]}``, absolute poses as lists of 20 numbers. An error has the HTTP
status 400. There are no metadata, no sessions and no keys.

Non-obvious: the models were trained on poses that were commanded, not reached. Their own clients therefore measure the
arm once, at an episode's first request, and send the pose of the last predicted row from then on (``closed_loop``).

Source: 2toinf/X-VLA, models/modeling_xvla.py, evaluation/libero/libero_client.py, evaluation/simpler/WidowX/client.py.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from roboxim_core.errors import ConfigError, InvalidRequestError
from roboxim_core.limits import echo
from roboxim_core.policies import EpisodeStart
from roboxim_policies.wires.arrays import rows_of
from roboxim_policies.wires.base import RECONNECT_S, TIMEOUT_S, WIRES, Answer, Request
from roboxim_policies.wires.errors import Deadline, fault, invalid, quoted
from roboxim_policies.wires.openvla import OpenVlaWire, decode, encode
from roboxim_policies.wires.parts import parts_of

KEY, PROPRIO = "action", "proprio"


@WIRES.register("xvla")
class XVlaWire(OpenVlaWire):
    """A session with X-VLA's own server. Each request opens a connection."""

    schemes: ClassVar[tuple[str, ...]] = ("http", "https")

    def __init__(
        self, url: str, *, timeout_s: float = TIMEOUT_S, reconnect_s: float = RECONNECT_S, key_env: str = "",
        closed_loop: int = 9,
    ) -> None:  # fmt: skip
        """Describe the server without connecting to it.

        Args:
            url: Its address, e.g. ``http://127.0.0.1:8000``.
            timeout_s: Deadline of each operation [s].
            reconnect_s: Time in which a refused connection is tried again [s].
            key_env: Not used by this protocol.
            closed_loop: Count of the first numbers of ``proprio`` that are those of the last answer's last row, from an
                episode's second request on: 9 for LIBERO (position and rotation), 10 for Bridge (and the gripper), 0:
                always measured.

        Raises:
            ConfigError: On a wrong argument.
        """
        super().__init__(url, timeout_s=timeout_s, reconnect_s=reconnect_s, key_env=key_env)
        if isinstance(closed_loop, bool) or not 0 <= closed_loop <= 20:
            raise ConfigError(f"closed_loop must be from 0 to 20, got {closed_loop}")
        self._closed_loop = closed_loop
        self._proprio: np.ndarray[Any, Any] | None = None

    def _begin(self, start: EpisodeStart, deadline: Deadline) -> None:
        self._proprio = None

    def _ask(self, request: Request, deadline: Deadline) -> Answer:
        parts = parts_of(request, self.prompt_key)
        if set(parts.numbers) != {PROPRIO}:
            raise InvalidRequestError(
                f"{self.server} takes one state, '{PROPRIO}'; the convention sends {', '.join(parts.numbers) or 'none'}"
            )
        if self._proprio is None or not self._closed_loop:
            self._proprio = np.array(parts.numbers[PROPRIO], dtype=np.float64)
        arrays = {**parts.images, PROPRIO: self._proprio}
        message = {key: encode(value).decode() for key, value in arrays.items()}
        reply = decode(self._post(encode({**message, self.prompt_key: parts.text, **parts.extras}), deadline))
        if not isinstance(reply, dict) or KEY not in reply:
            raise fault(f"{self.server} answered without '{KEY}': {quoted(echo(reply))}")
        rows = rows_of(reply[KEY], f"the actions of {self.server}")
        if self._closed_loop > min(rows.shape[1], len(self._proprio)):
            raise invalid(f"{self.server} answered rows of {rows.shape[1]} numbers, closed_loop is {self._closed_loop}")
        self._proprio[: self._closed_loop] = rows[-1, : self._closed_loop]
        return {KEY: rows}
