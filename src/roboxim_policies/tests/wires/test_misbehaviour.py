"""Each misbehaviour of a server is one named error within its deadline, and the next episode succeeds."""

import asyncio
import contextlib
import gc
import http.server
import os
import socket
import threading
import time

import numpy as np
import pytest
import websockets.asyncio.server
from fake_servers import FAKES, GOOD, openpi_fake
from one_request import GENEROUS_S, REQUEST, START, answer

from roboxim_core.errors import ErrorCode, PolicyError
from roboxim_policies.wires import base, find_wire, groot, openpi

DIED, LATE = ErrorCode.POLICY_DIED, ErrorCode.POLICY_LATE
FAULT, INVALID = ErrorCode.POLICY_FAULT, ErrorCode.INVALID_ACTION
EXPECTED = {
    "death": (DIED, "lost|closed"),
    "late": (LATE, "within 0.5 s; a slower server needs a longer timeout_s"),
    "nan": (INVALID, "finite|nan"),
    "words": (INVALID, "number|without"),
    "no rows": (INVALID, "shape"),
    "four axes": (INVALID, "shape"),
    "no actions": (INVALID, "without"),
    "reported": (FAULT, "error|no such key"),
    "garbage": (FAULT, "cannot be read"),
    "pickle": (FAULT, "cannot be read"),
    "text": (FAULT, "KeyError: 'observation/image'|cannot be read"),
    "1011": (FAULT, "out of memory|HTTP status 500"),
    "2 GB": (FAULT, "bytes"),
}
OWN = {
    ("openvla", "no actions"): (FAULT, "without actions"),
    ("groot", "1011"): (DIED, "lost"),
    ("groot", "2 GB"): (DIED, "more than"),
    ("openpi", "reported"): None,  # a form of StarVLA, see below
}
CASES = [
    (wire, behaviour, *OWN.get((wire, behaviour), expected))
    for wire in FAKES
    for behaviour, expected in EXPECTED.items()
    if OWN.get((wire, behaviour), expected)
]


@pytest.mark.parametrize(("name", "behaviour", "code", "words"), CASES)
def test_misbehaviour_is_one_named_error_and_the_next_episode_succeeds(name, behaviour, code, words, made, monkeypatch):
    if name == "groot" and behaviour == "2 GB":  # the same check with a smaller bound
        monkeypatch.setattr(groot, "MESSAGE_BYTES", 2**20)
    with FAKES[name](behaviour) as server:
        wire = made(name, server.url)
        wire.reset(START)
        wire.timeout_s = 0.5 if behaviour == "late" else GENEROUS_S
        began = time.monotonic()
        with pytest.raises(PolicyError, match=words) as caught:
            wire.ask(REQUEST)
        assert time.monotonic() - began < GENEROUS_S
        assert caught.value.code == code
        assert server.url in str(caught.value) or "cannot be read" in str(caught.value) or code == INVALID
        with pytest.raises(PolicyError, match="closed"):  # nothing is read from the old connection
            wire.ask(REQUEST)
        server.released.set()
        wire.timeout_s = GENEROUS_S
        np.testing.assert_allclose(answer(wire), GOOD)


@pytest.mark.parametrize("name", FAKES)
@pytest.mark.thorough
def test_failed_episodes_leave_neither_threads_nor_files(name, made):
    def held():
        gc.collect()
        return threading.active_count(), len(os.listdir("/proc/self/fd"))

    counts = []
    for _ in range(3):  # what the libraries set up once, and what each server of websockets 16 leaves open: a pipe
        with FAKES[name]():
            pass
        counts.append(held())
    threads, files = counts[-1]
    before = threads, files + (files - counts[-2][1])
    with FAKES[name](*(["death", "nan", "garbage"] * 3)) as server:
        wire = made(name, server.url)
        for _ in range(9):
            wire.reset(START)
            with pytest.raises(PolicyError):
                wire.ask(REQUEST)
        np.testing.assert_allclose(answer(wire), GOOD)
        wire.close()
    deadline = time.monotonic() + GENEROUS_S
    while held() > before and time.monotonic() < deadline:  # threads of the fake itself end a moment later
        time.sleep(0.02)
    assert held() <= before


@pytest.mark.parametrize("name", FAKES)
def test_refused_port_is_tried_again_within_a_bound(name, made):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        scheme = find_wire(name).schemes[0]
        wire = made(name, f"{scheme}://127.0.0.1:{taken.getsockname()[1]}", reconnect_s=4.0)
        pauses = []
        wire.pause = pauses.append
        with pytest.raises(PolicyError, match="cannot be reached.*start the server") as caught:
            wire.reset(START)
    assert caught.value.code == DIED
    assert pauses == [0.25, 0.5, 1.0, 2.0]  # grows, and ends


@pytest.mark.parametrize("name", FAKES)
def test_server_that_comes_back_is_found_by_the_next_try(name, made):
    with FAKES[name]() as first:
        wire = made(name, first.url)
        answer(wire)
    wire.reconnect_s = 0.0
    with pytest.raises(PolicyError) as caught:
        answer(wire)
    assert caught.value.code == DIED
    pauses = []
    with contextlib.ExitStack() as stack:

        def start_in_second_pause(seconds):
            pauses.append(seconds)
            if len(pauses) == 2:
                stack.enter_context(FAKES[name](port=int(first.url.rpartition(":")[2])))

        wire.pause, wire.reconnect_s = start_in_second_pause, GENEROUS_S
        np.testing.assert_allclose(answer(wire), GOOD)
    assert pauses == [0.25, 0.5]


def test_host_that_accepts_but_never_speaks_is_not_there(made):
    with socket.create_server(("127.0.0.1", 0)) as silent:
        for name in FAKES:
            if name == "openvla":  # which has no greeting
                continue
            scheme = find_wire(name).schemes[0]
            wire = made(name, f"{scheme}://127.0.0.1:{silent.getsockname()[1]}", timeout_s=0.5)
            with pytest.raises(PolicyError, match="within 0.5 s") as caught:
                wire.reset(START)
            assert caught.value.code == DIED


def test_reply_that_nobody_asked_for_is_never_used(made):
    with openpi_fake("twice") as server:
        wire = made("openpi", server.url)
        answer(wire)
        server.requests.clear()
        deadline = time.monotonic() + GENEROUS_S
        complaint = ""
        while not complaint and time.monotonic() < deadline:  # until the second reply has arrived
            try:
                wire._connection().require_silence()
            except PolicyError as error:
                complaint = str(error)
        assert "without a request" in complaint
        wire.close()
        np.testing.assert_allclose(answer(wire), GOOD)


@pytest.mark.parametrize("name", FAKES)
@pytest.mark.parametrize("behaviour", ["wider", "wrong dimension", "no actions"])
def test_actions_that_change_in_mid_run_are_refused(made, name, behaviour):
    with FAKES[name]("good", behaviour) as server:
        wire = made(name, server.url)
        np.testing.assert_allclose(answer(wire), GOOD)
        with pytest.raises(PolicyError, match=r"other actions than at first.*[268]} instead of|without") as caught:
            wire.ask(REQUEST)
        assert caught.value.code == (FAULT if (name, behaviour) == ("openvla", "no actions") else INVALID)
        np.testing.assert_allclose(answer(wire), GOOD)


@pytest.mark.parametrize("name", FAKES)
def test_number_of_actions_may_change_in_mid_run(made, name):
    """A policy takes the first of many (`test_remote`), and refuses fewer than its convention executes."""
    with FAKES[name]("good", "long") as server:
        wire = made(name, server.url)
        answer(wire)
        assert answer(wire).shape == (50, 7)


@pytest.mark.parametrize("wire", ["openpi", "vla_eval", "openvla"])
@pytest.mark.parametrize("status", [301, 302, 307, 308])
def test_a_redirect_is_refused_by_name_and_nobody_else_is_asked(made, wire, status, monkeypatch):
    asked = []

    class Elsewhere(http.server.BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self):  # noqa: N802 - http.server's name
            asked.append(self.headers)
            self.send_response(500)
            self.end_headers()

        do_POST = do_GET  # noqa: N815
        log_message = lambda *_: None  # noqa: E731

    class Redirecting(Elsewhere):
        def do_GET(self):  # noqa: N802
            self.rfile.read(int(self.headers.get("Content-Length", 0)))
            self.send_response(status)
            self.send_header("Location", f"{scheme}://127.0.0.1:{other.server_port}/")
            self.send_header("Content-Length", "0")
            self.end_headers()

        do_POST = do_GET  # noqa: N815

    scheme = "http" if wire == "openvla" else "ws"
    monkeypatch.setenv("MY_KEY", "secret")
    options = {"key_env": "MY_KEY"} if wire == "openpi" else {}
    with (
        http.server.ThreadingHTTPServer(("127.0.0.1", 0), Elsewhere) as other,
        http.server.ThreadingHTTPServer(("127.0.0.1", 0), Redirecting) as server,
    ):
        threads = [threading.Thread(target=each.serve_forever, args=(0.02,)) for each in (other, server)]
        for thread in threads:
            thread.start()
        try:
            expected = (
                rf"redirects to {scheme}://127.0.0.1:{other.server_port}/ .HTTP status {status}.*follows no redirect"
            )
            with pytest.raises(PolicyError, match=expected) as caught:
                answer(made(wire, f"{scheme}://127.0.0.1:{server.server_port}", reconnect_s=0.0, **options))
        finally:
            for each in (other, server):
                each.shutdown()
    for thread in threads:
        thread.join()
    assert caught.value.code == FAULT
    assert not asked


def test_first_call_of_a_minute_is_not_cut_off(made):
    """No keepalive ping ends it, and the default deadline is longer; servers answer pings only between calls."""
    assert base.TIMEOUT_S > 60
    with openpi_fake("late") as server:
        wire = made("openpi", server.url)
        wire.reset(START)
        assert wire._socket._connection.ping_interval is None
        threading.Timer(0.5, server.released.set).start()
        assert wire.ask(REQUEST)["actions"].shape == (3, 7)


@pytest.mark.slow
def test_first_call_of_65_seconds_succeeds_with_the_default_options():
    """The server computes in its event loop, as openpi's does, and so answers no ping meanwhile."""
    ready, urls = threading.Event(), []

    async def talk(connection):
        await connection.send(openpi.encode({}))
        async for _ in connection:
            time.sleep(65)  # noqa: ASYNC251 - blocks the event loop on purpose
            await connection.send(openpi.encode({"actions": GOOD}))

    async def main():
        async with websockets.asyncio.server.serve(talk, "127.0.0.1", 0) as server:  # with its default keepalive
            urls.append(f"ws://127.0.0.1:{server.sockets[0].getsockname()[1]}")
            ready.set()
            await asyncio.to_thread(done.wait)

    done, thread = threading.Event(), threading.Thread(target=lambda: asyncio.run(main()))
    thread.start()
    try:
        ready.wait(60)
        wire = find_wire("openpi")(urls[0])
        np.testing.assert_allclose(answer(wire), GOOD)
        wire.close()
    finally:
        done.set()
        thread.join()
