"""One episode through real nodes, services and bags, against the same episode through the cores."""

import json
from pathlib import Path

import pytest
from roboxim_interfaces.action import RunEpisodes as RunEpisodesAction
from roboxim_interfaces.msg import RunConfig as RunConfigMsg
from roboxim_interfaces.srv import LoadScene, RunEpisodes, Tick

from roboxim_bringup.core_graph import CoreGraph
from roboxim_core.episode import EpisodeResult, EpisodeRunner, RunConfig
from roboxim_core.errors import RoboximError, SimError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.recorded import RECORDED_PARAMETERS
from roboxim_eval.node import versions
from roboxim_recorder.bag import BagReader
from roboxim_recorder.integrity.check import check_bag
from roboxim_ros.actions import ActionCall
from roboxim_ros.messages.conversions import from_msg, to_msg
from roboxim_ros.testing import PATIENCE_S

pytestmark = pytest.mark.ros
SMALL = {"purpose": "demo", "image_width": 64, "image_height": 64, "noise_translation_m": 0.003}


@pytest.fixture
def graph_parameters():
    return {"sim": {"scene": ""}}


def run(graph, config, indices=(0,)):
    with graph.clients() as clients:
        request = RunEpisodes.Request(config=to_msg(config, RunConfigMsg), indices=list(indices))
        answer = clients.call(RunEpisodes, "evaluator/run_episodes", request, timeout_s=PATIENCE_S)
    return [from_msg(result, EpisodeResult) for result in answer.results]


def test_the_same_episode_gives_the_same_bag_through_nodes_and_cores(graph, tmp_path):
    (result,) = run(graph, RunConfig(**SMALL, output_dir=str(tmp_path / "nodes")))
    assert result.outcome == "success", result
    run(graph, RunConfig(**SMALL, output_dir=str(tmp_path / "again")))
    with CoreGraph(tmp_path / "cores") as cores:
        config = RunConfig(**SMALL, output_dir=str(tmp_path / "cores"))
        EpisodeRunner(cores.ports, config, versions=versions(), library=ModelLibrary()).run_index(0)
    for name in ("metadata.yaml", f"{result.episode_id}_0.mcap"):
        first, *others = [(tmp_path / out / result.bag / name).read_bytes() for out in ("nodes", "again", "cores")]
        assert all(other == first for other in others), name
    report = check_bag(tmp_path / "nodes" / result.bag)
    assert report.ok, report
    assert report.ticks == result.last_seq + 1
    assert result.wall_s > 0.0
    assert BagReader(tmp_path / "nodes" / result.bag).result.wall_s == 0.0


@pytest.mark.thorough
def test_a_request_may_leave_everything_to_the_defaults_of_the_message(graph):
    """``keep`` is empty in such a request, as in `roboxim action send_goal ... "{config: {actor: expert}}"`."""
    config = RunConfigMsg(actor="expert", purpose="test", image_width=32, image_height=32)
    with graph.clients() as clients:
        request = RunEpisodes.Request(config=config, indices=[0])
        (result,) = clients.call(RunEpisodes, "evaluator/run_episodes", request, timeout_s=PATIENCE_S).results
        assert result.outcome == "success", result
        with ActionCall(clients, RunEpisodesAction, "evaluator/run_episodes") as action:
            answer = action.run(RunEpisodesAction.Goal(config=config, indices=[0]), timeout_s=PATIENCE_S)
    assert (answer.status, answer.result.results[0].final_state_hash) == ("succeeded", result.final_state_hash)


def test_noise_is_recorded_separately_from_the_label(graph, tmp_path):
    (result,) = run(graph, RunConfig(**SMALL, output_dir=str(tmp_path)))
    steps = [tick.step for tick in BagReader(tmp_path / result.bag).ticks()]
    noisy = [step for step in steps if step.disturbance]
    assert len(noisy) > 5
    assert all(step.action_label != step.action_executed for step in noisy)
    assert all(step.action_label == step.action_executed for step in steps if not step.disturbance and step.seq)
    assert [step.phase for step in steps].count("settle") == 10


def test_a_users_recorded_parameter_is_one_class(graph, tmp_path, monkeypatch):
    class RecordedDistance:
        def record(self, task, scene):
            target = scene.entity(task.objects["target"].entity)
            return {"target_x_m": target.pose.position[0]}

    monkeypatch.setitem(RECORDED_PARAMETERS._items, "distance", RecordedDistance)
    (result,) = run(graph, RunConfig(**SMALL, output_dir=str(tmp_path), max_steps=2))
    info = BagReader(tmp_path / result.bag).info
    assert json.loads(info.recorded["distance"]) == {"target_x_m": info.scene.entity("target").pose.position[0]}
    assert {"objects", "cameras", "lights", "robot"} <= info.recorded.keys()


def test_failed_attempts_are_stored_separately_and_partial_bags_removed(graph, tmp_path):
    config = RunConfig(**SMALL, output_dir=str(tmp_path), keep="successful", max_steps=5)
    (result,) = run(graph, config)
    assert (result.outcome, result.reason) == ("failure", "not_grasped")
    assert result.bag == "set_apart/demo-0-00000-0"
    assert BagReader(tmp_path / result.bag).result.reason == "not_grasped"
    assert not (tmp_path / "episodes").exists() or not list((tmp_path / "episodes").iterdir())
    assert not list(Path(tmp_path, ".partial").glob("*"))


@pytest.mark.thorough
def test_an_episode_whose_scene_is_not_settled_leaves_no_bag_and_does_not_stop_the_run(graph, tmp_path):
    scene = tmp_path / "falling.yaml"
    scene.write_text("entities: [{name: ball, model: apple, pose: {position: [0.3, 0.4, 0.5]}}]\n")
    task = f"scene: {scene}\nskill: pick_up\nreset: {{cameras: {{names: []}}}}\n"
    config = RunConfig(purpose="demo", output_dir=str(tmp_path), max_steps=2, max_attempts=2, task_config=task)
    results = run(graph, config, (0, 1))
    assert [(r.outcome, r.reason, r.attempt, r.bag) for r in results] == [("error", "reset_infeasible", 1, "")] * 2
    assert all("ball_unsettled" in result.message for result in results)
    assert not list(tmp_path.rglob("*.mcap"))
    (result,) = run(graph, RunConfig(**SMALL, output_dir=str(tmp_path), max_steps=2))
    assert result.reason == "not_grasped", "the sim is free again"


def test_wrong_configuration_is_refused_with_its_reason(graph, tmp_path, monkeypatch):
    monkeypatch.setattr("roboxim_ros.clients.APPEARANCE_S", 3.0)
    bad_task = "skill: pick_upp\n"
    with pytest.raises(RoboximError, match="pick_up"):
        run(graph, RunConfig(**SMALL, task_config=bad_task, output_dir=str(tmp_path)))
    with pytest.raises(RoboximError, match="no camera 'ceiling'.*workspace"):
        run(graph, RunConfig(**SMALL, cameras=("ceiling",), output_dir=str(tmp_path)))
    with pytest.raises(RoboximError, match="nobody/describe_policy"):
        run(graph, RunConfig(**SMALL, actor="nobody", output_dir=str(tmp_path)))
    assert not list(tmp_path.rglob("*.mcap")), "nothing half-written is left"


def test_only_the_holder_of_the_sim_moves_it(graph):
    from roboxim_interfaces.msg import SceneSpec as SceneSpecMsg

    from roboxim_core.specs import SceneSpec

    scene = to_msg(SceneSpec(), SceneSpecMsg)
    with graph.clients() as clients:
        clients.call(LoadScene, "sim/load_scene", LoadScene.Request(episode_id="mine", scene=scene))
        with pytest.raises(SimError, match="mine") as caught:
            clients.call(Tick, "sim/tick", Tick.Request(episode_id="yours", seq=1))
        assert caught.value.code.name == "LEASE_HELD"
        with pytest.raises(SimError) as caught:
            clients.call(Tick, "sim/tick", Tick.Request(episode_id="mine", seq=2))
        assert caught.value.code.name == "WRONG_SEQ"
        with pytest.raises(RoboximError) as caught:
            clients.call(Tick, "sim/tick", Tick.Request(episode_id="mine", seq=1, action=[float("nan")] * 7))
        assert caught.value.code.name == "INVALID_ACTION"
        with pytest.raises(RoboximError, match="shape"):
            clients.call(Tick, "sim/tick", Tick.Request(episode_id="mine", seq=1))
        answer = clients.call(Tick, "sim/tick", Tick.Request(episode_id="mine", seq=1, action=[0.0] * 7))
        assert answer.state.seq == 1
