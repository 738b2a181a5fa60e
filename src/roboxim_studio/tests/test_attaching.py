"""The studio beside a running graph of its own domain: what it shows, what it edits, and what it leaves as it was."""

import os
import threading
from types import SimpleNamespace

import pytest
from browser import wait_for
from roboxim_interfaces.srv import LoadScene, PlanToJoints, ReleaseEpisode, Tick
from simulation_interfaces.srv import GetEntities, GetEntityState, ResetSimulation

from roboxim_bringup.testing import graph  # noqa: F401
from roboxim_core.errors import ConfigError, RoboximError
from roboxim_core.poses import Pose
from roboxim_core.state import StateRecord
from roboxim_ros.messages.conversions import from_msg, to_msg
from roboxim_ros.runs import register_run
from roboxim_ros.testing import runtime  # noqa: F401
from roboxim_studio.acting.live import LiveGraph, choose_graph
from roboxim_studio.app import Studio

pytestmark = pytest.mark.ros
ACTION = [0.01, 0.0, -0.005, 0.0, 0.0, 0.1, 1.0]


@pytest.fixture
def graph_parameters():
    return {"sim": {"renderer": "tiny"}, "tasks": {"visible_renderer": "tiny"}}


@pytest.fixture
def attached(runtime, graph, tmp_path):  # noqa: F811
    """A studio that shows the running graph, with clients of the graph's own."""
    with register_run("up", domain=graph.host.context.get_domain_id(), run_id="shown"):
        run, others = choose_graph()
        assert (run.id, others) == ("shown", ())
        os.environ.pop("ROBOXIM_RUN", None)
        with Studio(folder=tmp_path, graph=LiveGraph(run)) as studio, graph.clients() as clients:
            studio.show("Graph")
            yield studio, clients


def position_of(clients, entity):
    answer = clients.call(GetEntityState, "sim/get_entity_state", GetEntityState.Request(entity=entity))
    point = answer.state.pose.position
    return point.x, point.y, point.z


def episode(clients, scene, name):
    """Execute an episode of a few ticks, as an evaluator would; return its hashes."""
    load = LoadScene.Request(scene=scene, episode_id=name)
    hashes = [clients.call(LoadScene, "sim/load_scene", load).state.state_hash]
    for seq in range(1, 6):
        request = Tick.Request(episode_id=name, seq=seq, action=ACTION)
        hashes.append(clients.call(Tick, "sim/tick", request).state.state_hash)
    clients.call(ReleaseEpisode, "sim/release_episode", ReleaseEpisode.Request(episode_id=name))
    return hashes


@pytest.mark.thorough
def test_a_running_graph_is_shown_and_edited_through_its_services_and_outlives_the_studio(attached, chromium):
    studio, clients = attached
    live = studio.live
    chromium.open(studio.url)
    chromium.wait("document.querySelector('#live-facts')?.innerText.includes('shown')")
    seen = wait_for(lambda: live.seen if live.seen and live.seen.images else None, "the graph's state")
    assert set(seen.images) == {camera.name for camera in seen.scene.cameras}
    assert chromium.text("#live-facts").count(seen.state.state_hash)

    live.select("red_cube")
    wanted = (0.41234, 0.1234, 0.0212)
    live.move("red_cube", Pose(position=wanted)).result(timeout=60)
    assert position_of(clients, "red_cube") == pytest.approx(wanted, abs=1e-3)
    wait_for(lambda: live.seen.state.entity("red_cube").pose.position == pytest.approx(wanted, abs=1e-9), "the edit")
    wait_for(lambda: live._gizmo.position == pytest.approx(wanted, abs=1e-6), "the gizmo at its object")
    assert live.add().result(timeout=60) == "cube"
    wait_for(lambda: "cube" in live._choice.options, "the new object")
    live.select("cube")
    live.delete().result(timeout=60)
    wait_for(lambda: "cube" not in live._choice.options, "the deletion")

    assert live.seen.path == ()
    request = PlanToJoints.Request(named_state="ready")
    request.request.start_state.position = [0.3, *live.seen.state.robot.joint_positions[1:7]]
    answer = clients.call(PlanToJoints, "planner/plan_to_joints", request)
    assert answer.error_code == 0, answer.error_msg
    wait_for(lambda: live.seen.path, "the planner's path")
    end = answer.plan.trajectory.points[-1].positions.tolist()
    assert live.seen.path[-1] == pytest.approx(end, abs=1e-6)
    wait_for(lambda: len(live.ghost.path) == len(live.seen.path), "the path in the view")
    live.sees.value = True
    clients.call(ResetSimulation, "sim/reset_simulation", ResetSimulation.Request(scope=255))
    wait_for(lambda: live.ghost.bodies, "what the planner sees")
    assert set(live.ghost.bodies) == {"table", *(entity.name for entity in live.seen.scene.entities)}

    scene = to_msg(seen.scene, LoadScene.Request().scene.__class__)
    watched = episode(clients, scene, "watched")
    wait_for(lambda: live.seen.state.state_hash == watched[-1], "the last tick")
    studio.show("Episode")
    assert episode(clients, scene, "unwatched") == watched
    studio.show("Graph")

    held = LoadScene.Request(scene=scene, episode_id="held")
    clients.call(LoadScene, "sim/load_scene", held)
    for act in (lambda: live.move("red_cube", Pose(position=wanted)), live.add, live.reset):
        with pytest.raises(RoboximError, match="'held'"):
            act().result(timeout=60)
    request = Tick.Request(episode_id="held", seq=1, action=ACTION)
    state = from_msg(clients.call(Tick, "sim/tick", request).state, StateRecord)
    assert (state.state_hash, state.disturbed) == (watched[1], False)
    clients.call(ReleaseEpisode, "sim/release_episode", ReleaseEpisode.Request(episode_id="held"))
    studio.close()
    answer = clients.call(GetEntities, "sim/get_entities", GetEntities.Request())
    assert "red_cube" in answer.entities


@pytest.mark.thorough
def test_the_graphs_tasks_room_draws_what_the_studio_loads(attached):
    studio, clients = attached
    studio.live._index.value = 3
    studio.live.draw().result(timeout=120)
    assert "Pick up the" in studio.live._message.content
    entities = clients.call(GetEntities, "sim/get_entities", GetEntities.Request()).entities
    assert "target" in entities
    studio.live._task.value = "/etc/passwd"  # as a forged message of a page would
    assert studio.live.draw() is None


class BusyPeer:
    """A peer whose thread has a message to deliver before anything that is asked of it, as in a fast graph."""

    def __init__(self, expected):
        self.takes = []
        self.node = SimpleNamespace(create_subscription=self._create, destroy_subscription=lambda ended: None)
        self.clients = SimpleNamespace(in_thread=self._in_thread)

    def look_for(self, find, missing):
        return "/sim/scene"

    def wake(self):
        pass

    def close(self):
        pass

    def _create(self, kind, topic, take, profile, raw):
        self.takes.append(take)
        return take

    def _in_thread(self, function):
        own = threading.Thread(target=lambda: ([take(b"") for take in self.takes], function()), daemon=True)
        own.start()
        own.join()


def test_messages_that_come_while_subscriptions_end_do_not_hang_the_studio(monkeypatch):
    monkeypatch.setattr("roboxim_bringup.attach.Peer", BusyPeer)
    monkeypatch.setattr("roboxim_bringup.attach.join_run", lambda run_id, domain: ())
    live = LiveGraph(SimpleNamespace(id="shown", namespaces=("/",)))
    live.listen()
    looker = threading.Thread(target=live.rest, daemon=True)
    looker.start()
    looker.join(timeout=20)
    assert not looker.is_alive()


def test_the_only_graph_is_chosen_and_other_runs_are_named(runtime):  # noqa: F811
    assert choose_graph() == (None, ())
    with register_run("generate", domain=7, run_id="job"), register_run("up", domain=8, run_id="one"):
        run, others = choose_graph()
        assert run.id == "one"
        assert [other.id for other in others] == ["job"]
        with register_run("up", domain=9, run_id="two"):
            with pytest.raises(ConfigError, match="--run ID(.|\n)*one(.|\n)*two"):
                choose_graph()
            assert choose_graph("two")[0].id == "two"
        with pytest.raises(ConfigError, match="no live run 'three'"):
            choose_graph("three")
