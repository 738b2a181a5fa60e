"""Policies behind a wire through the whole system: the same episodes as in process, and runs that survive servers."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest
from played_answers import PlayingServer, in_convention, play_expert

from roboxim_bringup.core_graph import CoreGraph
from roboxim_core.actions import ActionSemantics
from roboxim_core.config_folders import config_names
from roboxim_core.conventions import load_convention
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_core.errors import ConfigError, PolicyError
from roboxim_core.policies import CameraRequirement
from roboxim_policies import BasePolicy, load_policy
from roboxim_policies.remote import RemotePolicy
from roboxim_policies.serving import policy_server
from roboxim_policies.wires.openpi import OpenPiWire
from roboxim_runs.episodes.expert_episode import expert_episode
from roboxim_runs.evaluation.run import EvaluationConfig, evaluate
from roboxim_runs.policies.dry_run import DRY_RUN_TICKS, check_policy, save_sheet
from roboxim_runs.policies.specs import PolicySpec


class Seeing(BasePolicy):
    """Draws its actions from the pictures, the measurements and the seed."""

    cameras = (
        CameraRequirement(name="workspace", width=48, height=32),
        CameraRequirement(name="wrist", width=40, height=40),
    )
    semantics = ActionSemantics(rate_hz=0)
    horizon = 2

    def reset(self, start):
        self.rng = np.random.default_rng(start.seed)

    def act(self, window):
        mean = [window.newest.images[name].mean() for name in ("workspace", "wrist")]
        motion = self.rng.normal(size=(2, 7)) * 0.01 + (sum(mean) + window.newest.proprio.joint_positions[3]) / 1e5
        motion[:, 6] = self.rng.integers(0, 2)
        return motion.astype(np.float32)


def outcome(folder, policy):
    config = RunConfig(output_dir=str(folder), max_steps=6, settle_ticks=2)
    with CoreGraph(folder, policy=policy) as graph:
        return EpisodeRunner(graph.ports, config).run_index(0)


@pytest.mark.slow
def test_episode_over_the_wire_is_the_same_as_in_process(tmp_path):
    here = outcome(tmp_path / "here", Seeing())
    with ExitStack() as stack:
        server = stack.enter_context(policy_server(Seeing, "openpi", port=0, size=64))
        remote = load_policy("openpi", url=server.url, convention="server", version="1")
        there = outcome(tmp_path / "there", stack.enter_context(remote))
    assert here.steps == there.steps == 6
    assert there.final_state_hash == here.final_state_hash
    assert there.verdict == here.verdict


def remote_spec(server, **options):
    options = {"url": server.url, "convention": "server", "version": "1", "reconnect_s": 0.0, **options}
    return PolicySpec(spec="openpi", name="there", options=options)


def config(out, policies, **more):
    return EvaluationConfig(
        policies=policies, out=out, **{"episodes": 2, "workers": 1, "max_steps": 8, "size": 64, **more}
    )


def essence(result):
    return replace(result, bag="", wall_s=0.0, inference_s=0.0)


@pytest.mark.ros
@pytest.mark.slow
def test_evaluation_over_the_wire_equals_the_one_in_process_and_continues_with_the_same_model_only(tmp_path):
    with policy_server(lambda: load_policy("random"), "openpi", port=0, size=64) as server:
        local = PolicySpec(spec="random", name="here")
        found = evaluate(config(tmp_path, [local, remote_spec(server)], workers=2))
        assert [essence(r) for r in found["here"].results] == [essence(r) for r in found["there"].results]
        port = server.port
    stored = json.loads((tmp_path / "there" / "run.json").read_text())
    assert stored["server"]["wire"] == "openpi"
    assert stored["server"]["convention"]["name"] == "random (its own)"
    assert stored["server"]["metadata"]["roboxim"]["policy"] == "random"
    assert len(stored["server_probe"]["replies"]) == 3
    with pytest.raises(PolicyError, match="cannot be reached"):
        evaluate(config(tmp_path, [remote_spec(server)], episodes=3))
    complaint = "2 episodes of another model.*replies to the probe differ"
    with policy_server(lambda: load_policy("random", scale=0.1), "openpi", port=port, size=64) as server:
        more = config(tmp_path, [remote_spec(server)], episodes=3)
        pytest.raises(ConfigError, evaluate, more).match(complaint)
    with policy_server(lambda: load_policy("random"), "openpi", port=port, size=64) as server:
        assert len(evaluate(config(tmp_path, [remote_spec(server)], episodes=3)).results) == 3


class Dying(BasePolicy):
    """Serves, but raises in the second episode."""

    semantics = ActionSemantics(rate_hz=0)

    def act(self, window):
        if window.seq == 2 and "-00001-" in window.episode_id:
            raise RuntimeError("out of memory")
        return [0.0] * 6 + [1.0]


@pytest.mark.ros
@pytest.mark.slow
def test_failing_server_costs_its_episode_and_the_run_goes_on(tmp_path):
    with policy_server(Dying, "openpi", port=0) as server:
        found = evaluate(config(tmp_path, [remote_spec(server)], episodes=3, max_steps=4))
    reasons = [(result.outcome, result.reason) for result in found.results]
    assert reasons[1] == ("error", "policy_fault")
    assert "out of memory" in found.results[1].message
    assert [reasons[0][0], reasons[2][0]] == ["failure", "failure"]


@pytest.mark.ros
@pytest.mark.slow
def test_bc_over_the_wire_equals_bc_in_process(small_bc, tmp_path):
    checkpoint = {"checkpoint": str(small_bc)}
    with policy_server(lambda: load_policy("bc", **checkpoint), "openpi", port=0) as server:
        local = PolicySpec(spec="bc", name="here", options=checkpoint)
        found = evaluate(config(tmp_path / "out", [local, remote_spec(server)], size=0))
    assert [essence(r) for r in found["here"].results] == [essence(r) for r in found["there"].results]


@pytest.mark.slow
@pytest.mark.parametrize("name", config_names("conventions"))
def test_server_that_plays_the_expert_succeeds_in_every_convention(name):
    result = play_expert(load_convention(name), 0)
    assert result is not None, "the expert does not solve this episode"
    assert result.outcome == "success", f"{result.reason} {result.message}"
    assert result.clipped == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", config_names("conventions"))
def test_check_of_a_server_that_plays_the_expert_passes_in_every_convention(name, tmp_path):
    convention = load_convention(name)
    images = [  # the default task has one external camera
        image if image.camera == "wrist" else replace(image, camera="workspace") for image in convention.images
    ]
    found = checked(replace(convention, images=tuple(images)), lambda raw: raw)
    assert found.suspicions == ()
    assert found.round_trip.is_exact, str(found.round_trip)
    compared = [line.partition(": ")[2].split("; the expert: ") for line in found.lines if "; the expert: " in line]
    assert len(compared) == DRY_RUN_TICKS
    for answered, expert in compared:  # in the same units, so that a user can compare them
        np.testing.assert_allclose(numbers(answered), numbers(expert), atol=0.0011)
        assert re.sub(NUMBER, "", answered) == re.sub(NUMBER, "", expert)
    save_sheet(found, tmp_path / "sheet.png")
    assert (tmp_path / "sheet.png").stat().st_size > 1000


@pytest.mark.slow
def test_check_of_a_server_with_an_inverted_gripper_names_it():
    found = checked(load_convention("roboxim"), lambda raw: np.column_stack([raw[:, :6], 1 - raw[:, 6]]))
    assert [text[:17] for text in found.suspicions] == ["inverted gripper?"]
    assert not found.passed


NUMBER = r"[-+]?\d+\.\d+"


def numbers(text):
    return [float(number) for number in re.findall(NUMBER, text)]


def checked(convention, changed):
    """Return the check of a server that plays the changed numbers of the expert, at the ticks at which it is asked."""
    episode = expert_episode(rate_hz=convention.rate_hz)
    raw = changed(in_convention(convention, episode))
    rows = convention.chunking.execution.rows_per_request(convention.chunking.horizon)
    asked = [int(tick) for tick in np.linspace(0, len(episode.actions) - 1, DRY_RUN_TICKS)]
    server = PlayingServer(convention)
    server.play(np.concatenate([raw[np.minimum(tick + np.arange(rows), len(raw) - 1)] for tick in asked]))
    with server.serving():
        wire = OpenPiWire(server.url)
        with RemotePolicy(wire, convention, version="expert") as policy:
            return check_policy(policy)


@pytest.mark.slow
def test_policy_check_ends_with_1_when_something_looks_wrong(tmp_path):
    with policy_server(lambda: load_policy("zero"), "openpi", port=0) as server:
        options = [f"--option=url={server.url}", "--option=convention=server", "--option=version=zero"]
        command = [sys.executable, "-m", "roboxim_cli", "policy", "check", "--policy", "openpi", *options]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "suspicious  the arm does not move" in done.stdout, done.stderr
    assert done.returncode == 1
