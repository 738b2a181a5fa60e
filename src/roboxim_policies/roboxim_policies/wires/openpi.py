"""The wire of openpi, the de facto standard, and of two servers that share its encoding: RoboArena and StarVLA.

The server sends the first message: a MessagePack map, its metadata. Then each request has one reply. An error is a text
message with a traceback. The three dialects differ in the envelope; the metadata show which one a server uses:

- **openpi**: the request itself; ``{"actions": (n, D)}``. No episodes.
- **roboarena**: the request with ``endpoint`` and ``session_id``; ``endpoint: reset`` is answered by a text. RoboXim's
  own servers (``roboxim policy serve --wire openpi``, those of Octo and RT-1-X) are of this dialect, and take the
  episode's seed as well.
- **starvla**: ``{"examples": [{"image": [...], "lang": ...}]}``; ``{"ok", "data": {"actions": (1, n, D)}}``.

Source: Physical-Intelligence/openpi@15a9616a0094, robo-arena/roboarena@6fa329fd1cab, starVLA/starVLA@0ed0aad2c83f.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Any, ClassVar

import numpy as np

from roboxim_core.errors import ConfigError, one_of
from roboxim_core.limits import echo
from roboxim_core.policies import EpisodeStart
from roboxim_policies.wires.arrays import array_from, checked_dtype, rows_of
from roboxim_policies.wires.base import (
    RECONNECT_S,
    TIMEOUT_S,
    WIRES,
    Answer,
    Metadata,
    Request,
    plain_metadata,
)
from roboxim_policies.wires.errors import Deadline, fault, invalid, quoted, unreadable
from roboxim_policies.wires.packing import pack, unpack
from roboxim_policies.wires.parts import parts_of
from roboxim_policies.wires.websocket import WebSocket, WebSocketWire

OWN_SERVER = "roboxim"
"""Key of the metadata by which RoboXim's own server is known."""


RESET = "reset successful"
"""What the genuine server and RoboXim's own reply to a reset."""


class Dialect(StrEnum):
    """Envelope of requests and replies."""

    OPENPI = "openpi"
    ROBOARENA = "roboarena"
    STARVLA = "starvla"


def encode_array(array: np.ndarray[Any, Any]) -> dict[bytes, Any]:
    """Return openpi's form of an array; the keys are bytes."""
    array = np.ascontiguousarray(array).reshape(array.shape)
    return {b"__ndarray__": True, b"data": array.data, b"dtype": array.dtype.str, b"shape": array.shape}


def decode_map(part: dict[Any, Any]) -> Any:
    """Return the array or the number that a map describes, or the map.

    Raises:
        PolicyError: When the array's parts do not fit each other.
    """
    if part.get(b"__ndarray__"):
        return array_from(part.get(b"data"), part.get(b"dtype"), part.get(b"shape"))
    if part.get(b"__npgeneric__"):
        number = part.get(b"data")
        if not isinstance(number, bool | int | float):
            kind = echo(part.get(b"dtype"))
            raise unreadable(f"'data' of a NumPy scalar of type {kind} must be a number, got {echo(number)}")
        return checked_dtype(part.get(b"dtype")).type(number)
    return part


def encode(message: Any) -> bytes:
    """Encode a message."""
    return pack(message, encode_array)


def decode(data: bytes) -> Any:
    """Decode a message.

    Raises:
        PolicyError: ``POLICY_FAULT`` when it is damaged or exceeds the bounds.
    """
    return unpack(data, decode_map)


def dialect_of(metadata: Metadata) -> Dialect:
    """Tell the dialect of a server by its metadata."""
    if "needs_session_id" in metadata or "action_space" in metadata or OWN_SERVER in metadata:
        return Dialect.ROBOARENA
    if "available_unnorm_keys" in metadata or "action_chunk_size" in metadata:
        return Dialect.STARVLA
    return Dialect.OPENPI


@WIRES.register("openpi")
class OpenPiWire(WebSocketWire):
    """A session with a server of openpi, RoboArena or StarVLA, or with one of RoboXim's own."""

    takes_key: ClassVar[bool] = True

    def __init__(
        self, url: str, *, timeout_s: float = TIMEOUT_S, reconnect_s: float = RECONNECT_S, key_env: str = "",
        dialect: str = "", unnorm_key: str = "", do_sample: bool = False, use_ddim: bool = True,
        num_ddim_steps: int = 10,
    ) -> None:  # fmt: skip
        """Describe the server without connecting to it.

        Args:
            url: Its address, e.g. ``ws://127.0.0.1:8000``.
            timeout_s: Deadline of each operation [s].
            reconnect_s: Time in which a refused connection is tried again [s].
            key_env: Environment variable with the key, sent as ``Authorization: Api-Key``.
            dialect: ``openpi``, ``roboarena`` or ``starvla``; empty: as the metadata state.
            unnorm_key: Dataset whose statistics StarVLA un-normalises with; empty: the server's only one.
            do_sample: Whether StarVLA samples words instead of taking the likeliest.
            use_ddim: Whether StarVLA's diffusion heads take DDIM's steps, as its own clients ask.
            num_ddim_steps: Number of these steps.

        Raises:
            ConfigError: On a wrong argument.
        """
        super().__init__(url, timeout_s=timeout_s, reconnect_s=reconnect_s, key_env=key_env)
        if dialect and dialect not in list(Dialect):
            raise ConfigError(f"unknown dialect '{dialect}'; {one_of(list(Dialect), dialect)}")
        self._asked_dialect = dialect
        self._unnorm_key = unnorm_key
        if isinstance(num_ddim_steps, bool) or not 1 <= num_ddim_steps <= 1_000:
            raise ConfigError(f"num_ddim_steps must be from 1 to 1000, got {num_ddim_steps}")
        self._sampling = {"do_sample": do_sample, "use_ddim": use_ddim, "num_ddim_steps": num_ddim_steps}
        self._dialect = Dialect.OPENPI
        self._session = ""

    def _open(self, deadline: Deadline) -> Metadata:
        headers = {"Authorization": f"Api-Key {self.key}"} if self.key else {}
        self._socket = WebSocket(self.url, self.server, deadline, headers)
        metadata = plain_metadata(self._message(deadline, "metadata"))
        self._dialect = Dialect(self._asked_dialect) if self._asked_dialect else dialect_of(metadata)
        if self._dialect == Dialect.STARVLA:
            self._check_unnorm_key(metadata)
        return metadata

    def _check_unnorm_key(self, metadata: Metadata) -> None:
        keys = [str(key) for key in metadata.get("available_unnorm_keys") or ()]
        if not self._unnorm_key and len(keys) == 1:
            return
        if self._unnorm_key not in keys:
            raise fault(
                f"{self.server} un-normalises with the statistics of one of its datasets; name it with unnorm_key, "
                f"{one_of(keys, self._unnorm_key)}"
            )

    def _begin(self, start: EpisodeStart, deadline: Deadline) -> None:
        connection = self._connection()
        connection.require_silence()
        self._session = start.episode_id
        if self._dialect != Dialect.ROBOARENA:
            return
        request: dict[str, Any] = {"session_id": self._session, "endpoint": "reset"}
        metadata = self._metadata or {}
        is_own = OWN_SERVER in metadata or metadata.get("takes_seed") is True
        if is_own:
            request |= {"prompt": start.instruction, "seed": start.seed}
        connection.send(encode(request), deadline)
        reply = connection.receive(deadline, "answer to the reset")
        text = reply if isinstance(reply, str) else decode(reply)
        if isinstance(text, str) and (text != RESET if is_own else text.startswith("Traceback")):
            raise fault(f"{self.server} could not reset: {quoted(text)}")

    def _ask(self, request: Request, deadline: Deadline) -> Answer:
        connection = self._connection()
        connection.require_silence()
        connection.send(encode(self._enveloped(request)), deadline)
        return self._actions(self._message(deadline, "reply"))

    def _enveloped(self, request: Request) -> dict[str, Any]:
        if self._dialect == Dialect.OPENPI:
            return dict(request)
        if self._dialect == Dialect.ROBOARENA:
            return {**request, "session_id": self._session, "endpoint": "infer"}
        parts = parts_of(request, self.prompt_key)
        example: dict[str, Any] = {"image": list(parts.images.values()), "lang": parts.text}
        if parts.numbers:
            example["state"] = np.concatenate([np.ravel(value) for value in parts.numbers.values()])[None].astype("<f4")
        keyed = {"unnorm_key": self._unnorm_key} if self._unnorm_key else {}
        return {"examples": [example], **self._sampling, **parts.extras, **keyed}

    def _actions(self, reply: Any) -> Answer:
        if self._dialect == Dialect.STARVLA and isinstance(reply, dict):
            if reply.get("ok") is not True:
                error = reply.get("error")
                text = error.get("message") if isinstance(error, dict) else error
                raise fault(f"{self.server} reported an error: {quoted(text)}")
            reply = reply.get("data")
        if not isinstance(reply, dict):
            reply = {"actions": reply}
        found = {}
        for key in self.action_keys:
            if key not in reply:
                raise invalid(f"{self.server} answered without '{key}', only with {echo(sorted(map(str, reply)))}")
            found[key] = rows_of(reply[key], f"'{key}' of {self.server}")
        return found

    def _message(self, deadline: Deadline, what: str) -> Any:
        message = self._connection().receive(deadline, what)
        if isinstance(message, str):
            raise fault(f"{self.server} reported an error instead of its {what}: {quoted(message)}")
        return decode(message)
