"""Recording, checking, playing and replaying an episode with the commands."""

from __future__ import annotations

import shutil

import pytest
from click.testing import CliRunner
from roboxim_interfaces.action import RunEpisodes
from roboxim_interfaces.msg import RunConfig as RunConfigMsg
from roboxim_interfaces.msg import StateRecord
from std_msgs.msg import String

from roboxim_cli.main import group
from roboxim_core.episode import RunConfig
from roboxim_core.errors import ErrorCode, RoboximError
from roboxim_ros import qos
from roboxim_ros.actions import ActionCall
from roboxim_ros.messages.conversions import to_msg
from roboxim_ros.runs import register_run
from roboxim_ros.testing import PATIENCE_S, eventually

pytestmark = pytest.mark.ros


@pytest.fixture
def graph_parameters():
    return {"sim": {"renderer": "tiny"}}


def roboxim(*words):
    result = CliRunner().invoke(group, [str(word) for word in words], standalone_mode=False, catch_exceptions=False)
    return result.stdout


def record(graph, folder, seed):
    config = RunConfig(
        run_seed=seed, purpose="test", image_width=32, image_height=32, output_dir=str(folder), max_steps=12
    )
    goal = RunEpisodes.Goal(config=to_msg(config, RunConfigMsg), indices=[0])
    with graph.clients() as clients, ActionCall(clients, RunEpisodes, "evaluator/run_episodes") as action:
        [result] = action.run(goal, timeout_s=PATIENCE_S).result.results
    return folder / result.bag


def test_bag_is_described_checked_played_and_replayed(runtime, graph, tmp_path):
    bag = record(graph, tmp_path / "run", seed=6)
    assert "Pick up the" in roboxim("bag", "info", bag)
    assert "1 kept" in roboxim("bag", "info", tmp_path / "run")
    assert "whole, 23 ticks" in roboxim("bag", "check", tmp_path / "run")

    with register_run("up", domain=graph.host.context.get_domain_id()):
        assert "23 of 23 ticks are the same, bit for bit" in roboxim("replay", bag)

        heard = []
        with graph.clients() as clients:
            clients.node.create_subscription(
                StateRecord, "/bag/sim/state", lambda message: heard.append(message.seq), qos.RECORDING
            )
            clients.wake()
            roboxim("bag", "play", bag, "--rate", 20, "--namespace", "/bag", "--topic", "/sim/state", "--wait")
            # the command has seen every message received; the callbacks of the last ones may still be due
            eventually(lambda: len(heard) >= 23, "a callback for each of the 23 messages")
        assert heard == list(range(23))


@pytest.mark.thorough
def test_damaged_bag_is_named_and_repaired(runtime, graph, tmp_path):
    bag = record(graph, tmp_path / "run", seed=7)
    damaged = tmp_path / "damaged"
    shutil.copytree(bag, damaged)
    [file] = damaged.glob("*.mcap")
    file.write_bytes(file.read_bytes()[:-2000])
    with pytest.raises(RoboximError, match="1 of 2 bags are damaged") as error:
        roboxim("bag", "check", bag, damaged)
    assert error.value.code == ErrorCode.BAG_DAMAGED
    with pytest.raises(RoboximError, match="is damaged: all 23 ticks, failure"):
        roboxim("bag", "info", damaged)
    result = CliRunner().invoke(group, ["bag", "repair", str(damaged), "--out", str(tmp_path / "out")])
    assert (result.exit_code, "all 23 ticks" in result.stdout) == (0, True), result.stdout
    repaired = tmp_path / "out" / f"{bag.name}.repaired"
    assert "whole, 23 ticks" in roboxim("bag", "check", repaired)
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    assert CliRunner().invoke(group, ["bag", "repair", str(damaged)]).exit_code == 1
    file.write_bytes(b"")
    assert CliRunner().invoke(group, ["bag", "repair", str(damaged)]).exit_code == 2


@pytest.mark.thorough
def test_a_driven_graph_is_recorded_with_topics_of_other_nodes_and_played(runtime, graph, tmp_path):
    out = tmp_path / "driven"
    with register_run("up", domain=graph.host.context.get_domain_id()), graph.clients() as clients:
        mine = clients.node.create_publisher(String, "/my_node/said", qos.STATE)
        mine.publish(String(data="hello"))
        said = roboxim("bag", "record", "/my_node/said", "/sim/state", "--out", out, "--duration", 3)
        assert "/my_node/said: 1" in said
        assert (out / "metadata.yaml").exists()
        everything = tmp_path / "everything"
        assert "no message on" in roboxim("bag", "record", "--out", everything, "--duration", 2)
        heard = []
        clients.node.create_subscription(String, "/bag/my_node/said", lambda m: heard.append(m.data), qos.RECORDING)
        clients.wake()
        roboxim("bag", "play", out, "--namespace", "/bag", "--topic", "/my_node/said", "--wait")
        eventually(lambda: heard == ["hello"])
        with pytest.raises(RoboximError, match="exists already"):
            roboxim("bag", "record", "--out", out)
    for bag in (out, everything):  # topics of an episode on which nothing came are no lost episode
        with pytest.raises(RoboximError, match="no episode of RoboXim.*bag play.*dataset convert"):
            roboxim("bag", "info", bag)
