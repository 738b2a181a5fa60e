"""The wire of Isaac-GR00T, N1.5 (from August 2025) to N1.7: ZeroMQ, one request and one reply at a time.

The servers of these versions have three serialisers. The reply to ``get_modality_config``, which has no arrays, shows
which one a server has:

| server | marker of a configuration | its ``as_json`` | arrays | call |
| --- | --- | --- | --- | --- |
| N1.5 from 029b2dfbe40d | ``__ModalityConfig_class__`` | a text | ``.npy`` | flat |
| N1.6 (4e62473d5226), N1.7 (23ace64f) | the same | a map | ``.npy`` | groups |
| N1.7 from May 2026 | ``__ModalityConfig__`` | a map | msgpack-numpy | groups |

A server that was started with ``--use-sim-policy-wrapper``, as the examples of N1.6 and N1.7 do, has the same
configuration but takes flat keys (``video.image``, ``state.x``) with a batch axis, and answers ``action.x``.

N1 and the first N1.5 exchange pickles; they are recognised and refused. ``kill``, which stops a server, is never sent.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from roboxim_core.errors import InvalidRequestError, PolicyError
from roboxim_core.limits import echo
from roboxim_core.policies import EpisodeStart
from roboxim_policies.wires.arrays import MESSAGE_BYTES, array_from, array_from_npy, checked_dtype, npy_bytes, rows_of
from roboxim_policies.wires.base import (
    RECONNECT_S,
    REFUSED,
    TIMEOUT_S,
    WIRES,
    Answer,
    Metadata,
    Request,
    Wire,
    plain_metadata,
)
from roboxim_policies.wires.errors import Deadline, died, fault, invalid, quoted, unreadable
from roboxim_policies.wires.packing import pack, unpack
from roboxim_policies.wires.parts import Parts, last_part, named, parts_of

if TYPE_CHECKING:
    import zmq

CONFIG_MARKERS = ("__ModalityConfig_class__", "__ModalityConfig__")
WANTS_FLAT_KEYS = ("Video key 'video.", "State key 'state.")
"""How a server with ``--use-sim-policy-wrapper`` begins to complain of observations in groups.
Source: NVIDIA/Isaac-GR00T, gr00t/policy/gr00t_policy.py, Gr00tSimPolicyWrapper.check_observation."""
PICKLES = (b"PK\x03\x04", b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05", b"ERROR")
"""How the replies of the first servers begin: torch.save archives, pickles, and their one error."""


@dataclass(frozen=True, kw_only=True)
class Serialiser:
    """How a version of the server writes arrays and calls."""

    name: str
    """Versions that use it, for messages and records."""
    npy: bool
    """Whether arrays are ``.npy`` bytes, else msgpack-numpy's maps."""
    flat: bool
    """Whether observations have flat keys without a batch axis."""

    def encode(self, message: Any) -> bytes:
        """Encode a message."""
        return pack(message, _as_npy if self.npy else _as_map)

    def decode(self, data: bytes) -> Any:
        """Decode a message; arrays of another serialiser are an error.

        Raises:
            PolicyError: ``POLICY_FAULT`` when it is damaged, exceeds the bounds, or is of another serialiser.
        """
        return unpack(data, self._decode_map)

    def _decode_map(self, part: dict[Any, Any]) -> Any:
        if "__ndarray_class__" in part:
            self._require(self.npy)
            return array_from_npy(part.get("as_npy"))
        if b"nd" in part:
            self._require(not self.npy)
            if part.get(b"kind") not in (b"", "", None):
                raise unreadable(f"an array of kind {echo(part.get(b'kind'))} is no array of numbers")
            if part[b"nd"]:
                return array_from(part.get(b"data"), part.get(b"type"), part.get(b"shape"))
            data, kind = part.get(b"data"), checked_dtype(part.get(b"type"))
            return array_from(data, kind.str, [])[()]
        if any(marker in part for marker in CONFIG_MARKERS):
            return _config(part.get("as_json"))
        return part

    def _require(self, matches: bool) -> None:
        if not matches:
            raise unreadable(
                f"its arrays are of another serialiser than that of {self.name}, which the server declared"
            )


N15 = Serialiser(name="N1.5", npy=True, flat=True)
N16 = Serialiser(name="N1.6 and early N1.7", npy=True, flat=False)
N17 = Serialiser(name="N1.7 from May 2026", npy=False, flat=False)


def _as_npy(array: np.ndarray[Any, Any]) -> dict[str, Any]:
    return {"__ndarray_class__": True, "as_npy": npy_bytes(array)}


def _as_map(array: np.ndarray[Any, Any]) -> dict[bytes, Any]:
    array = np.ascontiguousarray(array).reshape(array.shape)
    return {b"nd": True, b"type": array.dtype.str, b"kind": b"", b"shape": array.shape, b"data": array.data}


def _config(value: Any) -> Any:
    if isinstance(value, str):
        try:
            value = json.loads(value)
        except (ValueError, RecursionError) as error:
            raise unreadable(f"a modality's configuration is not JSON: {error}") from None
    if not isinstance(value, dict):
        raise unreadable(f"a modality's configuration must be a map, got {type(value).__name__}")
    return value


def reported(server: str, error: Any) -> PolicyError:
    """Return the error that a server reported, with what to do about a wrong token."""
    text = quoted(error)
    hint = "; pass the server's token with key_env" if "nauthorized" in text else ""
    return fault(f"{server} reported an error: {text}{hint}")


def serialiser_of(reply: bytes) -> Serialiser:
    """Tell a server's serialiser by its reply to ``get_modality_config``.

    Raises:
        PolicyError: ``POLICY_FAULT`` when the server speaks pickle, or none of the known ones.
    """
    if reply.startswith(PICKLES):
        raise fault(f"the server does not speak MessagePack; {REFUSED['groot_n1']}")
    found: set[tuple[str, str]] = set()

    def look(part: dict[Any, Any]) -> Any:
        for marker in CONFIG_MARKERS:
            if marker in part:
                found.add((marker, type(part.get("as_json")).__name__))
        return part

    value = unpack(reply, look)
    if isinstance(value, dict) and "error" in value:
        raise reported("the server", value["error"])
    known = {(CONFIG_MARKERS[0], "str"): N15, (CONFIG_MARKERS[0], "dict"): N16, (CONFIG_MARKERS[1], "dict"): N17}
    if len(found) != 1 or next(iter(found)) not in known:
        raise fault("the server's serialiser is unknown: its modality configuration has none of the known markers")
    return known[found.pop()]


@WIRES.register("groot")
class GrootWire(Wire):
    """A session with a server of Isaac-GR00T. It has one client at a time: workers queue."""

    schemes: ClassVar[tuple[str, ...]] = ("tcp",)
    port: ClassVar[int] = 5555
    takes_key: ClassVar[bool] = True

    def __init__(
        self, url: str, *, timeout_s: float = TIMEOUT_S, reconnect_s: float = RECONNECT_S, key_env: str = "",
        sim_policy_wrapper: bool = False,
    ) -> None:  # fmt: skip
        """Describe the server without connecting to it.

        Args:
            url: Its address, e.g. ``tcp://127.0.0.1:5555``.
            timeout_s: Deadline of each operation [s].
            reconnect_s: Time in which a refused connection is tried again [s].
            key_env: Environment variable with the key, sent as ``api_token``.
            sim_policy_wrapper: Whether the server (N1.6 or later) runs with ``--use-sim-policy-wrapper``. It is
                optional: a server that requires flat keys gets them.

        Raises:
            ConfigError: On a wrong argument.
        """
        super().__init__(url, timeout_s=timeout_s, reconnect_s=reconnect_s, key_env=key_env)
        self._wrapped = sim_policy_wrapper
        self._serialiser = N16
        self._keys: dict[str, list[str]] = {}
        self._deltas: dict[str, list[int]] = {}
        self._connection: _Connection | None = None

    def _open(self, deadline: Deadline) -> Metadata:
        self._connection = _Connection(self.url, self.server, deadline)
        reply = self._connection.exchange(self._message("get_modality_config", None, N16), deadline)
        self._serialiser = serialiser_of(reply)
        config = self._serialiser.decode(reply)
        if not isinstance(config, dict) or not all(isinstance(item, dict) for item in config.values()):
            raise unreadable("the modality configuration must be a map of maps")
        for group in ("video", "state", "action", "language"):
            item = config.get(group, {})
            keys, indices = item.get("modality_keys", []), item.get("delta_indices", [0])
            if not isinstance(keys, list) or not all(isinstance(key, str) for key in keys):
                raise unreadable(f"the modality keys of {group} must be a list of texts")
            self._keys[group] = keys
            whole = isinstance(indices, list) and indices and all(isinstance(index, int) for index in indices)
            self._deltas[group] = indices if whole else [0]
        if not self._keys["action"]:
            raise fault(f"{self.server} declares no actions")
        return plain_metadata({"serialiser": self._serialiser.name, "modality_config": config})

    def _alive(self) -> bool:
        return self._connection is not None and self._connection.alive()

    def _begin(self, start: EpisodeStart, deadline: Deadline) -> None:
        if self._serialiser.flat:
            self._call("ping", None, deadline)
        else:
            self._call("reset", {"options": None}, deadline)

    def _ask(self, request: Request, deadline: Deadline) -> Answer:
        try:
            reply = self._call("get_action", self._observation(request), deadline)
        except PolicyError as error:
            if self._wrapped or self._serialiser.flat or not any(text in str(error) for text in WANTS_FLAT_KEYS):
                raise
            self._wrapped = True  # its configuration does not show it; its complaint does
            reply = self._call("get_action", self._observation(request), deadline)
        if isinstance(reply, list) and reply:
            reply = reply[0]
        if not isinstance(reply, dict):
            raise invalid(f"{self.server} answered without actions, with {type(reply).__name__}")
        return self._columns({last_part(str(key)): value for key, value in reply.items()})

    def _observation(self, request: Request) -> dict[str, Any]:
        parts = parts_of(request, self.prompt_key)
        batch = () if self._serialiser.flat else (None,)
        number = np.float64 if self._serialiser.flat else np.float32
        video = {
            key: _framed(image, 4, self._deltas["video"], key)[batch]
            for key, image in self._chosen("video", parts).items()
        }
        state = {
            key: _framed(np.asarray(value, number), 2, self._deltas["state"], key)[batch]
            for key, value in self._chosen("state", parts).items()
        }
        texts = [parts.text]
        if self._serialiser.flat:
            return {**video, **state, **dict.fromkeys(self._keys["language"], texts)}
        if self._wrapped:
            flat = {f"video.{key}": value for key, value in video.items()}
            flat |= {f"state.{key}": value for key, value in state.items()}
            return {"observation": {**flat, **dict.fromkeys(self._keys["language"], texts)}, "options": None}
        language = dict.fromkeys(self._keys["language"], [texts])
        return {"observation": {"video": video, "state": state, "language": language}, "options": None}

    def _chosen(self, group: str, parts: Parts) -> dict[str, np.ndarray[Any, Any]]:
        """Return the request's arrays under the server's keys."""
        given = parts.images if group == "video" else parts.numbers
        found = {key: named(key, given) for key in self._keys[group]}
        wrong = [key for key, names in found.items() if len(names) != 1]
        if wrong:
            raise InvalidRequestError(
                f"{self.server} needs the {group} keys {', '.join(wrong)}; the convention sends "
                f"{', '.join(given) or 'none'}. Give its entries the server's keys, each once"
            )
        return {key: given[names[0]] for key, names in found.items()}

    def _columns(self, actions: dict[str, Any]) -> Answer:
        """Return the actions of all declared keys, in the declared order."""
        columns: Answer = {}
        for key in self._keys["action"]:
            name = last_part(key)
            value = actions.get(name)
            if not isinstance(value, np.ndarray):
                raise invalid(
                    f"{self.server} answered without the action '{key}', only with {', '.join(actions)[:300]}"
                )
            value = value[0] if value.ndim == 3 and value.shape[0] == 1 else value
            columns[name] = rows_of(value[:, None] if value.ndim == 1 else value, f"action '{key}'")
        if len({len(column) for column in columns.values()}) > 1:
            lengths = {name: len(column) for name, column in columns.items()}
            raise invalid(f"{self.server} answered actions of different lengths: {lengths}")
        return columns

    def _call(self, endpoint: str, data: Any, deadline: Deadline) -> Any:
        assert self._connection is not None
        reply = self._connection.exchange(self._message(endpoint, data, self._serialiser), deadline)
        value = self._serialiser.decode(reply)
        if isinstance(value, dict) and "error" in value:
            raise reported(self.server, value["error"])
        return value

    def _message(self, endpoint: str, data: Any, serialiser: Serialiser) -> bytes:
        message: dict[str, Any] = {"endpoint": endpoint}
        if data is not None:
            message["data"] = data
        if self.key:
            message["api_token"] = self.key
        return serialiser.encode(message)

    def _shut(self) -> None:
        if self._connection is not None:
            self._connection.close()
        self._connection = None


def _framed(value: np.ndarray[Any, Any], axes: int, deltas: list[int], key: str) -> np.ndarray[Any, Any]:
    """Return the frames that a server wants, with an axis of time in front.

    Args:
        value: One frame, or a window of frames, the newest last.
        axes: Number of axes with that of time.
        deltas: Ticks of the wanted frames relative to the newest, e.g. ``[-15, 0]``.
        key: Key, for messages.

    Raises:
        InvalidRequestError: When the window does not reach back so far.
    """
    value = value[None] if value.ndim == axes - 1 else value
    places = [len(value) - 1 + delta for delta in deltas]
    if value.ndim != axes or min(places) < 0 or max(deltas) > 0:
        raise InvalidRequestError(
            f"'{key}' must have the frames {deltas} (0: the newest) in an array of {axes} axes, the convention gives "
            f"shape {value.shape}; its window must be {1 - min(deltas)}"
        )
    return value[places]


class _Connection:
    """A ZeroMQ REQ socket of its own context, with a monitor that reports a lost connection at once."""

    def __init__(self, url: str, server: str, deadline: Deadline) -> None:
        import zmq

        self._server = server
        self._context = zmq.Context()
        self._socket: zmq.Socket[bytes] = self._context.socket(zmq.REQ)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.MAXMSGSIZE, MESSAGE_BYTES)
        self._socket.setsockopt(zmq.RECONNECT_IVL, -1)
        events = zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_DISCONNECTED | zmq.EVENT_CLOSED | zmq.EVENT_CONNECT_RETRIED
        events |= zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
        self._monitor = self._socket.get_monitor_socket(events)
        try:
            self._socket.connect(url)
            if not self._monitor.poll(deadline.left_ms(server)):
                raise deadline.passed(f"the connection to {server}")
            if not self._connected():
                raise died(f"{server} cannot be reached: the connection was refused or closed; start the server")
        except zmq.ZMQError as error:
            self.close()
            raise died(f"{server} cannot be reached: {error}") from None
        except BaseException:
            self.close()
            raise

    def alive(self) -> bool:
        """Tell whether no event has reported the end of the connection."""
        return not self._monitor.poll(0)

    def exchange(self, message: bytes, deadline: Deadline) -> bytes:
        """Send a message and return the reply."""
        import zmq

        what = f"the reply of {self._server}"
        try:
            if not self._socket.poll(deadline.left_ms(what), zmq.POLLOUT):
                raise deadline.passed(what)
            self._socket.send(message)
            poller = zmq.Poller()
            poller.register(self._socket, zmq.POLLIN)
            poller.register(self._monitor, zmq.POLLIN)
            ready = dict(poller.poll(deadline.left_ms(what)))
            if self._socket in ready:
                return self._socket.recv()
        except zmq.ZMQError as error:
            raise died(f"the connection to {self._server} failed: {error}") from None
        if self._monitor in ready:
            raise died(
                f"the connection to {self._server} was lost before its reply: the server ended, or its reply had "
                f"more than {MESSAGE_BYTES} bytes"
            )
        raise deadline.passed(what)

    def _connected(self) -> bool:
        import zmq
        from zmq.utils.monitor import recv_monitor_message

        return recv_monitor_message(self._monitor)["event"] == zmq.EVENT_HANDSHAKE_SUCCEEDED

    def close(self) -> None:
        """Close sockets and context."""
        self._socket.disable_monitor()
        self._monitor.close(0)
        self._socket.close(0)
        self._context.term()
