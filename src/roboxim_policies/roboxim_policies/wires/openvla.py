"""The wire of OpenVLA and OpenVLA-OFT: ``POST /act`` with JSON in which arrays are base64 (json_numpy).

A request is the map itself, or ``{"encoded": "<that JSON>"}``, and then the reply is a JSON text of JSON. OpenVLA
answers with an array, OFT with a list of arrays. **Every error of the model has HTTP status 200 and the body
``"error"``**, a wrong ``unnorm_key`` included. There are no metadata, sessions or keys, so the server's model cannot be
verified. RoboXim's own server (``roboxim policy serve --wire openvla``) declares itself under another path, which the
genuine ones do not have.

Source: openvla/openvla@c8f03f48af69, moojink/openvla-oft@213c5ff8d6e9, vla-scripts/deploy.py.
"""

from __future__ import annotations

import base64
import binascii
import contextlib
import http.client
import json
import secrets
import socket
import threading
from typing import Any, ClassVar
from urllib.parse import urlsplit

import numpy as np

from roboxim_core.errors import InvalidRequestError, PolicyError
from roboxim_core.limits import echo
from roboxim_policies.wires.arrays import MESSAGE_BYTES, array_from, rows_of
from roboxim_policies.wires.base import RECONNECT_S, TIMEOUT_S, WIRES, Answer, Metadata, Request, Wire, plain_metadata
from roboxim_policies.wires.errors import (
    GATEWAY,
    REDIRECTS,
    Deadline,
    died,
    fault,
    invalid,
    quoted,
    redirected,
    unreadable,
)
from roboxim_policies.wires.openpi import OWN_SERVER


def encode(message: Any, *, double: bool = False) -> bytes:
    """Encode a message as JSON.

    Args:
        message: Maps, lists, texts, numbers and arrays.
        double: Whether to put the JSON as a text under ``encoded``.

    Raises:
        InvalidRequestError: When it has a part that JSON does not carry.
    """
    text = json.dumps(message, default=_encode_part, allow_nan=False)
    return (json.dumps({"encoded": text}) if double else text).encode()


def _encode_part(part: Any) -> Any:
    if isinstance(part, np.ndarray) and part.dtype.kind in "biuf":
        data = base64.b64encode(part.tobytes()).decode()
        return {"__numpy__": data, "dtype": part.dtype.str, "shape": part.shape}
    if isinstance(part, np.bool_ | np.integer | np.floating):
        return part.item()
    raise InvalidRequestError(f"a value of type {type(part).__name__} cannot be sent to a policy server")


def decode(data: bytes | str) -> Any:
    """Decode JSON with arrays; a text that is itself such JSON is decoded once more.

    Raises:
        PolicyError: ``POLICY_FAULT`` when it is damaged.
    """
    value = _decode(data)
    if isinstance(value, str) and value[:1] in ("{", "["):
        value = _decode(value)
    if isinstance(value, dict) and set(value) == {"encoded"} and isinstance(value["encoded"], str):
        value = {"encoded": _decode(value["encoded"])}
    return value


def _decode(data: bytes | str) -> Any:
    if len(data) > MESSAGE_BYTES:
        raise unreadable(f"it has {len(data)} bytes, at most {MESSAGE_BYTES} are allowed")
    try:
        return json.loads(data, object_hook=_decode_map)
    except (ValueError, RecursionError) as error:
        raise unreadable(f"it is not valid JSON ({str(error)[:200]})") from None


def _decode_map(part: dict[str, Any]) -> Any:
    if "__numpy__" not in part:
        return part
    text = part["__numpy__"]
    if not isinstance(text, str):
        raise unreadable(f"an array's data must be base64 text, got {type(text).__name__}")
    try:
        data = base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError) as error:
        raise unreadable(f"an array's data is not base64: {error}") from None
    return array_from(data, part.get("dtype"), part.get("shape"))


DECLARATION = "/roboxim"
"""Path under which RoboXim's own server declares its convention; any other answer than a map there is of a server that
declares nothing."""


@WIRES.register("openvla")
class OpenVlaWire(Wire):
    """A session with a server of OpenVLA or OpenVLA-OFT.

    Each request opens a connection, so another server may answer the next one: the server's declaration is requested
    again at each episode.
    """

    schemes: ClassVar[tuple[str, ...]] = ("http", "https")

    def __init__(
        self, url: str, *, timeout_s: float = TIMEOUT_S, reconnect_s: float = RECONNECT_S, key_env: str = "",
        unnorm_key: str = "", double_encoding: bool = False,
    ) -> None:  # fmt: skip
        """Describe the server without connecting to it.

        Args:
            url: Its address, e.g. ``http://127.0.0.1:8000`` (OpenVLA) or ``:8777`` (OFT).
            timeout_s: Deadline of each operation [s].
            reconnect_s: Time in which a refused connection is tried again [s].
            key_env: Not used by this protocol.
            unnorm_key: Dataset whose statistics OpenVLA un-normalises with, e.g. ``bridge_orig``; empty: the model's
                only one. OFT takes it from the server's own command line.
            double_encoding: Whether to send JSON within JSON, for clients without json_numpy.

        Raises:
            ConfigError: On a wrong argument.
        """
        super().__init__(url, timeout_s=timeout_s, reconnect_s=reconnect_s, key_env=key_env)
        self._unnorm_key = unnorm_key
        self._double = double_encoding
        parts = urlsplit(self.url)
        path = parts.path.rstrip("/")
        self._host, self._path = parts.hostname or "", path if path.endswith("/act") else f"{path}/act"
        self._secure = parts.scheme == "https"
        self._port = parts.port or (443 if self._secure else self.port)
        self._client = secrets.token_hex(8)
        self._requested = False

    def _open(self, deadline: Deadline) -> Metadata:
        """Ask for the declaration of RoboXim's own server. A wrong address is found before the first episode."""
        self._requested = False
        status, data = self._exchange("GET", self._path.removesuffix("/act") + DECLARATION, b"", deadline)
        if status in GATEWAY:
            raise died(f"{self.server} cannot be reached: HTTP status {status} of a gateway before it")
        if status == 200:
            with contextlib.suppress(PolicyError):
                if isinstance(value := decode(data), dict) and OWN_SERVER in value:
                    return plain_metadata(value)
        return {}

    def _alive(self) -> bool:
        return not self._requested

    def _ask(self, request: Request, deadline: Deadline) -> Answer:
        extra: dict[str, Any] = {"unnorm_key": self._unnorm_key} if self._unnorm_key else {}
        if OWN_SERVER in request:  # one session for each client
            extra[OWN_SERVER] = {**request[OWN_SERVER], "client": self._client}
        reply = decode(self._post(encode({**request, **extra}, double=self._double), deadline))
        if isinstance(reply, str) and reply == "error":
            raise fault(
                f"{self.server} answered 'error'; see its log for the reason. Usual causes: a wrong or missing "
                "unnorm_key, keys that the model does not expect"
            )
        if isinstance(reply, str | dict):
            raise fault(f"{self.server} answered without actions: {quoted(reply)}")
        what = f"the actions of {self.server}"
        if isinstance(reply, list) and reply and all(isinstance(row, np.ndarray) for row in reply):
            if len({row.shape for row in reply}) > 1:
                raise invalid(f"{what} have different sizes: {echo([list(row.shape) for row in reply])}")
            reply = np.stack(reply)
        return {"actions": rows_of(reply, what)}

    def _post(self, body: bytes, deadline: Deadline) -> bytes:
        """Post a request; return the body of the reply.

        Raises:
            PolicyError: When the server cannot be reached, or answers another status than 200.
        """
        status, data = self._exchange("POST", self._path, body, deadline)
        if status in GATEWAY:
            raise died(f"{self.server} cannot be reached: HTTP status {status} of a gateway before it")
        if status != 200:
            raise fault(f"{self.server} answered HTTP status {status}: {quoted(data[:2000].decode(errors='replace'))}")
        return data

    def _exchange(self, method: str, path: str, body: bytes, deadline: Deadline) -> tuple[int, bytes]:
        """Send a request; return status and body of the reply, both within the deadline and the bound of a message."""
        what = f"the reply of {self.server}"
        self._requested = self._requested or method == "POST"
        connection = self._connected(deadline)
        assert connection.sock is not None
        connection.sock.settimeout(None)  # the watch ends what takes too long
        try:
            with _Watch(connection.sock, deadline.left(what)) as watch:
                headers = {"Content-Type": "application/json", "Connection": "close"}
                connection.request(method, path, body=body or None, headers=headers)
                response = connection.getresponse()
                data = self._read(response)
        except (OSError, http.client.HTTPException) as error:
            if watch.ended:
                raise deadline.passed(what) from None
            raise died(
                f"the connection to {self.server} was lost: {type(error).__name__}: {str(error)[:300]}"
            ) from None
        finally:
            connection.close()
        if watch.ended:
            raise deadline.passed(what)
        if response.status in REDIRECTS:
            raise redirected(self.server, response.status, response.getheader("Location"))
        return response.status, data

    def _read(self, response: http.client.HTTPResponse) -> bytes:
        if (response.length or 0) > MESSAGE_BYTES:
            raise unreadable(f"it announces {response.length} bytes, at most {MESSAGE_BYTES} are allowed")
        data = response.read(MESSAGE_BYTES + 1) if response.length is None else response.read()
        if len(data) > MESSAGE_BYTES:
            raise unreadable(f"it has more than {MESSAGE_BYTES} bytes")
        return data

    def _connected(self, deadline: Deadline) -> http.client.HTTPConnection:
        kind = http.client.HTTPSConnection if self._secure else http.client.HTTPConnection
        connection = kind(self._host, self._port, timeout=deadline.left(self.server))
        try:
            connection.connect()
        except TimeoutError:
            raise deadline.passed(f"the connection to {self.server}") from None
        except OSError as error:
            raise died(f"{self.server} cannot be reached: {error}; start the server, or check the url") from None
        return connection

    def _shut(self) -> None:
        pass


class _Watch:
    """Ends the reading and writing of a socket after a time, whatever the number of bytes that trickle."""

    def __init__(self, connection: socket.socket, seconds: float) -> None:
        self.ended = False
        """Whether the time was over."""
        self._connection = connection
        self._timer = threading.Timer(seconds, self._end)
        self._timer.daemon = True

    def _end(self) -> None:
        self.ended = True
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)

    def __enter__(self) -> _Watch:
        self._timer.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._timer.cancel()
        self._timer.join()
