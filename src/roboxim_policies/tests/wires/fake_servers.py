"""Policy servers that misbehave on command, one for each wire, in threads of the test."""

from __future__ import annotations

import contextlib
import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np

from roboxim_policies.wires import groot, openpi, openvla, vla_eval

GOOD = np.arange(21, dtype=np.float32).reshape(3, 7) / 10
"""The actions of an answer that is right."""
STALE = np.full((3, 7), 99.0, np.float32)
"""The actions of an answer that must never be used."""
FRAME_OF_2_GB = b"\x82\x7f" + (2**31).to_bytes(8, "big") + b"\0" * 1000


def rows_for(behaviour: str) -> object:
    """Return the actions that an answer of a behaviour carries."""
    return {
        "nan": np.where(GOOD[1, 2] == GOOD, np.nan, GOOD),
        "words": ["north", "up"],
        "no rows": GOOD[:0],
        "four axes": GOOD[None, None],
        "short": GOOD[:1],
        "long": np.repeat(GOOD[:1], 50, axis=0) + np.arange(50, dtype=np.float32)[:, None] / 1000,
        "wrong dimension": GOOD[:, :6],
        "wider": np.concatenate([GOOD, GOOD[:, :1]], axis=1),
    }.get(behaviour, GOOD)


class Fake:
    """What all fakes share: the behaviours to show, one a request, and the requests seen."""

    def __init__(self, *behaviours: str) -> None:
        self.behaviours = list(behaviours)
        self.released = threading.Event()
        """Lets a late answer go."""
        self.requests: list[object] = []
        self.kinds: list[str] = []
        """Types of vla-eval's messages."""
        self.url = ""

    def next(self, request: object) -> str:
        self.requests.append(request)
        return self.behaviours.pop(0) if self.behaviours else "good"


@contextlib.contextmanager
def websocket_fake(fake: Fake, serve_connection, port: int) -> Iterator[Fake]:
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.server import serve

    connections = []

    def handler(connection) -> None:
        connections.append(connection)
        with contextlib.suppress(ConnectionClosed, OSError):
            serve_connection(connection)

    with serve(handler, "127.0.0.1", port, compression=None, ping_interval=None, close_timeout=0.2) as server:
        fake.url = f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield fake
        finally:
            fake.released.set()
            server.shutdown()
            thread.join()
            for connection in connections:  # which websockets closes itself from 17 on
                connection.close()


def break_websocket(connection, behaviour: str) -> bool:
    """Show a behaviour that any WebSocket server can have; tell whether it was one."""
    match behaviour:
        case "death":
            connection.socket.sendall(b"\x82\x7e\x10\x00half of a message")
            connection.socket.shutdown(2)
        case "2 GB":
            connection.socket.sendall(FRAME_OF_2_GB)
        case "1011":
            connection.close(1011, "out of memory")
        case "text":
            connection.send("Traceback (most recent call last):\n  File 'x'\nKeyError: 'observation/image'")
            connection.close(1011, "Internal server error. Traceback included in previous frame.")
        case "garbage":
            connection.send(b"\xc1\xff\xff")
        case "pickle":
            connection.send(b"\x80\x04\x95\x0c\x00\x00\x00\x00\x00\x00\x00\x8c\x08builtins\x94.")
        case _:
            return False
    return True


@contextlib.contextmanager
def openpi_fake(*behaviours: str, metadata: dict | None = None, port: int = 0) -> Iterator[Fake]:
    fake = Fake(*behaviours)
    metadata = metadata or {}

    def serve_connection(connection) -> None:
        connection.send(openpi.encode(metadata))
        for message in connection:
            request = openpi.decode(message)
            if request.get("endpoint") == "reset":
                fake.requests.append(request)
                connection.send("reset successful")
                continue
            behaviour = fake.next(request)
            if break_websocket(connection, behaviour):
                continue
            if behaviour == "late":
                fake.released.wait(60)
                connection.send(openpi.encode({"actions": STALE}))
                continue
            if behaviour == "reported":
                connection.send(openpi.encode({"ok": False, "error": {"message": "no such key"}}))
                continue
            if behaviour == "no actions":
                connection.send(openpi.encode({"action": GOOD}))
                continue
            connection.send(
                openpi.encode({"ok": True, "actions": rows_for(behaviour), "data": {"actions": GOOD[None]}})
            )
            if behaviour == "twice":
                connection.send(openpi.encode({"actions": STALE}))

    with websocket_fake(fake, serve_connection, port):
        yield fake


@contextlib.contextmanager
def vla_eval_fake(*behaviours: str, metadata: dict | None = None, port: int = 0) -> Iterator[Fake]:
    fake = Fake(*behaviours)

    def serve_connection(connection) -> None:
        def send(kind: str, payload: dict, seq: int) -> None:
            connection.send(vla_eval.encode({"type": kind, "payload": payload, "seq": seq, "timestamp": 0.0}))

        for message in connection:
            request = vla_eval.decode(message)
            fake.kinds.append(request["type"])
            if request["type"] == "hello":
                hello = {"protocol_version": 1, "model_server": "Fake", **(metadata or {})}
                send("hello", hello, request["seq"])
            if request["type"] == "episode_start" and fake.behaviours[:1] == ["no start"]:
                fake.behaviours.pop(0)
                send("error", {"error": "episode_start_failed: RuntimeError: no GPU"}, request["seq"])
            if request["type"] != "observation":
                continue
            behaviour = fake.next(request["payload"])
            if break_websocket(connection, behaviour):
                continue
            if behaviour == "late":
                fake.released.wait(60)
                send("action", {"actions": STALE}, request["seq"])
            elif behaviour == "stale":
                send("action", {"actions": STALE}, request["seq"] - 1)
            elif behaviour == "reported":
                send("error", {"error": "observation_failed: no such key"}, request["seq"])
            elif behaviour == "no actions":
                send("action", {"action": GOOD}, request["seq"])
            else:
                send("action", {"actions": rows_for(behaviour)}, request["seq"])

    with websocket_fake(fake, serve_connection, port):
        yield fake


@contextlib.contextmanager
def openvla_fake(*behaviours: str, metadata: dict | None = None, port: int = 0) -> Iterator[Fake]:
    fake = Fake(*behaviours)

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            request = openvla.decode(self.rfile.read(int(self.headers["Content-Length"])))
            behaviour = fake.next(request)
            body = openvla.encode("error" if behaviour == "reported" else rows_for(behaviour))
            if behaviour == "late":
                fake.released.wait(60)
                body = openvla.encode(STALE)
            status, length = (500 if behaviour == "1011" else 200), len(body)
            if behaviour in ("garbage", "pickle"):
                body = b"\x80\x04\x95."
            if behaviour == "text":
                body = b"<html>a proxy</html>"
            if behaviour == "no actions":
                body = b'{"detail": "x"}'
            length = {"2 GB": 2**31, "death": len(body) + 100}.get(behaviour, len(body))
            with contextlib.suppress(OSError):
                self.send_response(status)
                self.send_header("Content-Type", "application/json")
                self.send_header("Content-Length", str(length))
                self.end_headers()
                self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
    server.daemon_threads = False
    fake.url = f"http://127.0.0.1:{server.server_address[1]}"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield fake
    finally:
        fake.released.set()
        server.shutdown()
        thread.join()
        server.server_close()


MODALITIES = {
    "video": ["image"],
    "state": ["arm"],
    "action": ["x", "y", "z", "roll", "pitch", "yaw", "gripper"],
    "language": ["task"],
}


def modality_config(kind: groot.Serialiser, changed: dict) -> dict:
    """Return the reply of a server to ``get_modality_config``."""
    groups = {**MODALITIES, **changed}
    config = {group: {"delta_indices": [0], "modality_keys": keys} for group, keys in groups.items()}
    marker = "__ModalityConfig_class__" if kind.npy else "__ModalityConfig__"
    return {group: {marker: True, "as_json": json.dumps(item) if kind.flat else item} for group, item in config.items()}


@contextlib.contextmanager
def groot_fake(
    *behaviours: str, metadata: dict | None = None, kind: groot.Serialiser = groot.N16, token: str = "", port: int = 0,
    wrapped: bool = False,
) -> Iterator[Fake]:  # fmt: skip
    """Serve; ``wrapped``: as with --use-sim-policy-wrapper, which takes flat keys alone."""
    import zmq

    fake = Fake(*behaviours)
    context = zmq.Context()
    ended, bound = threading.Event(), threading.Event()

    def new_socket():
        nonlocal port
        server = context.socket(zmq.REP)
        server.setsockopt(zmq.LINGER, 0)
        while port:  # the old socket gives its port back a moment later
            with contextlib.suppress(zmq.ZMQError):
                server.bind(f"tcp://127.0.0.1:{port}")
                return server
            ended.wait(0.02)
        port = server.bind_to_random_port("tcp://127.0.0.1")
        return server

    def answer(request: dict, behaviour: str) -> bytes:
        rows = rows_for(behaviour)
        if behaviour in ("garbage", "text"):
            return b"\xc1\xff"
        if behaviour == "pickle":
            return b"\x80\x04\x95."
        if behaviour == "reported":
            return kind.encode({"error": "no such key"})
        if behaviour == "2 GB":
            return bytes(3 * 2**20)
        if behaviour == "no actions":
            return kind.encode([{"x": GOOD[:, :1]}, {}])
        wrong = groot.N17 if kind.npy else groot.N16
        writer = wrong if behaviour == "wrong serialiser" else kind
        if not isinstance(rows, np.ndarray):
            return kind.encode([dict.fromkeys(MODALITIES["action"], rows), {}])
        if behaviour == "late":
            rows = STALE
        keys = MODALITIES["action"][: rows.shape[-1]]
        cuts = [slice(i, i + 1) for i in range(6)] + [slice(6, None)]
        parts = {key: rows[..., cut][None] if rows.ndim == 2 else rows for key, cut in zip(keys, cuts, strict=False)}
        return writer.encode(
            {f"action.{k}": v[0] for k, v in parts.items()}
            if kind.flat
            else [{f"action.{k}": v for k, v in parts.items()} if wrapped else parts, {}]
        )

    def serve() -> None:
        server = new_socket()
        bound.set()
        while not ended.is_set():
            if not server.poll(20):
                continue
            request = kind.decode(server.recv())
            endpoint = request["endpoint"]
            if token and request.get("api_token") != token:
                server.send(kind.encode({"error": "Unauthorized: Invalid API token"}))
            elif endpoint == "get_action" and wrapped and "video.image" not in request["data"]["observation"]:
                server.send(kind.encode({"error": "Video key 'video.image' must be in observation"}))
            elif endpoint == "get_action":
                behaviour = fake.next(request["data"])
                if behaviour in ("death", "1011"):
                    server.close(0)
                    server = new_socket()
                    continue
                if behaviour == "late":
                    fake.released.wait(60)
                server.send(answer(request, behaviour))
            elif endpoint == "get_modality_config":
                reply = fake.behaviours.pop(0).encode("latin-1") if fake.behaviours[:1] == ["ERROR"] else None
                server.send(reply or groot.N16.encode(modality_config(kind, metadata or {})))
            else:
                server.send(kind.encode({}))
        server.close(0)

    first = threading.Thread(target=serve)
    first.start()
    bound.wait(60)
    fake.url = f"tcp://127.0.0.1:{port}"
    try:
        yield fake
    finally:
        ended.set()
        fake.released.set()
        first.join()
        context.destroy(0)


FAKES = {"openpi": openpi_fake, "vla_eval": vla_eval_fake, "openvla": openvla_fake, "groot": groot_fake}
