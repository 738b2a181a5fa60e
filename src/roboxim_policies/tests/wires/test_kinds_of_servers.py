"""What is peculiar to a kind of server: its episodes, serialisers, tokens and metadata."""

import threading

import numpy as np
import pytest
from fake_servers import FAKES, GOOD, groot_fake, openpi_fake, openvla_fake, vla_eval_fake
from one_request import REQUEST, START, answer

from roboxim_core.errors import ErrorCode, InvalidRequestError, PolicyError
from roboxim_policies.base import load_policy
from roboxim_policies.serving import policy_server
from roboxim_policies.wires import groot, openpi


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
        assert caught.value.code == ErrorCode.POLICY_DIED
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
        assert caught.value.code == ErrorCode.POLICY_FAULT
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
