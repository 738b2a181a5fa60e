"""Serves a model over openpi's wire, from the model's own environment.

This file imports nothing of RoboXim. It needs numpy, msgpack and websockets, and any Python from 3.10 on. Derive a
class from `Model` and call `serve`; `octo.py` and `rt1.py` beside it are two examples. On RoboXim's side:

    roboxim policy check --policy openpi --option url=ws://host:8000 --option convention=... --option version=...

The wire: WebSocket, MessagePack. The server speaks first, with a map, its metadata. Each request is one map with one
reply, ``{"actions": (n, D)}`` or the model's own keys. ``{"endpoint": "reset", "prompt", "seed"}`` begins an episode.
An error is a text message, after which the connection is closed with code 1011. No pickle is spoken.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import ipaddress
import logging
import os
import queue
import signal
import socket
import struct
import sys
import threading
import traceback
from abc import ABC, abstractmethod
from concurrent.futures import Future
from typing import Any

import msgpack
import numpy as np

MESSAGE_BYTES = 64 * 2**20
"""Largest message [bytes]."""
MAX_CONNECTIONS = 32
"""Largest number of connections at the same time."""
OTHERS = b"the server belongs to another user of the machine; its owner can start it with --all-users"
"""Answer to a connection of another user."""
ITEMS = 10_000
"""Largest number of items of a list or a map in a request; arrays are bytes."""
QUIET = logging.getLogger("openpi_server")
"""Logger for `websockets`, whose own prints a traceback for whatever connects and is no WebSocket client."""
QUIET.setLevel(logging.CRITICAL)
Request = dict  # of arrays, texts and numbers by key


class RequestError(ValueError):
    """A request that the model cannot answer; the message says why."""


class Model(ABC):
    """A model. All of its methods but `check` are called from one thread."""

    metadata: dict = {}
    """What the server says of itself. Keep ``needs_session_id``, so that RoboXim announces each episode."""
    batch: int = 1
    """Largest number of requests, of different connections, that `act` gets at once."""

    def begin(self, seed: int) -> Any:
        """Return the state of a session at the start of an episode, e.g. a history or a random key.

        Args:
            seed: Seed of the episode's own randomness.
        """
        return None

    def check(self, request: Request) -> None:  # noqa: B027 - a model that takes everything needs none
        """Refuse a request that `act` cannot answer; called in the connection's thread, before the batch is made.

        Raises:
            RequestError: When a part is missing or has another shape.
        """

    @abstractmethod
    def act(self, requests: list) -> list:
        """Return a pair (reply, new state) for each pair (request, state).

        A reply is a map of arrays by key, or the array of the actions alone. When it raises for several requests, it is
        called again for each alone.
        """


def encode(message: Any) -> bytes:
    """Encode a message; arrays as maps with the bytes keys of openpi's own packer.

    Raises:
        TypeError: When a part is neither plain data nor an array of numbers.
    """

    def default(part: Any) -> Any:
        if isinstance(part, np.ndarray) and part.dtype.kind in "biuf":
            return {b"__ndarray__": True, b"data": part.tobytes(), b"dtype": part.dtype.str, b"shape": part.shape}
        if isinstance(part, np.generic):
            return part.item()
        raise TypeError(f"a value of type {type(part).__name__} cannot be sent")

    return msgpack.packb(message, default=default)


def decode(data: bytes) -> Any:
    """Decode a message.

    Raises:
        RequestError: When an array's parts do not fit each other.
        ValueError: When the message is damaged.
    """

    def hook(part: dict) -> Any:
        if not part.get(b"__ndarray__"):
            return part
        kind, shape, content = part.get(b"dtype"), part.get(b"shape"), part.get(b"data")
        plain = isinstance(kind, str) and isinstance(content, bytes) and isinstance(shape, (list, tuple))
        if not plain or len(kind) > 4 or len(shape) > 8 or not all(type(n) is int and 0 <= n < 2**31 for n in shape):
            raise RequestError("an array needs a dtype, a shape and its bytes")
        dtype, count = np.dtype(kind), 1
        for length in shape:
            count *= length
        if dtype.kind not in "biuf" or count * dtype.itemsize != len(content):
            raise RequestError(f"an array of shape {list(shape)} and type {kind} does not have {len(content)} bytes")
        return np.frombuffer(content, dtype).reshape(shape)

    return msgpack.unpackb(
        data, object_hook=hook, raw=False, strict_map_key=False, max_array_len=ITEMS, max_map_len=ITEMS
    )


def picture_of(request: Request, key: str, frames: int, shape: tuple) -> np.ndarray:
    """Return the pictures of a camera as uint8 of shape (frames, height, width, 3).

    Args:
        request: The request.
        key: Key of the pictures.
        frames: Largest number of frames; a request may have fewer.
        shape: Height, width and channels.

    Raises:
        RequestError: When there are none, or they have another shape.
    """
    value = request.get(key)
    if not isinstance(value, np.ndarray) or value.dtype != np.uint8:
        raise RequestError(f"the request needs uint8 pictures '{key}'; it has {sorted(map(str, request))}")
    value = value[None] if value.ndim == 3 else value
    if value.shape[1:] != tuple(shape) or not 1 <= len(value) <= frames:
        raise RequestError(
            f"'{key}' has shape {list(value.shape)}; expected at most {frames} frames of {list(shape)} (height, width, "
            "channels)"
        )
    return value


def text_of(request: Request) -> str:
    """Return a request's instruction.

    Raises:
        RequestError: When there is none.
    """
    text = request.get("prompt")
    if not isinstance(text, str):
        raise RequestError(f"the request needs a text 'prompt'; it has {sorted(map(str, request))}")
    return text


class Worker:
    """The thread of a model. It answers all requests that wait, at most ``model.batch`` at once."""

    def __init__(self, model: Model) -> None:
        self._model = model
        self._waiting: queue.Queue = queue.Queue()
        self._thread = threading.Thread(target=self._run, name="model", daemon=True)
        self._has_ended = False
        self.largest = 0
        """Largest number of requests that were answered at once."""

    def __enter__(self) -> Worker:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._waiting.put(None)
        self._thread.join()

    def begin(self, seed: int) -> Any:
        """Return the state of a session; waits for the model.

        Raises:
            Exception: What the model raises.
        """
        return self._asked("begin", seed)

    def act(self, request: Request, state: Any) -> tuple:
        """Return the reply and the session's new state; waits for the model.

        Raises:
            Exception: What the model raises.
        """
        return self._asked("act", (request, state))

    def _asked(self, kind: str, value: Any) -> Any:
        future: Future = Future()
        self._waiting.put((kind, value, future))
        if self._has_ended:
            self._refuse_waiting()
        return future.result()

    def _refuse_waiting(self) -> None:
        with contextlib.suppress(queue.Empty):
            while True:
                entry = self._waiting.get_nowait()
                if entry is not None:
                    entry[2].set_exception(RuntimeError("the server stops"))

    def _run(self) -> None:
        ended = False
        while not ended:
            batch: list = []
            entry = self._waiting.get()
            while entry is not None and entry[0] == "act":
                batch.append(entry[1:])
                if len(batch) == self._model.batch:
                    break
                try:
                    entry = self._waiting.get_nowait()
                except queue.Empty:
                    break
            self._answer(batch)
            ended = entry is None
            if entry is not None and entry[0] == "begin":
                _resolve(entry[2], lambda seed=entry[1]: self._model.begin(seed))
        self._has_ended = True
        self._refuse_waiting()

    def _answer(self, batch: list) -> None:
        if not batch:
            return
        self.largest = max(self.largest, len(batch))
        try:
            found = [_pair(answer) for answer in self._model.act([request for request, _ in batch])]
            if len(found) != len(batch):
                raise RuntimeError(f"the model must answer each of {len(batch)} requests, it answered {len(found)}")
        except BaseException as error:  # a model may raise anything, and its clients wait
            if len(batch) == 1:
                batch[0][1].set_exception(error)
                return
            for entry in batch:  # one request must not cost the others theirs
                self._answer([entry])
            return
        for (_, future), answer in zip(batch, found, strict=True):
            future.set_result(answer)


def _pair(answer: Any) -> tuple:
    """Return a model's answer to one request as (reply, new state); an array is the actions."""
    if not isinstance(answer, (tuple, list)) or len(answer) != 2:
        kind = type(answer).__name__
        raise RuntimeError(f"the model must answer each request with a pair (reply, new state), it gave a {kind}")
    reply, state = answer
    return reply if isinstance(reply, dict) else {"actions": reply}, state


def _resolve(future: Future, call: Any) -> None:
    try:
        future.set_result(call())
    except BaseException as error:
        future.set_exception(error)


class _Listener(socket.socket):
    """A listening socket that closes connections beyond a bound: each costs a thread, even one that stays silent.

    On a loopback address it also refuses other users of this machine, which the kernel reports (Linux).
    """

    most = 4 * MAX_CONNECTIONS

    @classmethod
    def at(cls, host: str, port: int, all_users: bool) -> _Listener:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        listening = socket.create_server((host, port), family=family, backlog=socket.SOMAXCONN)
        made = cls(family, socket.SOCK_STREAM, fileno=listening.detach())
        made.accepted, made.refusing = [], threading.BoundedSemaphore(8)
        loopback = ipaddress.ip_address(made.getsockname()[0]).is_loopback
        made.all_users = all_users or not loopback or not _kernel_tells()
        return made

    def accept(self) -> tuple:
        while True:
            found, address = super().accept()
            self.accepted = [known for known in self.accepted if known.fileno() != -1]
            if len(self.accepted) < self.most and (self.all_users or self._knows(found)):
                self.accepted.append(found)
                return found, address
            if len(self.accepted) >= self.most:
                found.close()
                continue
            print("refused a connection of another user; --all-users lets all connect", file=sys.stderr)
            if self.refusing.acquire(blocking=False):
                threading.Thread(target=self._say_why, args=(found,), daemon=True).start()
            else:
                found.close()

    def _knows(self, found: socket.socket) -> bool:
        try:
            return _user_of_peer(found) in (os.geteuid(), 0)
        except OSError:  # e.g. no more file descriptors: no client may end `accept`
            return False

    def _say_why(self, found: socket.socket) -> None:
        """Refuse a client once it has asked: one that is refused before may not hear it."""
        try:
            with found, contextlib.suppress(OSError):
                found.settimeout(2.0)
                if found.recv(65536):
                    found.sendall(b"HTTP/1.1 403 Forbidden\r\nContent-Length: %d\r\n\r\n%b" % (len(OTHERS), OTHERS))
                    found.shutdown(socket.SHUT_WR)
                    found.recv(65536)  # until the client has read it
        finally:
            self.refusing.release()

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self.shutdown(socket.SHUT_RDWR)  # ends an `accept` that waits
        super().close()


def _user_of_peer(connection: socket.socket) -> int | None:
    """Return the id of the user at the other end, as Linux reports it (sock_diag, inet_diag.h); None: it has gone.

    Raises:
        OSError: When the kernel cannot report it.
    """
    try:
        (there, from_port, *_), (here, to_port, *_) = connection.getpeername(), connection.getsockname()
    except OSError:
        return None
    there, here = (socket.inet_pton(connection.family, host).ljust(16, b"\0") for host in (there, here))
    ends = struct.pack("!HH16s16s", from_port, to_port, there, here) + struct.pack("=III", 0, 2**32 - 1, 2**32 - 1)
    request = struct.pack("=BBBBI", connection.family, socket.IPPROTO_TCP, 0, 0, 2**32 - 1) + ends
    with socket.socket(socket.AF_NETLINK, socket.SOCK_DGRAM, 4) as kernel:
        kernel.send(struct.pack("=IHHII", 16 + len(request), 20, 1, 1, 0) + request)
        reply = kernel.recv(4096)
    if struct.unpack_from("=H", reply, 4)[0] != 20:
        (code,) = struct.unpack_from("=i", reply, 16)
        if code == -errno.ENOENT:
            return None
        raise OSError(-code, os.strerror(-code))
    user, inode = struct.unpack_from("=II", reply, 16 + 64)
    return user if inode else None


def _kernel_tells() -> bool:
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()):
        try:
            with server.accept()[0] as accepted:
                return _user_of_peer(accepted) is not None
        except (OSError, AttributeError):
            print("every user of this machine can connect: the kernel does not report users", file=sys.stderr)
            return False


class Server:
    """A server of one model; a context manager. Each connection has its own session."""

    def __init__(
        self, model: Model, host: str = "127.0.0.1", port: int = 8000, *, all_users: bool = False, quiet: bool = False
    ) -> None:  # fmt: skip
        self.model = model
        self.worker = Worker(model)
        self.host, self.port = host, port
        self._all_users = all_users
        self._quiet = quiet
        self._places = threading.Semaphore(MAX_CONNECTIONS)
        self._connections: set = set()
        self._stops = False

    @property
    def url(self) -> str:
        """Address of the server."""
        return f"ws://{self.host}:{self.port}"

    def __enter__(self) -> Server:
        """Listen.

        Raises:
            OSError: When the port is taken.
        """
        from websockets.sync.server import serve

        self._server = serve(
            self._connected, sock=_Listener.at(self.host, self.port, self._all_users), compression=None,
            max_size=MESSAGE_BYTES, ping_interval=None,
            close_timeout=1.0, origins=[None], process_request=_health, logger=QUIET,
        )  # fmt: skip
        self.port = self._server.socket.getsockname()[1]
        self.worker.__enter__()
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop listening."""
        self._stops = True
        self._server.shutdown()
        for connection in list(self._connections):
            with contextlib.suppress(OSError):  # the client was faster
                connection.close(1001, "the server stops")
        self._thread.join()
        self.worker.__exit__()

    def _connected(self, connection: Any) -> None:
        from websockets.exceptions import ConnectionClosed

        if not self._places.acquire(blocking=False):
            connection.close(1013, f"the server has {MAX_CONNECTIONS} connections already")
            return
        self._connections.add(connection)
        try:
            if self._stops:  # it came while the others were closed
                connection.close(1001, "the server stops")
                return
            self._talk(connection)
        except ConnectionClosed:
            pass
        finally:
            self._connections.discard(connection)
            self._places.release()

    def _talk(self, connection: Any) -> None:
        connection.send(encode({"needs_session_id": True, "takes_seed": True, **self.model.metadata}))
        state, has_begun = None, False
        for message in connection:
            try:
                request = decode(message) if isinstance(message, bytes) else None
                if not isinstance(request, dict):
                    raise RequestError("a request must be a binary MessagePack map")
                if request.get("endpoint") == "reset" or not has_begun:
                    seed = request.get("seed", 0)
                    state, has_begun = self.worker.begin(seed if isinstance(seed, int) else 0), True
                if request.get("endpoint") == "reset":
                    reply: Any = "reset successful"
                else:
                    self.model.check(request)
                    answer, state = self.worker.act(request, state)
                    reply = encode(answer)
            except (Exception, SystemExit) as error:  # a model may raise anything
                if not self._quiet:
                    sys.stderr.write(traceback.format_exc())
                connection.send(f"{type(error).__name__}: {error}"[:2000])
                connection.close(1011, "Internal server error. The error is in the previous frame.")
                return
            connection.send(reply)


def _health(connection: Any, request: Any) -> Any:
    return connection.respond(200, "OK\n") if request.path == "/healthz" else None


def arguments(about: str) -> argparse.ArgumentParser:
    """Return a parser with the options that all servers have."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        help="address to listen at; another one than this machine's own lets everybody connect who can reach it",
    )
    parser.add_argument("--all-users", action="store_true", help="let other users of this machine connect, too")
    parser.add_argument("--port", type=int, default=8000, help="port to listen at; 0: any (default: 8000)")
    return parser


def serve(model: Model, host: str, port: int, *, all_users: bool = False) -> int:
    """Serve until Ctrl-C or SIGTERM, and return the exit code."""
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    try:
        with Server(model, host, port, all_users=all_users) as server:
            print(f"serving at {server.url}", flush=True)
            ended.wait()
    except OSError as error:
        print(f"cannot listen at {host}:{port}: {error}; choose another --port", file=sys.stderr)
        return 1
    return 0
