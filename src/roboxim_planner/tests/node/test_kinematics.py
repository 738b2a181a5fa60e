"""The services for forward and inverse kinematics."""

from __future__ import annotations

import numpy as np
import pytest
from planner_graph import HOME, NAMES, Graph, target
from roboxim_interfaces.srv import ComputeFK, ComputeIK
from sensor_msgs.msg import JointState

pytestmark = pytest.mark.ros


def test_ik_fk_round_trip(graph: Graph) -> None:
    found = graph.call(ComputeIK, "compute_ik", ComputeIK.Request(target=target(), max_solutions=5))
    assert 2 <= len(found.solutions) <= 5
    for solution in found.solutions:
        pose = graph.call(ComputeFK, "compute_fk", ComputeFK.Request(state=solution)).poses[0].pose
        assert (pose.position.x, pose.position.y, pose.position.z) == pytest.approx((0.5, 0.2, 0.25), abs=1e-5)
    links = graph.call(ComputeFK, "compute_fk", ComputeFK.Request(state=found.solutions[0], links=["panda_link1"]))
    assert links.poses[0].pose.position.z == pytest.approx(0.333)
    request = ComputeFK.Request(links=["panda_leftfinger", "panda_rightfinger"])
    for opening in (0.0, 0.03):
        request.state = JointState(name=[*NAMES, "panda_finger_joint2"], position=[*HOME, opening])
        left, right = (p.pose.position for p in graph.call(ComputeFK, "compute_fk", request).poses)
        apart = np.linalg.norm(np.subtract((left.x, left.y, left.z), (right.x, right.y, right.z)))
        assert apart == pytest.approx(2.0 * opening, abs=1e-6)
    assert "no link 'hnd'" in str(
        graph.refused(ComputeFK, "compute_fk", ComputeFK.Request(state=found.solutions[0], links=["hnd"]))
    )


def test_ik_any_nearest_all(graph: Graph) -> None:
    def solve(mode: int, most: int = 0) -> list[np.ndarray]:
        request = ComputeIK.Request(target=target(), mode=mode, max_solutions=most)
        return [np.array(s.position) for s in graph.call(ComputeIK, "compute_ik", request).solutions]

    every = solve(ComputeIK.Request.ALL)
    assert len(every) > 5
    away = [float(np.abs(q - HOME).max()) for q in every]
    assert away == sorted(away)
    nearest = solve(ComputeIK.Request.NEAREST)
    assert len(nearest) == 1
    assert np.abs(nearest[0] - HOME).max() == pytest.approx(away[0])
    assert len(solve(ComputeIK.Request.ALL, 3)) == 3
    assert len(solve(ComputeIK.Request.ANY)) == 1
    error = graph.refused(ComputeIK, "compute_ik", ComputeIK.Request(target=target(), mode=7))
    assert "mode must be" in str(error)
