import subprocess
import sys

import numpy as np
import pytest

from roboxim_planner import native
from roboxim_planner.pipeline import Planner


@pytest.mark.parametrize(
    "fault", ["sys.modules['roboxim_planner_native'] = None", "import roboxim_planner_native as n; n.API -= 1"]
)
def test_without_its_kernel_the_planner_says_what_to_do(fault: str) -> None:
    script = f"import sys\n{fault}\nimport roboxim_planner.native"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "run `make setup`" in done.stderr


def test_malformed_arrays_are_refused_not_read(planner: Planner) -> None:
    arm = planner.robot.arm
    world = native.World(arm, [], [], [], [])
    for bad in (np.zeros(6), np.zeros((0, 7)), np.zeros((2, 8))):
        with pytest.raises(ValueError, match="expected rows of 7"):
            world.path_is_free(bad, 0.0, 0.0, 0.01)
        with pytest.raises(ValueError, match="expected rows of 7"):
            arm.tcp_poses(bad)
    with pytest.raises(ValueError, match="shape"):
        arm.ik(np.eye(3), np.zeros(7), seed=0, starts=1, enough=1, iterations=1,
               position_tolerance=1e-6, rotation_tolerance=1e-6)  # fmt: skip
    with pytest.raises(ValueError, match="unknown shape"):
        native.Obstacle("cone", np.ones(2), np.eye(4))
    with pytest.raises(IndexError):
        native.World(arm, [], [], [0, 1], [])
