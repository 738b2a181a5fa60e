"""A planner, scenes and ready-made poses for the planner's tests."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_planner.pipeline import Planner
from roboxim_planner.scene import PlanningScene, box

DOWN = Rotation.from_quat([1.0, 0.0, 0.0, 0.0])


def tcp_down(x: float, y: float, z: float, yaw: float = 0.0) -> Pose:
    """Return a tcp pose that looks straight down."""
    return Pose.from_arrays([x, y, z], Rotation.from_euler("z", yaw) * DOWN)


@pytest.fixture(scope="session", name="tcp_down")
def tcp_down_fixture() -> Callable[..., Pose]:
    """`tcp_down`, for test modules."""
    return tcp_down


@pytest.fixture(scope="session")
def planner() -> Planner:
    """The Panda's planner."""
    return Planner(ModelLibrary().robot("panda"))


@pytest.fixture(scope="session")
def table() -> PlanningScene:
    """A table alone."""
    return PlanningScene(bodies=(box("table", (0.9, 1.4, 0.05), Pose(position=(0.5, 0.0, -0.025))),))


@pytest.fixture(scope="session")
def walled(table: PlanningScene) -> PlanningScene:
    """A table with a wall between left and right."""
    return table.with_bodies([box("wall", (0.3, 0.02, 0.6), Pose(position=(0.55, 0.0, 0.3)))])


@pytest.fixture(scope="session")
def left(planner: Planner, walled: PlanningScene) -> np.ndarray:
    """An arm configuration left of the wall."""
    return planner.inverse_kinematics(tcp_down(0.5, 0.3, 0.2), planner.named_state("home"), scene=walled)[0]
