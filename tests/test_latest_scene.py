"""``episode_id: latest`` of the planner means the newest state of the sim, whichever client moved it."""

import pytest
from roboxim_interfaces.msg import PlanningScene
from roboxim_interfaces.msg import SceneSpec as SceneSpecMsg
from roboxim_interfaces.srv import CheckState, LoadScene, ReleaseEpisode, Tick
from simulation_interfaces.srv import DeleteEntity, SetEntityState, StepSimulation

from roboxim_core.actions import hold_action
from roboxim_core.poses import Pose
from roboxim_core.specs import EntitySpec, SceneSpec
from roboxim_planner.node import PlannerNode
from roboxim_ros.clients import Clients
from roboxim_ros.messages.conversions import fill_pose, to_msg
from roboxim_ros.testing import graph_host  # noqa: F401
from roboxim_sim.node import SimNode

pytestmark = pytest.mark.ros
AWAY = Pose(position=(0.5, 0.3, 0.0225))
CUBE = EntitySpec(name="cube", model="cube", pose=AWAY)


@pytest.fixture
def two_clients(graph_host):  # noqa: F811
    graph_host.add(lambda context: SimNode(context=context, namespace="/latest", parameters={"scene": ""}))
    graph_host.add(lambda context: PlannerNode(context=context, namespace="/latest", parameters={"scene_wait_s": 20.0}))
    with (
        Clients("mover", context=graph_host.context, namespace="/latest") as mover,
        Clients("asker", context=graph_host.context, namespace="/latest") as asker,
    ):
        yield mover, asker


def touched(asker):
    """Return the bodies that touch the arm in the newest scene, as the planner sees it."""
    request = CheckState.Request(scene=PlanningScene(episode_id="latest"))
    answer = asker.call(CheckState, "planner/check_state", request)
    return {name for contact in answer.contacts for name in (contact.body_a, contact.body_b)}


def test_latest_is_the_state_that_another_client_has_just_made(two_clients):
    mover, asker = two_clients
    scene = to_msg(SceneSpec(entities=(CUBE,)), SceneSpecMsg)
    loaded = mover.call(LoadScene, "sim/load_scene", LoadScene.Request(scene=scene, episode_id="e"))
    hand = loaded.state.robot.pose_tcp_measured.position
    in_hand = Pose(position=(hand.x, hand.y, hand.z + 0.02))
    assert "cube" not in touched(asker)
    tick = Tick.Request(episode_id="e", seq=1, action=hold_action(1.0))
    mover.call(Tick, "sim/tick", tick)
    assert "cube" not in touched(asker)
    mover.call(ReleaseEpisode, "sim/release_episode", ReleaseEpisode.Request(episode_id="e"))
    mover.call(StepSimulation, "sim/step_simulation", StepSimulation.Request(steps=24))
    assert "cube" not in touched(asker), "free motion after an episode needs no new scene"
    for _ in range(5):
        for pose, touches in ((in_hand, True), (AWAY, False)):
            request = SetEntityState.Request(entity="cube")
            fill_pose(request.state.pose, pose)
            mover.call(SetEntityState, "sim/set_entity_state", request)
            assert ("cube" in touched(asker)) == touches
    fill_pose(request.state.pose, in_hand)
    mover.call(SetEntityState, "sim/set_entity_state", request)
    mover.call(DeleteEntity, "sim/delete_entity", DeleteEntity.Request(entity="cube"))
    assert "cube" not in touched(asker)
