import pytest

from roboxim_core.errors import ConfigError, ErrorCode, InvalidRequestError, TaskError
from roboxim_core.policies import PolicyDescription
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_core.state import EntityState, RobotState, StateRecord
from roboxim_core.verdicts import Verdict

pytestmark = pytest.mark.ros
rclpy = pytest.importorskip("rclpy")

from roboxim_interfaces.msg import Observation  # noqa: E402
from roboxim_interfaces.msg import SceneSpec as SceneSpecMsg  # noqa: E402
from roboxim_interfaces.msg import StateRecord as StateRecordMsg  # noqa: E402
from roboxim_interfaces.msg import TaskSpec as TaskSpecMsg  # noqa: E402
from roboxim_interfaces.srv import Act, DescribePolicy, GenerateEpisode, Judge, ResetPolicy  # noqa: E402

from roboxim_ros.clients import Clients  # noqa: E402
from roboxim_ros.messages.conversions import from_msg, to_msg  # noqa: E402
from roboxim_ros.testing import PATIENCE_S, graph_host  # noqa: E402, F401
from roboxim_tasks.node import TaskNode  # noqa: E402


@pytest.fixture
def call(graph_host):  # noqa: F811
    graph_host.add(lambda context: TaskNode(context=context, parameters={"solvable": False, "visible": False}))
    with Clients("test", context=graph_host.context) as clients:
        yield lambda srv, name, **fields: clients.call(srv, name, srv.Request(**fields), timeout_s=PATIENCE_S)


def generate(call, **fields):
    return call(GenerateEpisode, "tasks/generate_episode", **{"run_seed": 3, "purpose": "test", "index": 2, **fields})


def test_an_episode_is_the_core_s_and_is_judged(call, draw):
    answer = generate(call)
    expected = draw(2, "pick_cube")
    assert from_msg(answer.task, TaskSpec) == expected.task
    assert from_msg(answer.scene, SceneSpec) == expected.scene
    assert (answer.max_steps, answer.task_config_json) == (expected.max_steps, expected.config_json)

    record = tick(expected, 0)
    task = [to_msg(expected.task, TaskSpecMsg)]
    verdict = call(Judge, "tasks/judge", episode_id="e", task=task, state=to_msg(record, StateRecordMsg)).verdict
    assert from_msg(verdict, Verdict).reason == "not_grasped"
    answer = call(Judge, "tasks/judge", episode_id="e", state=to_msg(tick(expected, 1), StateRecordMsg))
    assert from_msg(answer.verdict, Verdict).predicates["lift_m"] == pytest.approx(0.0)
    with pytest.raises(TaskError, match="expected tick 2"):
        call(Judge, "tasks/judge", episode_id="e", state=to_msg(tick(expected, 5), StateRecordMsg))
    with pytest.raises(TaskError) as error:
        call(Judge, "tasks/judge", episode_id="f", state=to_msg(tick(expected, 0, "f"), StateRecordMsg))
    assert error.value.code == ErrorCode.UNKNOWN_EPISODE


def test_bad_requests_are_answered_with_what_is_wrong(call):
    with pytest.raises(ConfigError, match="line 2"):
        generate(call, task_config="skill: pick_up\nmax_stepz: 3")
    with pytest.raises(InvalidRequestError, match="purpose"):
        generate(call, purpose="fun")
    with pytest.raises(TaskError, match="target_reachable") as error:
        generate(call, task_config="{reset: {objects: {area: {values: [[0.9, 0.6]]}}}, max_draws: 2}")
    assert error.value.code == ErrorCode.RESET_INFEASIBLE


def test_the_expert_is_a_privileged_policy(call, draw):
    answer = call(DescribePolicy, "expert/describe_policy")
    description = from_msg(answer.description, PolicyDescription)
    assert (description.name, description.privileged, description.cameras) == ("expert", True, ())
    with pytest.raises(InvalidRequestError, match="task and the scene"):
        call(ResetPolicy, "expert/reset_policy", episode_id="e")
    with pytest.raises(InvalidRequestError, match="not reset"):
        call(Act, "expert/act", episode_id="e", observations=[observation(draw(0), with_state=True)], pad_mask=[True])
    drawn = draw(0)
    call(ResetPolicy, "expert/reset_policy", episode_id="e", task=[to_msg(drawn.task, TaskSpecMsg)],
         scene=[to_msg(drawn.scene, SceneSpecMsg)])  # fmt: skip
    with pytest.raises(InvalidRequestError, match="state record"):
        call(Act, "expert/act", episode_id="e", observations=[observation(drawn, with_state=False)], pad_mask=[True])


def observation(drawn, *, with_state):
    return Observation(state=[to_msg(tick(drawn, 0), StateRecordMsg)] if with_state else [])


def tick(drawn, seq, episode_id="e"):
    robot = RobotState(
        joint_names=(), joint_positions=drawn.scene.robot.joint_positions, joint_velocities=(),
        joint_commands=drawn.scene.robot.joint_positions, pose_tcp_measured=drawn.scene.entities[0].pose,
        pose_tcp_commanded=drawn.scene.entities[0].pose, gripper_opening=1.0, gripper_command=1.0,
    )  # fmt: skip
    entities = tuple(EntityState(name=entity.name, pose=entity.pose) for entity in drawn.scene.entities)
    return StateRecord(episode_id=episode_id, seq=seq, stamp_ns=seq * 100_000_000, robot=robot, entities=entities)
