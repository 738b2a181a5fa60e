"""Dumps that the node writes of failed plans."""

from __future__ import annotations

from pathlib import Path

import pytest
from planner_graph import FOLDED, Graph, cube, divided, to_pose
from roboxim_interfaces.srv import PlanToJoints, PlanToPose
from sensor_msgs.msg import JointState

from roboxim_core.errors import ErrorCode
from roboxim_core.models.library import ModelLibrary
from roboxim_planner.dumps import list_dumps, read_dump

pytestmark = pytest.mark.ros


def test_a_deadline_of_a_millisecond_ends_in_timeout_and_its_dump_says_the_same(graph: Graph) -> None:
    request = PlanToJoints.Request(target=JointState(position=[-1.2, *FOLDED]))
    request.request.start_state = JointState(position=[1.2, *FOLDED])
    request.request.scene.objects = divided()
    request.request.timeout = 1e-3
    error = graph.refused(PlanToJoints, "plan_to_joints", request)
    assert error.code == ErrorCode.TIMEOUT
    assert "time out after 0.001 s in stage" in str(error)
    dump = read_dump(Path(str(error).partition("; dump: ")[2]))
    again, _ = dump.run_again(ModelLibrary())
    assert (again.error_code, again.error_msg) == (ErrorCode.TIMEOUT, str(error).partition("; dump: ")[0])


def test_failures_leave_dumps_that_run_again_and_their_folder_stays_bounded(graph: Graph) -> None:
    request = to_pose(y=0.22, z=0.03)
    request.request.scene.objects = [cube()]
    for x in (1.5, 1.6, 1.7, 0.5):
        request.target.pose.position.x = x
        for _ in range(2):
            error = graph.refused(PlanToPose, "plan_to_pose", request)
    assert error.code == ErrorCode.GOAL_IN_COLLISION
    dumps = list_dumps(graph.dumps)
    assert len(dumps) == 5
    path = Path(str(error).partition("; dump: ")[2])
    assert path == dumps[0]
    dump = read_dump(path)
    again, _ = dump.run_again(ModelLibrary())
    assert f"{again.error_msg}; dump: {path}" == str(error)
    assert again.error_code == error.code
