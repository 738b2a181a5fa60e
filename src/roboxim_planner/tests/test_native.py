import subprocess
import sys

import numpy as np
import pytest
from scipy.interpolate import PPoly

from roboxim_planner.native import native
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
            world.path_is_free(bad, native.Margins(0.0, 0.0, 0.01))
        with pytest.raises(ValueError, match="expected rows of 7"):
            arm.tcp_poses(bad)
    with pytest.raises(ValueError, match="shape"):
        arm.ik(np.eye(3), np.zeros(7), seed=0, starts=1, enough=1, iterations=1,
               position_tolerance=1e-6, rotation_tolerance=1e-6)  # fmt: skip
    with pytest.raises(ValueError, match="a margin for each of 0 pairs"):
        world.path_is_free(np.zeros(7), native.Margins(np.zeros(3), 0.01))
    with pytest.raises(ValueError, match="one more entry than pieces"):
        native.sample_polynomial(np.zeros(3), np.zeros((4, 1, 7)), np.zeros(5))
    with pytest.raises(ValueError, match="unknown shape"):
        native.Obstacle("cone", np.ones(2), np.eye(4))
    with pytest.raises(IndexError):
        native.World(arm, [], [], [0, 1], [])


def test_sampled_polynomials_are_scipys() -> None:
    rng = np.random.default_rng(0)
    breaks, coefficients = np.cumsum(rng.uniform(0.1, 1.0, 6)), rng.normal(size=(5, 5, 7))
    times = np.concatenate([rng.uniform(breaks[0], breaks[-1], 50), breaks])
    position = PPoly(coefficients, breaks)
    expected = np.stack([position(times), *(position.derivative(k)(times) for k in (1, 2, 3))])
    assert native.sample_polynomial(breaks, coefficients, times) == pytest.approx(expected)
