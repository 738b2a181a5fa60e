"""RoboXim as a benchmark of vla-eval, driven by its own orchestrator over its own connection."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from vla_eval import api
from vla_eval.cli.smoke import _make_echo_server
from vla_eval.model_servers.predict import PredictModelServer

from roboxim.vla_eval import RoboXimBenchmark
from roboxim_core.actions import Chunking
from roboxim_core.conventions import load_convention
from roboxim_core.errors import ConfigError, InvalidRequestError
from roboxim_core.policies import CameraRequirement
from roboxim_policies import BasePolicy, load_policy
from roboxim_policies.builtin import ReplayPolicy
from roboxim_policies.serving import policy_server
from roboxim_runs.evaluation.run import EvaluationConfig, evaluate
from roboxim_runs.policies.specs import PolicySpec


class Actions(PredictModelServer):
    """A model server of vla-eval that plays a list of actions, then zeros; it notes what it receives."""

    def __init__(self, actions):
        super().__init__()
        self.actions, self.seen, self.episodes = actions, [], []

    async def on_episode_start(self, config, ctx):
        self.episodes.append(config)
        await super().on_episode_start(config, ctx)

    def predict(self, obs, ctx):
        self.seen.append(obs)
        index = len(self.seen) - 1
        return {"actions": self.actions[index] if index < len(self.actions) else np.zeros(7, np.float32)}


@pytest.fixture(scope="module")
def expert(expert_bag):
    """An expert's bag, and its executed actions."""
    bag, result, ticks = expert_bag(seed=5, size=256)
    return bag, np.array([tick.step.action_executed for tick in ticks[1 : result.steps + 1]], np.float32)


def run(url, tmp_path, episodes=1, **params):
    entry = {"benchmark": "roboxim.vla_eval:RoboXimBenchmark", "episodes_per_task": episodes, "params": params}
    config = {"benchmarks": [entry], "output_dir": str(tmp_path), "server": {"url": url, "timeout": 120.0}}
    return api.run(config, no_save=True)[0]["tasks"][0]["episodes"]


@pytest.mark.slow
def test_vla_evals_orchestrator_and_server_solve_a_task_with_known_actions(expert, tmp_path):
    _, actions = expert
    server = Actions(actions)
    with api.serve_background(server) as served:
        (episode,) = run(served.url, tmp_path, convention="roboxim", seed=5, send_wrist_image=False)
    assert episode["metrics"]["success"], episode
    assert episode["steps"] == len(actions) == len(server.seen)
    first = server.seen[0]
    assert first["images"]["image"].shape == (256, 256, 3)
    assert "wrist_image" not in first["images"]
    assert np.asarray(first["states"]).shape == (10,)
    assert first["task_description"].startswith("Pick up the ")


@pytest.mark.slow
def test_a_served_policy_of_roboxim_solves_the_same_episode(expert, tmp_path):
    bag, actions = expert
    served = policy_server(lambda: ReplayPolicy(bag), "vla_eval", convention=load_convention("roboxim"), port=0)
    with served:
        (episode,) = run(served.url, tmp_path, convention="roboxim", seed=5)
    assert episode["metrics"]["success"], episode
    assert episode["steps"] == len(actions)


@pytest.mark.slow
def test_the_orchestrator_drives_bc_whose_pictures_have_the_size_of_its_training(small_bc, tmp_path):
    logged = []
    served = policy_server(
        lambda: load_policy("bc", checkpoint=small_bc), "vla_eval", convention=load_convention("roboxim"), port=0,
        log=logged.append,
    )  # fmt: skip
    with served:
        (episode,) = run(served.url, tmp_path, convention="roboxim", seed=5, max_steps=3)
    assert not logged
    assert (episode["steps"], episode["metrics"]["success"]) == (3, False)


class Wandering(BasePolicy):
    """Answers four actions that depend on everything a policy sees, its seed, and how often it was asked."""

    cameras = (CameraRequirement(name="workspace", width=64, height=48), CameraRequirement(name="wrist"))
    horizon = 4
    chunking = Chunking(execute=3)

    def reset(self, start):
        self.rng = np.random.default_rng(start.seed + len(start.instruction))

    def act(self, window):
        seen = window.newest.images["workspace"].mean() + window.newest.images["wrist"].mean() + window.seq
        actions = self.rng.normal(size=(4, 7)) * 0.01
        actions[:, 0] += np.sin(seen + sum(window.newest.proprio.joint_positions)) / 100
        actions[:, 6] = self.rng.random(4) < 0.5
        return np.float32(actions)


@pytest.mark.slow
def test_a_served_policy_acts_as_in_roboxim_evaluate(tmp_path):
    """With ``convention: server``; the state hash of the last tick depends on every bit of every action."""
    spec = PolicySpec(spec=f"{__file__}:Wandering", name="here")
    config = EvaluationConfig(policies=[spec], out=tmp_path / "here", episodes=2, seed=3, max_steps=10, workers=1)
    expected = [(result.outcome, result.steps, result.final_state_hash) for result in evaluate(config).results]
    found = []

    class Noting(RoboXimBenchmark):
        def step(self, action):
            answer = super().step(action)
            if result := answer.info.get("result"):
                found.append((result.outcome, result.steps, result.final_state_hash))
            return answer

    with policy_server(Wandering, "vla_eval", port=0) as served, pytest.MonkeyPatch.context() as patch:
        patch.setattr("roboxim.vla_eval.RoboXimBenchmark", Noting)
        episodes = run(served.url, tmp_path, episodes=2, convention="server", seed=3, max_steps=10)
    assert [episode["steps"] for episode in episodes] == [10, 10]
    assert found == expected


def test_a_server_without_a_convention_is_refused_with_the_way_round():
    with pytest.raises(ConfigError, match="convention: server needs a server that declares.*vla_eval_libero"):
        RoboXimBenchmark(convention="server")


@pytest.mark.slow
def test_the_documented_command_runs_with_vla_evals_own_dummy_server(tmp_path):
    """The server of zeros is the one of ``vla-eval test benchmark``."""
    with api.serve_background(_make_echo_server(7)) as served:
        entry = {"benchmark": "roboxim.vla_eval:RoboXimBenchmark", "episodes_per_task": 1}
        entry["params"] = {"tasks": ["pick_cube", "stack"], "convention": "vla_eval_libero", "seed": 0, "max_steps": 3}
        config = {"server": {"url": served.url}, "output_dir": str(tmp_path), "benchmarks": [entry]}
        (tmp_path / "roboxim.yaml").write_text(json.dumps(config))  # which is YAML too
        command = [Path(sys.executable).parent / "vla-eval", "run", "-c", tmp_path / "roboxim.yaml", "--no-docker"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    written = "".join(path.read_text() for path in sorted(tmp_path.rglob("*.json")))
    for task in ("pick_cube", "stack"):
        assert task in written, done.stdout + done.stderr


def test_liberos_models_get_liberos_pictures_state_and_rate(tmp_path):
    server = Actions([])
    with api.serve_background(server) as served:
        episodes = run(served.url, tmp_path, episodes=2, seed=1, max_steps=2)
    assert [episode["metrics"]["success"] for episode in episodes] == [False, False]
    assert [episode["steps"] for episode in episodes] == [2, 2]
    assert sorted(server.seen[0]["images"]) == ["agentview", "wrist"]
    assert np.asarray(server.seen[0]["states"]).shape == (8,)
    assert not np.array_equal(server.seen[0]["images"]["agentview"], server.seen[2]["images"]["agentview"])


def test_the_benchmark_declares_itself_and_refuses_a_chunk():
    benchmark = RoboXimBenchmark(tasks=["pick_cube", "stack"])
    assert [task["name"] for task in benchmark.get_tasks()] == ["pick_cube", "stack"]
    spec = benchmark.get_action_spec()
    assert (spec["position"].format, spec["rotation"].format) == ("delta_xyz", "axis_angle")
    assert spec["gripper"].format == "binary_close_positive"
    assert benchmark.get_hold_action(None)["actions"].tolist() == [0, 0, 0, 0, 0, 0, -1.0]
    assert benchmark.get_metadata()["max_steps"] > 0
    with pytest.raises(InvalidRequestError, match="one row of 7 numbers"):
        benchmark.step({"actions": np.zeros((5, 7))})
    assert RoboXimBenchmark(convention="droid_velocity").get_action_spec()["joints"].dims == 7
