from __future__ import annotations

import pytest
from roboxim_interfaces.action import RunEpisodes
from roboxim_interfaces.msg import RunConfig as RunConfigMsg
from roboxim_interfaces.srv import RunEpisodes as RunEpisodesService

from roboxim_bringup import supervisor
from roboxim_bringup.graph import NODES, PolicyLaunch, node_class, start_graph
from roboxim_core.episode import EpisodeResult, RunConfig
from roboxim_core.errors import ConfigError, InvalidRequestError, RequestTimeoutError
from roboxim_ros.actions import ActionCall
from roboxim_ros.host import NodeHost
from roboxim_ros.messages.conversions import from_msg, to_msg
from roboxim_ros.runs import free_domain
from roboxim_ros.testing import PATIENCE_S

pytestmark = pytest.mark.ros


@pytest.fixture
def graph_parameters():
    return {"sim": {"renderer": "tiny"}, "evaluator": {"service_timeout_s": 1.0}}


def test_fixture_runs_an_episode_in_this_process(graph):
    assert set(graph.nodes) == set(NODES)
    config = RunConfig(run_seed=2, purpose="test", keep="none", image_width=32, image_height=32)
    goal = RunEpisodes.Goal(config=to_msg(config, RunConfigMsg), indices=[0])
    with graph.clients() as clients, ActionCall(clients, RunEpisodes, "evaluator/run_episodes") as action:
        answer = action.run(goal, timeout_s=PATIENCE_S)
    assert (answer.status, answer.result.error_msg) == ("succeeded", "")
    assert from_msg(answer.result.results[0], EpisodeResult).outcome == "success"


def test_the_blocking_service_ends_by_itself(graph):
    config = RunConfig(run_seed=2, purpose="test", keep="none", image_width=32, image_height=32)
    request = RunEpisodesService.Request(config=to_msg(config, RunConfigMsg), indices=list(range(101)))
    with graph.clients() as clients:
        with pytest.raises(InvalidRequestError, match="at most 100 episodes of the service"):
            clients.call(RunEpisodesService, "evaluator/run_episodes", request, timeout_s=PATIENCE_S)
        request.indices = list(range(100))
        with pytest.raises(RequestTimeoutError, match="of 100 episodes; the action"):
            clients.call(RunEpisodesService, "evaluator/run_episodes", request, timeout_s=PATIENCE_S)


@pytest.mark.parametrize("name", NODES)
def test_every_node_of_the_table_exists(name):
    assert node_class(name).__name__.endswith("Node")


def test_unknown_names_are_refused_with_a_suggestion():
    with free_domain() as domain, NodeHost(domain_id=domain) as host:
        with pytest.raises(ConfigError, match="did you mean 'sim'"):
            start_graph(host, nodes=["simm"])
        with pytest.raises(ConfigError, match="parameters for node 'simm'"):
            start_graph(host, parameters={"simm": {}}, nodes=["recorder"])
        with pytest.raises(ConfigError, match="no parameter 'renderr' of sim.*did you mean 'renderer'"):
            start_graph(host, parameters={"sim": {"renderr": "tiny", "renderer": "tiny"}}, nodes=["sim"])


@pytest.mark.parametrize(("namespace", "prefix"), [("", ""), ("/", ""), ("/w0", "/w0"), ("w0/", "/w0")])
def test_a_supervisor_waits_for_the_names_that_the_graph_has(monkeypatch, namespace, prefix):
    monkeypatch.setattr(supervisor, "_start", lambda config: (None, -1))
    made = supervisor.Supervisor(["sim"], [PolicyLaunch(spec="random", namespace="/mine")], namespace=namespace)
    assert made.node_names() == [f"{prefix}/mine/policy", f"{prefix}/sim"]


def test_policy_of_a_graph_serves_in_its_namespace():
    with free_domain() as domain, NodeHost(domain_id=domain) as host:
        launch = PolicyLaunch(spec="random", namespace="mine", options={"scale": 0.1})
        graph = start_graph(host, "/w0", nodes=(), policies=[launch])
        services = {name for name, _ in graph["mine"].get_service_names_and_types()}
        assert {"/w0/mine/act", "/w0/mine/describe_policy", "/w0/mine/reset_policy"} <= services
        with pytest.raises(ConfigError, match="scale"):
            start_graph(host, nodes=(), policies=[PolicyLaunch(spec="random", options={"scael": 1})])
