"""Error codes and messages of requests that are wrong, impossible or late."""

from __future__ import annotations

from typing import Any

import pytest
from planner_graph import HOME, Graph, cube, good_requests, obstacle, sequence, target, to_pose, trajectory
from roboxim_interfaces.srv import ComputeIK, PlanCartesian, PlanSequence, PlanToPose
from sensor_msgs.msg import JointState
from shape_msgs.msg import SolidPrimitive

from roboxim_core.errors import ErrorCode, InvalidRequestError, PlannerError, RequestTimeoutError, RoboximError

pytestmark = pytest.mark.ros


def test_bad_requests_get_their_code_and_words(graph: Graph) -> None:
    cases: list[tuple[PlanToPose.Request, type[RoboximError], ErrorCode, str]] = []

    def case(request: PlanToPose.Request, kind: type[RoboximError], code: ErrorCode, words: str) -> None:
        cases.append((request, kind, code, words))

    nan = to_pose()
    nan.target.pose.position.x = float("nan")
    case(nan, InvalidRequestError, ErrorCode.INVALID_REQUEST, "finite")
    case(to_pose(x=1.6), PlannerError, ErrorCode.GOAL_UNREACHABLE, "mm")
    short, unnamed, none, robot, shape = (to_pose() for _ in range(5))
    short.request.start_state = JointState(position=HOME[:6])
    case(short, InvalidRequestError, ErrorCode.INVALID_REQUEST, "has 7 arm joints, got 6")
    unnamed.request.start_state = JointState(name=["elbow"], position=[0.0])
    case(unnamed, InvalidRequestError, ErrorCode.INVALID_REQUEST, "no joint 'elbow'")
    none.request.start_state = JointState()
    case(none, InvalidRequestError, ErrorCode.INVALID_REQUEST, "empty")
    robot.request.robot = "pandda"
    case(robot, RoboximError, ErrorCode.UNKNOWN_MODEL, "panda")
    bad = obstacle()
    bad.primitives[0].type = SolidPrimitive.PRISM
    shape.request.scene.objects = [bad]
    case(shape, InvalidRequestError, ErrorCode.INVALID_REQUEST, "BOX")
    for field, value, words in (
        ("timeout", -1.0, "timeout"),
        ("sample_period", 5.0, "sample_period"),
        ("max_velocity_scaling_factor", float("nan"), "velocity_scaling"),
    ):
        request = to_pose()
        setattr(request.request, field, value)
        case(request, InvalidRequestError, ErrorCode.INVALID_REQUEST, words)
    hurried = to_pose(y=-0.3)
    hurried.request.timeout = 1e-5
    case(hurried, RequestTimeoutError, ErrorCode.TIMEOUT, "time out after")
    for request, kind, code, words in cases:
        error = graph.refused(PlanToPose, "plan_to_pose", request)
        assert isinstance(error, kind)
        assert error.code == code, error
        assert words in str(error)


def _positions(name: str, request: Any) -> Any:
    """Return the message of a request that holds its joint positions."""
    if name in ("retime_path", "check_trajectory"):
        return (request.path if name == "retime_path" else request.trajectory).points[0]
    if name == "compute_ik":
        return request.seed_state
    return request.state if name in ("compute_fk", "check_state") else request.request.start_state


@pytest.mark.parametrize("name", sorted(good_requests()))
def test_every_service_answers_and_refuses_nan_and_a_wrong_joint_count(graph: Graph, name: str) -> None:
    kind, request = good_requests()[name]
    graph.call(kind, name, request)
    field = "positions" if hasattr(_positions(name, request), "positions") else "position"
    for values, words in (([float("nan"), *HOME[1:]], "finite"), (HOME[:6], "6")):
        _, request = good_requests()[name]
        setattr(_positions(name, request), field, values)
        error = graph.refused(kind, name, request)
        assert error.code == ErrorCode.INVALID_REQUEST
        assert words in str(error)


@pytest.mark.parametrize("name", ["plan_to_pose", "plan_to_joints", "plan_cartesian", "plan_sequence", "retime_path"])
def test_every_planning_service_ends_at_its_deadline(graph: Graph, name: str) -> None:
    kind, request = good_requests()[name]
    request.request.timeout = 1e-5
    error = graph.refused(kind, name, request)
    assert error.code == ErrorCode.TIMEOUT
    assert "time out after 1e-05 s in stage" in str(error)


def _impossible() -> dict[str, tuple[Any, Any, ErrorCode, str]]:
    """Return a request to each service that can ask for what cannot be done."""
    asked = good_requests()
    beyond = [*HOME[:5], 9.0, HOME[6]]
    asked["plan_to_pose"][1].target.pose.position.x = 2.5
    asked["plan_to_joints"][1].target = JointState(position=beyond)
    asked["plan_cartesian"][1].waypoints[0].pose.position.x = 2.5
    asked["plan_sequence"][1].stages[0].goals[0].pose.position.x = 2.5
    asked["retime_path"][1].path = trajectory(beyond, HOME)
    asked["compute_ik"][1].target.pose.position.x = 2.5
    expected = {
        "plan_to_pose": (ErrorCode.GOAL_UNREACHABLE, "mm and"),
        "plan_to_joints": (ErrorCode.GOAL_UNREACHABLE, "panda_joint6 at 9.0000 rad"),
        "plan_cartesian": (ErrorCode.PATH_INCOMPLETE, "out of reach"),
        "plan_sequence": (ErrorCode.GOAL_UNREACHABLE, "stage 'approach' (1 of 3)"),
        "retime_path": (ErrorCode.TRAJECTORY_INVALID, "point 0 of the path: panda_joint6 at 9.0000 rad"),
        "compute_ik": (ErrorCode.GOAL_UNREACHABLE, "mm and"),
    }
    return {name: (*asked[name], *said) for name, said in expected.items()}


@pytest.mark.parametrize("name", sorted(_impossible()))
def test_what_cannot_be_done_is_refused_with_the_reason(graph: Graph, name: str) -> None:
    kind, request, code, words = _impossible()[name]
    error = graph.refused(kind, name, request)
    assert error.code == code
    assert words in str(error)


def test_the_wrong_part_of_a_request_is_named(graph: Graph) -> None:
    asked = good_requests()
    nan = float("nan")
    pose, line, staged = (asked[name][1] for name in ("plan_to_pose", "plan_cartesian", "plan_sequence"))
    pose.alternatives = [target().pose, target().pose]
    pose.alternatives[1].position.x = nan
    line.waypoints.append(target())
    line.waypoints[1].pose.orientation.x = 2.0
    staged.stages[1].goals[0].pose.position.x = nan
    scene = asked["check_state"][1]
    scene.scene.objects = [cube()]
    scene.scene.objects[0].pose.position.x = nan
    path = asked["retime_path"][1]
    path.path.points[1].positions = [nan, *HOME[1:]]
    for name, request, words in (
        ("plan_to_pose", pose, "target 3 of 3: a pose must be finite"),
        ("plan_cartesian", line, "waypoint 2 of 2: a pose's quaternion must have norm 1"),
        ("plan_sequence", staged, "stage 'grasp': goal: a pose must be finite"),
        ("check_state", scene, "pose of object 'cube': a pose must be finite"),
        ("retime_path", path, "point 1 of the trajectory: positions must be finite"),
    ):
        assert words in str(graph.refused(asked[name][0], name, request))


def test_unknown_frames_are_named(graph: Graph) -> None:
    line = good_requests()["plan_cartesian"][1]
    line.waypoints[0].header.frame_id = "tpc"
    ik = ComputeIK.Request(target=target(frame="pana_base"))
    staged = sequence()
    staged.stages[0].goals[0].header.frame_id = "pana_base"
    for kind, name, request, hint in (
        (PlanCartesian, "plan_cartesian", line, "tcp"),
        (ComputeIK, "compute_ik", ik, "panda_base"),
        (PlanSequence, "plan_sequence", staged, "panda_base"),
    ):
        error = graph.refused(kind, name, request)
        assert error.code == ErrorCode.UNKNOWN_FRAME
        assert f"did you mean '{hint}'" in str(error)
