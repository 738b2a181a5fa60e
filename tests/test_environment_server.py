"""RoboXim's environments served to other programs, asked by the client that LeRobot's plugin has."""

import importlib.util
import sys
import tomllib
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

pytest.importorskip("rclpy")

from roboxim_runs.environments.gymnasium_env import RoboXimEnv
from roboxim_runs.environments.serving import EnvironmentServer

PLUGIN = Path(__file__).parents[1] / "plugins/lerobot_env_roboxim"


@pytest.fixture(scope="module")
def client_module():
    spec = importlib.util.spec_from_file_location("lerobot_client", PLUGIN / "lerobot_env_roboxim/client.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["lerobot_client"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def server():
    with EnvironmentServer(port=0, max_environments=2) as served:
        yield served


def test_the_distribution_has_the_name_that_lerobot_looks_for():
    project = tomllib.loads((PLUGIN / "pyproject.toml").read_text())["project"]
    assert project["name"] == "lerobot_env_roboxim"
    assert (PLUGIN / project["name"] / "__init__.py").is_file()


@pytest.mark.slow
def test_a_client_gets_the_episode_that_the_environment_gives_in_process(server, client_module):
    here = RoboXimEnv("pick_cube", size=32, max_steps=3)
    there = client_module.RoboXimClient(server.url, "pick_cube", size=32, max_steps=3)
    try:
        assert there.action_space == here.action_space
        assert there.observation_space == here.observation_space
        assert (there._max_episode_steps, there.metadata["render_fps"]) == (3, here.session.rate_hz)
        assert isinstance(there.metadata["render_fps"], int), "lerobot-eval's video writer takes a whole number alone"
        assert isinstance(here.metadata["render_fps"], int)
        for seed in (5, None):
            (mine, info), (theirs, told) = here.reset(seed=seed), there.reset(seed=seed)
            assert told == info
            assert there.task_description == here.task_description
            for step in range(3):
                same(mine, theirs)
                action = np.full(7, 0.01 * step, np.float32)
                (mine, *rest), (theirs, *others) = here.step(action), there.step(action)
                assert rest == others
        assert there.render().shape == (32, 64, 3)
        assert (
            there.reset(seed=5, options={"index": 1, "lerobot_new_rollout": True})[1]["scene_hash"]
            == info["scene_hash"]
        )
    finally:
        here.close()
        there.close()


def same(mine, theirs):
    np.testing.assert_array_equal(mine["agent_pos"], theirs["agent_pos"])
    for name, picture in mine["pixels"].items():
        np.testing.assert_array_equal(picture, theirs["pixels"][name])


@pytest.mark.slow
def test_gymnasiums_checker_finds_nothing_in_the_client(server, client_module):
    gymnasium.register("RoboXimClient-v0", client_module.RoboXimClient)  # its spec makes every render mode checkable
    options = {"url": server.url, "size": 32, "cameras": ("wrist",), "render_mode": None, "disable_env_checker": True}
    client = gymnasium.make("RoboXimClient-v0", **options)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_env(client.unwrapped)
    finally:
        client.close()
        del gymnasium.registry["RoboXimClient-v0"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task": "pick_cubes"}, "no task 'pick_cubes'.*pick_cube"),
        ({"task": "/etc/passwd"}, "no task"),
        ({"size": 100_000}, "size must be from 0 to 1024 px"),
        ({"size": "32"}, "argument 'size' has the wrong type"),
        ({"control": "joint_speed"}, "joint_velocity"),
        ({"cameras": ("left",)}, "has no camera left, only workspace, wrist"),
    ],
)
def test_wrong_arguments_are_named_by_the_server(server, client_module, arguments, message):
    with pytest.raises(client_module.RoboXimError, match=message):
        client_module.RoboXimClient(server.url, **{"task": "pick_cube", **arguments})


def test_a_connection_is_one_environment_and_their_number_is_bounded(server, client_module):
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    with connect(server.url) as first, connect(server.url) as second:
        for request, words in (
            ({"reset": {}}, "the first request must be 'make'"),
            ({"step": [0.0], "reset": {}}, "must be a map with one of"),
            ({"fly": 1}, "the first request must be 'make'"),
        ):
            first.send(client_module.encode(request))
            assert words in client_module.decode(first.recv())["error"]
        second.send("text")
        assert "must be a map" in client_module.decode(second.recv())["error"]
        with connect(server.url) as third, pytest.raises(ConnectionClosed, match="2 environments already"):
            third.recv(timeout=60)


def test_no_server_is_named(client_module):
    with pytest.raises(ConnectionError, match="run 'roboxim gymnasium serve'"):
        client_module.RoboXimClient("ws://127.0.0.1:1")
