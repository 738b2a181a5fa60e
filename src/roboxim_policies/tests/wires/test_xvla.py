"""X-VLA's own server gets what its own client sends, and its poses are understood.

The server below reads requests as X-VLA's does: arrays are texts of json_numpy in plain JSON.
"""

import base64
import json
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest

from roboxim_core.conventions import load_convention
from roboxim_core.errors import ConfigError, ErrorCode, InvalidRequestError, PolicyError
from roboxim_core.policies import EpisodeStart
from roboxim_policies.base import load_policy
from roboxim_policies.remote import probe_window
from roboxim_policies.wires.xvla import XVlaWire

LIBERO = load_convention("xvla_libero")


def array(text):
    part = json.loads(text)
    return np.frombuffer(base64.b64decode(part["__numpy__"]), part["dtype"]).reshape(part["shape"])


def rows(number):
    """Return 30 poses near the probe's, of which the last one differs; the numbers of the second arm are unused."""
    pose = [-0.16, 0.0, 1.212, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.9, *[5.0] * 10]
    found = np.tile(pose, (30, 1))
    found[-1, 0] = number
    return found


@contextmanager
def served(status=200, sizes=()):
    """Serve; ``sizes``: numbers in the rows of the first answers, else 20."""
    seen = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):  # noqa: N802 - http.server's name
            request = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            seen.append((self.path, request))
            size = (*sizes, *[20] * len(seen))[len(seen) - 1]
            reply = (
                {"action": rows(len(seen) / 100)[:, :size].tolist()} if status == 200 else {"error": "Request failed"}
            )
            data = json.dumps(reply).encode()
            self.send_response(status)
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

        def log_message(self, *_):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}", seen
        finally:
            server.shutdown()
            thread.join()


def policy(url, **options):
    return load_policy("xvla", url=url, convention="xvla_libero", version="1", reconnect_s=0.0, **options)


def begin(made):
    made.reset(EpisodeStart(episode_id="e", instruction="Pick up the red cube", seed=0))


def test_requests_are_the_genuine_clients_and_poses_come_back():
    with served() as (url, seen), policy(url) as made:
        begin(made)
        actions = made.act(probe_window(LIBERO))
    ((path, request),) = seen
    assert path == "/act"
    assert set(request) == {"proprio", "language_instruction", "image0", "image1", "domain_id", "steps"}
    assert (request["domain_id"], request["steps"], request["language_instruction"]) == (3, 10, "pick up the red cube")
    assert array(request["image0"]).shape == (256, 256, 3)
    assert array(request["image0"]).dtype == np.uint8
    # the probe's tool points down: its axes, turned by -90 degrees about the tool's z axis, are +y and +x
    np.testing.assert_allclose(array(request["proprio"]), [-0.16, 0, 1.2189, 0, 1, 0, 1, 0, 0, *[0] * 11], atol=1e-9)
    assert actions.shape == (30, 10)
    np.testing.assert_allclose(actions[0], [0.5, 0, 0.2931, 1, 0, 0, 0, -1, 0, 0.1], atol=1e-9)


def test_the_last_predicted_pose_is_the_next_proprio_until_the_next_episode():
    with served() as (url, seen), policy(url) as made:
        begin(made)
        for _ in range(3):
            made.act(probe_window(LIBERO))
        begin(made)
        made.act(probe_window(LIBERO))
    firsts = [array(request["proprio"])[0] for _, request in seen]
    np.testing.assert_allclose(firsts, [-0.16, 0.01, 0.02, -0.16])
    assert all(array(request["proprio"])[9] == 0 for _, request in seen), (
        "the gripper stays 0, as in the genuine client"
    )


def test_a_measured_pose_is_sent_each_time_if_that_is_asked_for():
    with served() as (url, seen), policy(url, closed_loop=0) as made:
        begin(made)
        for _ in range(2):
            made.act(probe_window(LIBERO))
    np.testing.assert_allclose([array(request["proprio"])[0] for _, request in seen], [-0.16, -0.16])


def test_an_error_of_the_server_is_named():
    with served(status=400) as (url, _), policy(url) as made:
        begin(made)
        with pytest.raises(PolicyError, match="HTTP status 400.*Request failed") as caught:
            made.act(probe_window(LIBERO))
    assert caught.value.code == ErrorCode.POLICY_FAULT


def test_rows_that_change_their_size_in_mid_run_are_refused():
    with served(sizes=(20, 14)) as (url, _), policy(url) as made:
        begin(made)
        made.act(probe_window(LIBERO))
        with pytest.raises(PolicyError, match="other actions than at first.*{'action': 14} instead of {'action': 20}"):
            made.act(probe_window(LIBERO))
        begin(made)
        assert made.act(probe_window(LIBERO)).shape == (30, 10)


def test_wrong_options_and_states_are_refused():
    with pytest.raises(ConfigError, match="closed_loop must be from 0 to 20"):
        XVlaWire("http://127.0.0.1:1", closed_loop=21)
    with served() as (url, _), load_policy("xvla", url=url, convention="openvla_libero", version="1") as made:
        begin(made)
        with pytest.raises(InvalidRequestError, match="takes one state, 'proprio'; the convention sends none"):
            made.act(probe_window(made.convention))
