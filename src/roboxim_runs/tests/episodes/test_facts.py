"""Facts of episodes: places are seen from the robot, wherever its base is."""

import math

import pytest

from roboxim_eval.report.episodes import recorded_factors
from roboxim_runs.episodes.facts import EpisodeFacts


@pytest.mark.parametrize(
    ("yaw_rad", "start", "table"),
    [
        (0.0, (0.5, 0.1), (0.4, 0.0, 0.9, 1.4)),
        (math.pi / 2, (0.1, -0.5), (0.0, -0.4, 1.4, 0.9)),
        (math.pi, (-0.5, -0.1), (-0.4, 0.0, 0.9, 1.4)),
        (0.3, pytest.approx((0.507, -0.052), abs=1e-3), None),
    ],
)
def test_places_are_seen_from_the_robot(yaw_rad, start, table):
    facts = EpisodeFacts(
        episode_id="e", start=(1.5, 2.1), robot=(1.0, 2.0), robot_yaw_rad=yaw_rad, table=(1.4, 2.0, 0.9, 1.4)
    )
    assert facts.start_from_robot == start
    assert facts.table_from_robot == table
    distance = recorded_factors({}, facts.start_from_robot)["start: distance from the robot [m]"]
    assert distance == f"{math.hypot(0.5, 0.1):.3f}"
