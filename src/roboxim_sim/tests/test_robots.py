"""Every robot of the library works in the world."""

from __future__ import annotations

import numpy as np
import pytest

from roboxim_core.models.library import ModelLibrary
from roboxim_core.specs import RobotSpec, SceneSpec
from roboxim_sim.world import World

LIBRARY = ModelLibrary()


@pytest.mark.parametrize("robot_id", LIBRARY.robot_ids)
def test_every_robot_follows_a_trajectory_and_moves_its_gripper(robot_id: str) -> None:
    with World(LIBRARY) as world:
        world.load(SceneSpec(robot=RobotSpec(model=robot_id)))
        home = np.array(LIBRARY.robot(robot_id).home)
        goal = home + np.resize([0.3, 0.1, -0.2], len(home))
        states = list(world.follow(world.checked_trajectory([0.6, 1.2], [(home + goal) / 2, goal])))
        assert states[-1].robot.joint_positions == pytest.approx(goal, abs=5e-3)
        *_, last = world.move_gripper(0.25)
        assert last.robot.gripper_opening == pytest.approx(0.25, abs=0.01)
