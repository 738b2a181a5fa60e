"""Clients of servers that stay silent, come in hundreds, send slowly, announce what they do not send, or compress."""

from __future__ import annotations

import importlib.util
import os
import resource
import socket
import struct
import subprocess
import sys
import threading
import time
from collections import deque
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np
import pytest
from websockets.sync.client import ClientConnection

pytest.importorskip("rclpy")

from roboxim_core.actions import ActionSemantics
from roboxim_core.errors import PolicyError
from roboxim_policies import BasePolicy
from roboxim_policies.serving import policy_server
from roboxim_policies.serving.listening import BoundedListener
from roboxim_policies.wires import find_wire
from roboxim_runs.environments.serving import EnvironmentServer

STAND_ALONE = Path(__file__).parents[1] / "src/roboxim_policies/servers/openpi_server.py"
GENEROUS_S = 60.0
UPGRADE = (
    b"GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Extensions: permessage-deflate\r\n\r\n"
)
"""A handshake that offers compression."""
FIN_BINARY, COMPRESSED, MASKED = 0x82, 0x40, 0x80


class Still(BasePolicy):
    """Stays where it is."""

    semantics = ActionSemantics(rate_hz=0)

    def reset(self, start):
        """Begin."""

    def act(self, window):
        """Return no motion."""
        return np.zeros((1, 7), np.float32)


def stand_alone(**given):
    """Return a server of the script that imports nothing of RoboXim."""
    spec = importlib.util.spec_from_file_location("openpi_server_under_attack", STAND_ALONE)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)

    class Model(module.Model):
        """Answers every request with zeros."""

        def __init__(self):
            self.metadata = {}
            self.batch = 1

        def begin(self, seed):
            """Begin."""

        def check(self, request):
            """Accept."""

        def act(self, asked):
            """Return zeros."""
            return [({"actions": np.zeros((1, 7), np.float32)}, None) for _ in asked]

    return module.Server(Model(), port=0, quiet=True, **given)


SERVERS = {
    "openpi": lambda **given: policy_server(Still, "openpi", port=0, **given),
    "vla_eval": lambda **given: policy_server(Still, "vla_eval", port=0, **given),
    "openvla": lambda **given: policy_server(Still, "openvla", port=0, **given),
    "gymnasium": lambda **given: EnvironmentServer(port=0, **given),
    "stand-alone": stand_alone,
}
WEBSOCKETS = [name for name in SERVERS if name != "openvla"]


@pytest.fixture
def server(request):
    with SERVERS[request.param]() as served:
        yield served


def connected(server):
    return socket.create_connection(("127.0.0.1", server.port), timeout=GENEROUS_S)


def upgraded(server):
    """Return a connection after the WebSocket handshake, and the server's answer to it."""
    made = connected(server)
    made.sendall(UPGRADE)
    head = b""
    while b"\r\n\r\n" not in head:
        head += made.recv(1)
    return made, head


def answers(server):
    """Whether the server answers a client's first request within a generous time."""
    deadline = time.monotonic() + GENEROUS_S
    while time.monotonic() < deadline:
        with suppress(OSError), connected(server) as made:
            made.sendall(UPGRADE)
            if made.recv(12).startswith(b"HTTP/1.1"):
                return True
        time.sleep(0.05)
    return False


def closing_code(made):
    """Return the code with which a server closes a WebSocket connection; what it sends before is skipped."""
    data = b""
    with suppress(OSError):
        while part := made.recv(65536):
            data += part
    at = 0
    while at + 2 <= len(data):
        kind, length = data[at] & 0x0F, data[at + 1] & 0x7F
        at += 2
        if length == 126:
            length, at = struct.unpack(">H", data[at : at + 2])[0], at + 2
        elif length == 127:
            length, at = struct.unpack(">Q", data[at : at + 8])[0], at + 8
        if kind == 8:
            return struct.unpack(">H", data[at : at + 2])[0]
        at += length
    return None


@pytest.mark.parametrize("server", SERVERS, indirect=True)
def test_servers_listen_to_this_machine_alone_by_default(server):
    assert server.host == "127.0.0.1"
    with connected(server) as made:
        assert made.getpeername()[0] == "127.0.0.1"
    own = next((a[4][0] for a in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)), "127.0.0.1")
    if not own.startswith("127."):
        with pytest.raises(OSError, match="refused"):
            socket.create_connection((own, server.port), timeout=GENEROUS_S)


@pytest.mark.parametrize("server", SERVERS, indirect=True)
def test_silent_connections_cost_a_bounded_number_of_threads(server, monkeypatch):
    for listener in (BoundedListener, sys.modules.get("openpi_server_under_attack", BoundedListener)):
        monkeypatch.setattr(getattr(listener, "_Listener", BoundedListener), "most", 20)
    before = threading.active_count()
    with ExitStack() as stack:
        for _ in range(60):
            with suppress(OSError):
                stack.enter_context(connected(server))
        assert threading.active_count() - before <= 2 * 20  # websockets has two for each connection
    assert answers(server), "once they have left"


@pytest.mark.parametrize("name", SERVERS)
def test_a_server_that_is_full_can_be_stopped(name, monkeypatch):
    """Its thread may wait for the next connection, having just closed one too many."""
    for listener in (BoundedListener, getattr(sys.modules.get("openpi_server_under_attack"), "_Listener", None)):
        if listener:
            monkeypatch.setattr(listener, "most", 4)
    with ExitStack() as stack:
        with SERVERS[name]() as server:
            for _ in range(8):
                with suppress(OSError):
                    stack.enter_context(connected(server))
            time.sleep(0.2)  # so that the server has taken them; without it the test only tests less
        assert not server._thread.is_alive()


def other_user(port, host="127.0.0.1"):
    """Return what a process of another user gets from a server; empty: the connection was closed without a word."""
    program = (
        "import encodings.idna, os, socket, sys\n"
        "os.setuid(65534)\n"
        f"made = socket.create_connection(({host!r}, {port}), timeout={GENEROUS_S})\n"
        f"made.sendall({UPGRADE!r})\n"
        "sys.stdout.buffer.write(made.recv(65536))\n"
    )
    return subprocess.run([sys.executable, "-I", "-c", program], capture_output=True, check=True).stdout


@pytest.mark.skipif(os.geteuid() != 0, reason="acts as another user, which only the superuser can")
@pytest.mark.parametrize("name", SERVERS)
def test_other_users_of_the_machine_are_refused_unless_they_are_let_in(name):
    logged = []
    with SERVERS[name](**({} if name == "stand-alone" else {"log": logged.append})) as server:
        reply = other_user(server.port)
        assert reply.startswith(b"HTTP/1.1 403")
        assert b"belongs to another user of the machine; its owner can start it with --all-users" in reply
        assert answers(server), "its own user"
        assert name == "stand-alone" or logged == ["refused a connection of the user with id 65534"]
    with SERVERS[name](all_users=True) as server:
        assert other_user(server.port).startswith(b"HTTP/1.1 404" if name == "openvla" else b"HTTP/1.1 101")


@pytest.mark.skipif(os.geteuid() != 0, reason="acts as another user, which only the superuser can")
@pytest.mark.parametrize(("host", "status"), [("0.0.0.0", b"101"), ("::1", b"403"), ("::", b"101")])  # noqa: S104
def test_only_loopback_addresses_are_kept_from_other_users(host, status):
    with policy_server(Still, "openpi", host=host, port=0) as server:
        reached = "::1" if ":" in host else "127.0.0.1"
        assert other_user(server.port, reached).startswith(b"HTTP/1.1 " + status)


def test_a_server_goes_on_when_the_kernel_cannot_tell_a_user(monkeypatch):
    def out_of_descriptors(connection):
        raise OSError(24, "Too many open files")

    with policy_server(Still, "openpi", port=0) as server:
        with monkeypatch.context() as patched:
            patched.setattr("roboxim_policies.serving.listening.user_of_peer", out_of_descriptors)
            with pytest.raises(PolicyError, match="HTTP status 403"):
                find_wire("openpi")(server.url, reconnect_s=0.0).connect()
        assert answers(server)


@pytest.mark.parametrize("late_s", [0.0, 0.3])
def test_remote_policy_is_told_that_the_server_is_another_users(monkeypatch, late_s):
    handshake = ClientConnection.handshake

    def late(connection, *arguments, **options):  # the refusal comes before the request is sent
        time.sleep(late_s)
        handshake(connection, *arguments, **options)

    monkeypatch.setattr(ClientConnection, "handshake", late)
    monkeypatch.setattr("roboxim_policies.serving.listening.user_of_peer", lambda connection: 12345)
    with policy_server(Still, "openpi", port=0) as server:
        wire = find_wire("openpi")(server.url, reconnect_s=0.0)
        with pytest.raises(PolicyError, match="HTTP status 403: the server belongs to another user.*--all-users"):
            wire.connect()


@pytest.mark.parametrize("server", WEBSOCKETS, indirect=True)
def test_compression_is_not_spoken_so_there_is_no_bomb(server):
    made, head = upgraded(server)
    with made:
        assert b"101" in head
        assert b"permessage-deflate" not in head
        made.sendall(bytes([FIN_BINARY | COMPRESSED, MASKED | 4, 0, 0, 0, 0]) + b"\xed\xc1\x01\x00")
        assert closing_code(made) == 1002


@pytest.mark.parametrize("server", WEBSOCKETS, indirect=True)
def test_a_message_is_refused_by_its_announced_size(server):
    made, _ = upgraded(server)
    with made:
        made.sendall(bytes([FIN_BINARY, MASKED | 127]) + struct.pack(">Q", 2**40) + bytes(4))
        assert closing_code(made) == 1009


@pytest.mark.parametrize("server", WEBSOCKETS, indirect=True)
def test_a_slow_sender_keeps_no_other_client_waiting(server):
    made, _ = upgraded(server)
    with made:
        made.sendall(bytes([FIN_BINARY, MASKED | 126]) + struct.pack(">H", 1000) + bytes(4) + b"half")
        assert answers(server)


@pytest.mark.parametrize("server", ["openvla"], indirect=True)
@pytest.mark.parametrize("length", ["1099511627776", "-1", "many"])
def test_a_request_over_http_is_refused_by_its_announced_size(server, length):
    with connected(server) as made:
        made.sendall(f"POST /act HTTP/1.1\r\nHost: x\r\nContent-Length: {length}\r\n\r\n".encode())
        assert made.recv(12) == b"HTTP/1.1 413"


@pytest.mark.parametrize("server", SERVERS, indirect=True)
def test_web_pages_of_other_origins_are_refused(server):
    with connected(server) as made:
        made.sendall(
            b"POST /act HTTP/1.1\r\nHost: x\r\nContent-Length: 2\r\nOrigin: https://example.org\r\n\r\n{}"
            if "openvla" in type(server).__name__.lower()
            else UPGRADE[:-2] + b"Origin: https://example.org\r\n\r\n"
        )
        assert made.recv(12) == b"HTTP/1.1 403"


def test_a_stopped_server_leaves_no_client_connected():
    for name in WEBSOCKETS:
        before = threading.active_count()
        with SERVERS[name]() as server:
            made, _ = upgraded(server)
        with made:
            assert closing_code(made) == 1001, name
        deadline = time.monotonic() + GENEROUS_S
        while threading.active_count() > before and time.monotonic() < deadline:
            time.sleep(0.02)
        assert threading.active_count() <= before, name


@pytest.mark.thorough
@pytest.mark.parametrize("server", SERVERS, indirect=True)
def test_ten_thousand_connections_leave_the_server_answering(server):
    """One after another, as many open at a time as the limit of open files allows (both ends are in this process)."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 25_000), hard))
    before, most, kept = threading.active_count(), 0, deque()
    try:
        for number in range(10_000):
            while len(kept) >= (min(hard, 25_000) - 500) // 2:
                kept.popleft().close()
            with suppress(OSError):  # beyond the bound they are closed at once
                kept.append(connected(server))
            if number % 500 == 0:
                most = max(most, threading.active_count() - before)
        assert most <= 2 * 320 + 10
    finally:
        for one in kept:
            one.close()
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert answers(server), "once they have left"
