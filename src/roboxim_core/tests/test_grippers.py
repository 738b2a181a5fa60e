"""Openings of grippers: metres everywhere, whatever the joints are."""

from typing import Any

import pytest

from roboxim_core.errors import ConfigError
from roboxim_core.kinematics.arm import ArmKinematics
from roboxim_core.models.description import FollowerJoint, GripperModel
from roboxim_core.models.library import ModelLibrary

LIBRARY = ModelLibrary()
TURNING: dict[str, Any] = {
    "joint_names": ("left", "right"), "max_opening_m": 0.08, "force_n": 20.0, "speed_m_s": 0.1,
    "followers": (FollowerJoint(name="tip", leader="right", ratio=-1.0),),
    "opening_map": ((0.0, 0.8), (0.05, 0.3), (0.08, 0.0)),
}  # fmt: skip


def test_sliding_fingers_share_the_opening() -> None:
    hand = LIBRARY.robot("panda").gripper
    assert hand.driven(0.5) == 0.02
    assert hand.opening((0.02, 0.01)) == pytest.approx(0.375)
    assert hand.lever == 1.0


def test_turning_fingers_follow_the_map() -> None:
    turning = GripperModel(**TURNING)
    assert turning.driven(1.0) == 0.0
    assert turning.driven(0.05 / 0.08) == pytest.approx(0.3)
    assert turning.opening((0.3, 0.3)) == pytest.approx(0.625)
    assert turning.opening((0.9, 0.9)) == 0.0, "beyond closed"
    assert turning.followed((0.1, 0.2)) == (-0.2,)
    assert turning.lever == pytest.approx(0.05)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"followers": (FollowerJoint(name="tip", leader="lft", ratio=1.0),)}, "no driven joint 'lft'"),
        ({"opening_map": ((0.0, 0.8), (0.0, 0.3), (0.08, 0.0))}, "rising openings"),
        ({"opening_map": ((0.0, 0.8), (0.05, 0.9), (0.08, 0.0))}, "rise or fall throughout"),
        ({"opening_map": ((0.0, 0.8), (0.07, 0.0))}, "ends at 0.07 m, not at max_opening_m"),
    ],
)
def test_a_map_that_is_none_is_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        GripperModel(**TURNING | changes)


def test_one_jaw_needs_a_map() -> None:
    with pytest.raises(ConfigError, match="one moving jaw needs an opening_map"):
        GripperModel(joint_names=("jaw",), max_opening_m=0.08, force_n=20.0, speed_m_s=0.1)
    tool = LIBRARY.robot("so101").gripper
    assert tool.one_jaw
    assert [tool.opening([tool.driven(share)]) for share in (0.1, 0.5, 1.0)] == pytest.approx([0.1, 0.5, 1.0])


@pytest.mark.parametrize("robot_id", [i for i in LIBRARY.robot_ids if not LIBRARY.robot(i).gripper.one_jaw])
def test_finger_tips_part_by_the_opening_and_stay_parallel(robot_id: str) -> None:
    robot = LIBRARY.robot(robot_id)
    tool, kinematics = robot.gripper, ArmKinematics(robot)
    apart, turns = [], []
    for opening in (0.1, 0.4, 0.7, 1.0):
        assert tool.opening([tool.driven(opening)] * 2) == pytest.approx(opening)
        poses = kinematics.link_poses(robot.home, [tool.driven(opening)] * 2)
        hand, left, right = (poses[link] for link in tool.links[:3])
        sides = [(hand.inverse() @ tip).position[1] for tip in (left, right)]
        apart.append(abs(sides[0] - sides[1]) - opening * tool.max_opening_m)
        turns.append((hand.inverse() @ left).rotation.magnitude())
    assert apart == pytest.approx([apart[0]] * 4, abs=1e-3), "opening in metres"
    assert turns == pytest.approx([turns[0]] * 4, abs=1e-6)
