"""Joint-space policies in an episode: the expert's joint motion, recording, replay and export."""

import re
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("rclpy")

from roboxim_bringup.core_graph import CoreGraph
from roboxim_core.actions import ActionSemantics
from roboxim_core.config import from_json, to_json
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_datasets.rlds import RldsReader
from roboxim_policies import BasePolicy
from roboxim_policies.builtin import ReplayPolicy
from roboxim_recorder.bag import BagReader
from roboxim_recorder.export import export_bags
from roboxim_recorder.replay import replay
from roboxim_runs.episodes.task_choice import task_text
from roboxim_sim.world import Snapshot

MODES = {
    "joint_position": {},
    "joint_velocity": {},
    "measured joint_velocity": {"delta_base": "measured"},
}


def config(task, folder):
    return RunConfig(
        run_seed=3, purpose="demo", task_config=task_text(task), image_width=32, image_height=32,
        cameras=("workspace",), output_dir=str(folder),
    )  # fmt: skip


@pytest.fixture(scope="module", params=["pick_cube", pytest.param("pick_cube_ur5", marks=pytest.mark.slow)])
def demonstration(request, tmp_path_factory):
    """The task, and an expert's bag."""
    folder = tmp_path_factory.mktemp("expert")
    with CoreGraph(folder) as graph:
        result = EpisodeRunner(graph.ports, config(request.param, folder)).run_index(0)
    assert result.outcome == "success"
    return request.param, folder / result.bag


class Velocities(BasePolicy):
    """Joint velocities from the measured joints to a bag's commanded ones, as DROID's policies act."""

    semantics = ActionSemantics(control="joint_velocity", delta_base="measured")

    def __init__(self, bag):
        self.ticks = [tick.state.robot for tick in BagReader(bag).ticks(cameras=())]

    def act(self, window):
        target = self.ticks[min(window.seq + 1, len(self.ticks) - 1)]
        step = np.subtract(target.joint_commands, window.newest.proprio.joint_positions)
        return [*(step * self.semantics.rate_hz), target.gripper_command]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.thorough
def test_the_experts_joint_motion_succeeds_and_is_recorded_replayed_and_exported(demonstration, mode, tmp_path):
    task, bag = demonstration
    measured = mode.startswith("measured")
    policy = Velocities(bag) if measured else ReplayPolicy(bag, control=mode)
    with CoreGraph(tmp_path, policy=policy) as graph:
        result = EpisodeRunner(graph.ports, config(task, tmp_path)).run_index(0)
        assert (result.outcome, result.clipped) == ("success", 0), result.message or result.reason
        snapshot = from_json(to_json(graph.sim.world.snapshot()), Snapshot, source="the snapshot")
        assert graph.sim.world.restore(snapshot).state_hash == snapshot.record.state_hash
        recorded = BagReader(tmp_path / result.bag)
        assert replay(recorded, graph.sim).same
    joints = len(recorded.info.scene.robot.joint_positions or next(recorded.ticks()).state.robot.joint_names)
    assert recorded.info.semantics == replace(policy.semantics, rate_hz=10.0)
    report = export_bags("rlds", tmp_path, tmp_path / "rlds")
    episode = next(RldsReader(report.path).episodes("train"))
    assert episode.action.shape == (result.steps, joints + 1)
    assert from_json(str(episode.metadata["action_semantics"]), ActionSemantics, source="") == recorded.info.semantics


class Fixed(BasePolicy):
    semantics = ActionSemantics(control="joint_delta")

    def __init__(self, action):
        self.action = action

    def act(self, window):
        return self.action


@pytest.mark.parametrize(
    ("action", "outcome", "reason", "message"),
    [
        ([0.5, *[0.0] * 6, 1.0], "failure", "not_grasped", ""),
        ([0.0] * 7, "error", "invalid_action", "takes 8: panda_joint1, .*gripper; choose a task with the robot"),
    ],
)
def test_clipped_joint_actions_are_counted_and_a_wrong_number_of_joints_is_named(action, outcome, reason, message):
    with CoreGraph("unused", policy=Fixed(action)) as graph:
        run = replace(config("pick_cube", ""), max_steps=3, output_dir="")
        result = EpisodeRunner(graph.ports, run).run_index(0)
    assert (result.outcome, result.reason) == (outcome, reason)
    assert result.clipped == (3 if outcome == "failure" else 0)
    assert re.search(message, result.message)
