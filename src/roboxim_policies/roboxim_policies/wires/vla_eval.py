"""The wire of vla-eval's model servers (allenai/vla-evaluation-harness, PyPI vla-eval 0.8.0).

Every message is a MessagePack map ``{"type", "payload", "seq", "timestamp"}``. After a greeting of both sides,
``episode_start`` begins an episode without a reply, and each ``observation`` is answered by an ``action`` with its
``seq``. An ``error`` leaves the connection open; that of ``episode_start`` comes with the ``seq`` of that message. The
server usually keeps the chunk of actions, so that it is called at every tick.

Source: allenai/vla-evaluation-harness@e1ee9adf6439, src/vla_eval/protocol, connection.py.
"""

from __future__ import annotations

import io
import time
from collections.abc import Collection
from typing import Any

import numpy as np

from roboxim_core.errors import ConfigError, InvalidRequestError
from roboxim_core.limits import echo
from roboxim_core.policies import EpisodeStart
from roboxim_policies.wires.arrays import MESSAGE_BYTES, array_from, checked_shape, rows_of
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
from roboxim_policies.wires.parts import last_part, parts_of
from roboxim_policies.wires.websocket import WebSocket, WebSocketWire

HARNESS_VERSION = "0.8.0"
PROTOCOL_VERSION = 1
FORMATS = ("raw", "png")
CONTROLLER_STATES = "controller_states"
"""Key of a state that is sent beside ``states``: measured in the controller's frame. X-VLA's server prefers it."""


def encode_array(array: np.ndarray[Any, Any]) -> dict[str, Any]:
    """Return vla-eval's form of an array, pictures included: a picture as an array is accepted as well."""
    array = np.ascontiguousarray(array).reshape(array.shape)
    return {"__ndarray__": True, "data": array.data, "dtype": array.dtype.str, "shape": array.shape}


def encode_array_or_png(array: np.ndarray[Any, Any]) -> dict[str, Any]:
    """Return vla-eval's form of an array; a picture becomes a PNG file."""
    if array.dtype != np.uint8 or array.ndim != 3 or array.shape[2] not in (1, 3, 4):
        return encode_array(array)
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(array[..., 0] if array.shape[2] == 1 else array).save(file, "PNG", compress_level=1)
    return {"__image__": True, "format": "png", "data": file.getvalue(), "shape": array.shape}


def decode_map(part: dict[Any, Any]) -> Any:
    """Return the array or the picture that a map describes, or the map.

    Raises:
        PolicyError: When its parts do not fit each other.
    """
    if part.get("__ndarray__"):
        return array_from(part.get("data"), part.get("dtype"), part.get("shape"))
    if part.get("__image__"):
        return _picture(part)
    return part


def _picture(part: dict[Any, Any]) -> np.ndarray[Any, Any]:
    shape, data = checked_shape(part.get("shape")), part.get("data")
    if part.get("format") == "raw":
        return array_from(data, "|u1", shape)
    if part.get("format") not in ("png", "jpeg") or not isinstance(data, bytes) or len(shape) != 3:
        raise unreadable(f"a picture must be raw, png or jpeg bytes with three sizes, got {echo(part.get('format'))}")
    if shape[0] * shape[1] * shape[2] > MESSAGE_BYTES:
        raise unreadable(f"a picture of shape {list(shape)} is larger than {MESSAGE_BYTES} bytes")
    from PIL import Image

    modes = {1: "L", 3: "RGB", 4: "RGBA"}
    try:
        with Image.open(io.BytesIO(data), formats=[part["format"].upper()]) as image:
            if image.size != (shape[1], shape[0]) or shape[2] not in modes:  # the header, before the pixels are made
                raise unreadable(f"a picture says shape {list(shape)}, its file {image.size}")
            return np.asarray(image.convert(modes[shape[2]])).reshape(shape)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise unreadable(f"a picture is damaged: {error}") from None


def encode(message: Any, image_format: str = "raw") -> bytes:
    """Encode a message.

    Args:
        message: The message.
        image_format: How pictures are sent: ``raw`` or ``png``.
    """
    return pack(message, encode_array_or_png if image_format == "png" else encode_array)


def decode(data: bytes) -> Any:
    """Decode a message.

    Raises:
        PolicyError: ``POLICY_FAULT`` when it is damaged or exceeds the bounds.
    """
    return unpack(data, decode_map)


def observation(request: Request, prompt_key: str, *, leave_out: Collection[str] = ()) -> dict[str, Any]:
    """Return a request as vla-eval's observation.

    Args:
        request: The request.
        prompt_key: Key of the instruction.
        leave_out: ``send_wrist_image`` and ``send_state`` leave these parts out.
    """
    parts = parts_of(request, prompt_key)
    sent = [key for key in parts.images if not ("send_wrist_image" in leave_out and "wrist" in key)]
    images = {last_part(key): parts.images[key] for key in sent}
    if len(images) < len(sent):
        raise InvalidRequestError(
            f"this wire sends the last parts of keys alone, and images have equal ones: {', '.join(sent)}; rename them "
            "in the convention"
        )
    payload: dict[str, Any] = {"images": images, "task_description": parts.text, **parts.extras}
    if parts.numbers and "send_state" not in leave_out:
        controller = {key: value for key, value in parts.numbers.items() if last_part(key) == CONTROLLER_STATES}
        states = [np.ravel(value) for key, value in parts.numbers.items() if key not in controller]
        if states:
            payload["states"] = np.concatenate(states).astype("<f4")
        for value in controller.values():
            payload[CONTROLLER_STATES] = np.ravel(value).astype("<f4")
    return payload


@WIRES.register("vla_eval")
class VlaEvalWire(WebSocketWire):
    """A session with a model server of vla-eval."""

    def __init__(
        self, url: str, *, timeout_s: float = TIMEOUT_S, reconnect_s: float = RECONNECT_S, key_env: str = "",
        image_format: str = "raw", ignore: str = "",
    ) -> None:  # fmt: skip
        """Describe the server without connecting to it.

        Args:
            url: Its address, e.g. ``ws://127.0.0.1:8000``.
            timeout_s: Deadline of each operation [s].
            reconnect_s: Time in which a refused connection is tried again [s].
            key_env: Not used by this protocol.
            image_format: How pictures are sent: ``raw``, the fastest, or ``png``, smaller.
            ignore: Names of what the server declares that do not change what its numbers mean, separated by spaces;
                RoboXim refuses what it does not understand.

        Raises:
            ConfigError: On a wrong argument.
        """
        super().__init__(url, timeout_s=timeout_s, reconnect_s=reconnect_s, key_env=key_env)
        if image_format not in FORMATS:
            raise ConfigError(f"image_format must be 'raw' or 'png', got '{image_format}'")
        self._image_format = image_format
        self.ignored = tuple(str(ignore).split())
        self._seq = 0
        self._began = 0
        self._steps: int | None = None
        self._leave_out: tuple[str, ...] = ()

    def _open(self, deadline: Deadline) -> Metadata:
        self._socket = WebSocket(self.url, self.server, deadline)
        self._seq, self._steps = 0, None
        seq = self._send(
            "hello",
            {"harness_version": HARNESS_VERSION, "protocol_version": PROTOCOL_VERSION, "benchmark": "RoboXim"},
            deadline,
        )
        metadata = plain_metadata(self._reply("hello", seq, deadline))
        if (version := metadata.get("protocol_version")) != PROTOCOL_VERSION:
            raise fault(f"{self.server} speaks version {echo(version)} of the protocol, RoboXim {PROTOCOL_VERSION}")
        wanted = metadata.get("observation_params")
        wanted = wanted if isinstance(wanted, dict) else {}
        self._leave_out = tuple(name for name in ("send_wrist_image", "send_state") if wanted.get(name) is False)
        return metadata

    def _begin(self, start: EpisodeStart, deadline: Deadline) -> None:
        self._connection().require_silence()
        if self._steps is not None:  # the episode before, on the same connection
            self._send("episode_end", {"metrics": {}, "steps": self._steps, "elapsed_sec": 0.0}, deadline)
        self._steps = 0
        task = {"name": start.instruction, "episode_id": start.episode_id, "seed": start.seed}
        self._began = self._send("episode_start", {"task": task}, deadline)

    def _ask(self, request: Request, deadline: Deadline) -> Answer:
        payload = observation(request, self.prompt_key, leave_out=self._leave_out)
        reply = self._reply("action", self._send("observation", payload, deadline), deadline)
        self._steps = (self._steps or 0) + 1
        if "actions" not in reply:
            raise invalid(f"{self.server} answered without 'actions', only with {echo(sorted(map(str, reply)))}")
        return {"actions": rows_of(reply["actions"], f"the actions of {self.server}")}

    def _send(self, kind: str, payload: dict[str, Any], deadline: Deadline) -> int:
        self._seq += 1
        message = {"type": kind, "payload": payload, "seq": self._seq, "timestamp": time.time()}
        self._connection().send(encode(message, self._image_format), deadline)
        return self._seq

    def _reply(self, kind: str, seq: int, deadline: Deadline) -> dict[str, Any]:
        data = self._connection().receive(deadline)
        if isinstance(data, str):
            raise fault(f"{self.server} sent a text where MessagePack is due: {quoted(data)}")
        message = decode(data)
        if not isinstance(message, dict) or not isinstance(payload := message.get("payload"), dict):
            raise unreadable("it must be a map with type, payload and seq")
        if message.get("type") == "error":
            begun = message.get("seq") == self._began and self._began
            when = "could not begin the episode" if begun else "reported an error"
            raise fault(f"{self.server} {when}: {quoted(payload.get('error'))}")
        if message.get("seq") != seq:
            raise fault(
                f"{self.server} answered message {echo(message.get('seq'))} when the reply to message {seq} was due: "
                "it is stale and is not used"
            )
        if message.get("type") != kind:
            raise fault(f"{self.server} answered with '{echo(message.get('type'))}', expected '{kind}'")
        return payload
