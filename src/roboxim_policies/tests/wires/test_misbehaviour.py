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
from fake_servers import FAKES, GOOD, groot_fake, openpi_fake, openvla_fake, vla_eval_fake

from roboxim_core.errors import ConfigError, ErrorCode, InvalidRequestError, PolicyError
from roboxim_core.policies import EpisodeStart
from roboxim_policies.base import load_policy
from roboxim_policies.serving import policy_server
from roboxim_policies.wires import arrays, base, find_wire, groot, openpi, openvla, packing, vla_eval
from roboxim_policies.wires.errors import Deadline

REQUEST = {
    "observation/image": np.zeros((8, 8, 3), np.uint8),
    "observation/arm": np.zeros(8, np.float32),
    "prompt": "pick up the red cube",
}
START = EpisodeStart(episode_id="e0", instruction="pick up the red cube", seed=1)
GENEROUS_S = 60.0

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


def answer(wire):
    """Run an episode with one request; return the actions as rows."""
    wire.reset(START)
    return np.concatenate(list(wire.ask(REQUEST).values()), axis=1)


@pytest.fixture
def made():
    """Make a wire, and check at the end that closing it leaves neither threads nor files."""
    wires = []

    def make(name, url, **options):
        options = {"timeout_s": GENEROUS_S, "reconnect_s": GENEROUS_S, **options}
        wires.append(find_wire(name)(url, **options))
        return wires[-1]

    yield make
    for wire in wires:
        wire.close()
        assert not wire._is_open


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


def test_stale_seq_is_refused(made):
    with vla_eval_fake("stale") as server:
        wire = made("vla_eval", server.url)
        with pytest.raises(PolicyError, match="answered message 2 when the reply to message 3 was due: it is stale"):
            answer(wire)
        np.testing.assert_allclose(answer(wire), GOOD)


def test_episode_that_cannot_begin_is_named(made):
    with vla_eval_fake("no start") as server:
        wire = made("vla_eval", server.url)
        with pytest.raises(PolicyError, match="could not begin the episode: episode_start_failed.*no GPU"):
            answer(wire)
        np.testing.assert_allclose(answer(wire), GOOD)


def test_episode_of_vla_eval_is_ended_before_the_next(made):
    with vla_eval_fake() as server:
        wire = made("vla_eval", server.url)
        for _ in range(2):
            answer(wire)
        assert server.kinds == ["hello", "episode_start", "observation", "episode_end", "episode_start", "observation"]


def test_error_of_starvla_is_named(made):
    metadata = {"available_unnorm_keys": ["oxe_bridge"], "action_chunk_size": 3}
    with openpi_fake("reported", metadata=metadata) as server:
        wire = made("openpi", server.url)
        with pytest.raises(PolicyError, match="reported an error: no such key"):
            answer(wire)
        np.testing.assert_allclose(answer(wire), GOOD)
        request = server.requests[-1]
        del request["examples"]
        assert request == {"do_sample": False, "use_ddim": True, "num_ddim_steps": 10}, "as StarVLA's own clients send"
        wire = made("openpi", server.url, use_ddim=False, num_ddim_steps=4)
        answer(wire)
        assert (server.requests[-1]["use_ddim"], server.requests[-1]["num_ddim_steps"]) == (False, 4)
        with pytest.raises(PolicyError, match="name it with unnorm_key, expected one of: oxe_bridge"):
            made("openpi", server.url, unnorm_key="oxe_brigde").connect()


@pytest.mark.parametrize("kind", [groot.N16, groot.N17])
@pytest.mark.parametrize("told", [True, False])
def test_gr00ts_server_with_a_sim_policy_wrapper_gets_flat_keys(made, kind, told):
    """Its configuration is that of one without. One that is not announced says what it misses, and is asked again."""
    with groot_fake(kind=kind, wrapped=True) as server:
        wire = made("groot", server.url, sim_policy_wrapper=told)
        for _ in range(2):
            np.testing.assert_allclose(answer(wire), GOOD)
        asked = [request["observation"] for request in server.requests]
    assert [set(observation) for observation in asked] == [{"video.image", "state.arm", "task"}] * 2
    assert asked[0]["video.image"].ndim == 5
    assert asked[0]["task"] in (["pick up the red cube"], ("pick up the red cube",))


def test_gr00t_gets_the_frames_that_its_indices_name():
    window = np.arange(16, dtype=np.uint8)[:, None, None, None] * np.ones((1, 2, 2, 3), np.uint8)
    frames = groot._framed(window, 4, [-15, 0], "image")
    assert frames[:, 0, 0, 0].tolist() == [0, 15]
    assert groot._framed(window, 4, [0], "image")[:, 0, 0, 0].tolist() == [15]
    assert groot._framed(window[0], 4, [0], "image").shape == (1, 2, 2, 3)
    with pytest.raises(InvalidRequestError, match=r"the frames \[-15, 0\].*its window must be 16"):
        groot._framed(window[:4], 4, [-15, 0], "image")


def test_roboarena_is_reset_with_its_session(made):
    with openpi_fake(metadata={"needs_session_id": True, "action_space": "joint_position"}) as server:
        answer(made("openpi", server.url))
    reset, request = server.requests
    assert reset == {"session_id": "e0", "endpoint": "reset"}
    assert request["session_id"] == "e0"
    assert request["endpoint"] == "infer"


@pytest.mark.parametrize("kind", [groot.N15, groot.N16, groot.N17])
def test_every_serialiser_of_groot_is_spoken(kind, made):
    with groot_fake(kind=kind) as server:
        wire = made("groot", server.url)
        np.testing.assert_allclose(answer(wire), GOOD)
        assert wire.connect()["serialiser"] == kind.name
    sent = server.requests[-1] if kind.flat else server.requests[-1]["observation"]["video"]
    assert sent["image"].shape == ((1, 8, 8, 3) if kind.flat else (1, 1, 8, 8, 3))


@pytest.mark.parametrize("kind", [groot.N15, groot.N17])
def test_wrong_serialiser_of_groot_is_named(kind, made):
    with groot_fake("wrong serialiser", kind=kind) as server:
        wire = made("groot", server.url)
        with pytest.raises(PolicyError, match="another serialiser than that of"):
            answer(wire)
        np.testing.assert_allclose(answer(wire), GOOD)


def test_first_groot_is_refused_as_a_server_of_pickles(made):
    with groot_fake("ERROR") as server, pytest.raises(PolicyError, match="pickles.*update Isaac-GR00T"):
        made("groot", server.url).connect()


def test_groot_names_the_keys_that_the_convention_lacks(made):
    with groot_fake() as server:
        wire = made("groot", server.url)
        wire.reset(START)
        with pytest.raises(InvalidRequestError, match="needs the state keys arm; the convention sends none"):
            wire.ask({key: value for key, value in REQUEST.items() if "arm" not in key})


def test_gateway_whose_server_is_away_is_told_from_a_server_with_an_error(made):
    from websockets.sync.server import serve

    with serve(lambda _: None, "127.0.0.1", 0, process_request=lambda c, _: c.respond(503, "no backend\n")) as gateway:
        thread = threading.Thread(target=gateway.serve_forever)
        thread.start()
        wire = made("openpi", f"ws://127.0.0.1:{gateway.socket.getsockname()[1]}", reconnect_s=0.0)
        with pytest.raises(PolicyError, match="cannot be reached: HTTP status 503 of a gateway") as caught:
            wire.connect()
        assert caught.value.code == DIED
        gateway.shutdown()
        thread.join()


def test_wrong_token_is_named(made, monkeypatch):
    from websockets.sync.server import serve

    def check(connection, request):
        if request.headers.get("Authorization") != "Api-Key right":
            return connection.respond(401, "no key\n")
        return None

    def handler(connection):
        connection.send(openpi.encode({}))
        for _ in connection:
            connection.send(openpi.encode({"actions": GOOD}))

    with serve(handler, "127.0.0.1", 0, process_request=check, close_timeout=0.2) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        url = f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        monkeypatch.setenv("MY_KEY", "wrong")
        with pytest.raises(PolicyError, match="HTTP status 401; pass the server's key with key_env") as caught:
            made("openpi", url, key_env="MY_KEY").connect()
        assert "wrong" not in str(caught.value)
        monkeypatch.setenv("MY_KEY", "right")
        np.testing.assert_allclose(answer(made("openpi", url, key_env="MY_KEY")), GOOD)
        server.shutdown()
        thread.join()


@pytest.mark.parametrize("kind", [groot.N15, groot.N17])
def test_wrong_token_of_groot_is_named(kind, made, monkeypatch):
    with groot_fake(kind=kind, token="right") as server:
        monkeypatch.setenv("MY_KEY", "wrong")
        with pytest.raises(PolicyError, match="Unauthorized: Invalid API token; pass the server's token") as caught:
            made("groot", server.url, key_env="MY_KEY").connect()
        assert caught.value.code == FAULT
        monkeypatch.setenv("MY_KEY", "right")
        np.testing.assert_allclose(answer(made("groot", server.url, key_env="MY_KEY")), GOOD)


@pytest.mark.parametrize(
    ("name", "metadata", "changed"),
    [
        ("openpi", {"model": "a"}, {"model": "b"}),
        ("vla_eval", {"model_server": "a"}, {"model_server": "b"}),
        ("groot", {"video": ["image"]}, {"action": ["gripper", "x"]}),
    ],
)
def test_server_with_other_metadata_after_a_restart_is_refused(made, name, metadata, changed):
    with FAKES[name]("good", "death", metadata=metadata) as server:
        wire = made(name, server.url)
        np.testing.assert_allclose(answer(wire), GOOD)
        with pytest.raises(PolicyError, match="lost"):
            answer(wire)
        metadata.update(changed)
        with pytest.raises(PolicyError, match="other metadata than at first"):
            wire.reset(START)


def test_another_server_of_openvlas_wire_between_two_episodes_is_refused(made):
    """Each request is a connection of its own, so that no connection is lost when the server is another one."""
    with openvla_fake() as first:
        wire = made("openvla", first.url)
        np.testing.assert_allclose(answer(wire), GOOD)
    port = int(first.url.rpartition(":")[2])
    with policy_server(lambda: load_policy("zero"), "openvla", port=port) as server:
        assert server.url == first.url
        with pytest.raises(PolicyError, match="other metadata than at first.*roboxim"):
            answer(wire)
    with openvla_fake(port=port):
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


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("grpc://localhost:1", "LeRobot.*pickles"),
        ("http://localhost:1", "scheme 'http' is not of this wire"),
        ("ws://", "names no host"),
        ("ws://user:secret@localhost:1", "would be recorded"),
        ("ws://localhost:notaport", "is not an address"),
    ],
)
def test_wrong_url_is_refused(url, words):
    with pytest.raises(ConfigError, match=words):
        find_wire("openpi")(url)


def test_url_gets_the_usual_scheme_and_port():
    assert find_wire("openpi")("host").url == "ws://host:8000"
    assert find_wire("groot")("host").url == "tcp://host:5555"


@pytest.mark.parametrize(
    ("dtype", "shape", "size"),
    [
        ("<f4", [2**40], 8),  # claims more than there is
        ("<f4", [2**31, 2**31, 2**31], 0),
        ("<f4", [-1], 4),
        ("<f4", [1.0], 4),
        ("<f4", [True], 4),
        ("<f4", [1] * 9, 4),
        ("|O", [1], 8),  # a pickle
        ("|V8", [1], 8),
        ("<c8", [1], 8),
        ("(1000000000,)<f4", [1], 4),
        ("<M8[ns]", [1], 8),
        ({"descr": 1}, [1], 8),
        (["<f4"], [1], 8),
    ],
)
def test_array_that_does_not_fit_its_bytes_is_refused(dtype, shape, size):
    for decode in (openpi.decode_map, vla_eval.decode_map):
        names = ("__ndarray__", "data", "dtype", "shape")
        keys = [name.encode() for name in names] if decode is openpi.decode_map else names
        with pytest.raises(PolicyError, match="cannot be read"):
            decode(dict(zip(keys, (True, bytes(size), dtype, shape), strict=True)))
    with pytest.raises(PolicyError, match="cannot be read"):
        groot.N17._decode_map({b"nd": True, b"type": dtype, b"kind": b"", b"shape": shape, b"data": bytes(size)})
    header = f"{{'descr': {dtype!r}, 'fortran_order': False, 'shape': {tuple(shape)!r}}}".encode()
    npy = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(size)
    with pytest.raises(PolicyError, match="cannot be read"):
        arrays.array_from_npy(npy)


def test_lists_that_are_larger_than_the_bound_are_refused_before_they_are_made():
    with pytest.raises(PolicyError, match="not valid MessagePack"):
        packing.unpack(b"\xdd\x7f\xff\xff\xff" + bytes(200), lambda part: part)  # claims 2^31 items
    with pytest.raises(PolicyError, match="not valid MessagePack"):
        packing.unpack(b"\x91" * 100_000, lambda part: part)  # nested
    with pytest.raises(PolicyError, match="extension"):
        packing.unpack(b"\xc7\x04\x05abcd", lambda part: part)
    with pytest.raises(PolicyError, match="not valid JSON"):
        openvla.decode("[" * 100_000)


def test_picture_that_is_larger_than_it_says_is_not_decompressed():
    import io

    from PIL import Image

    file = io.BytesIO()
    Image.new("RGB", (3000, 3000)).save(file, "PNG")
    with pytest.raises(PolicyError, match="says shape"):
        vla_eval.decode_map({"__image__": True, "format": "png", "data": file.getvalue(), "shape": [8, 8, 3]})
    assert vla_eval.decode_map(vla_eval.encode_array_or_png(REQUEST["observation/image"])).shape == (8, 8, 3)


def test_deadline_that_has_passed_says_so():
    with pytest.raises(PolicyError, match="the reply did not come within 1e-09 s"):
        Deadline(1e-9).left("the reply")
