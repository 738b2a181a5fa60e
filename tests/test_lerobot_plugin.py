"""The genuine LeRobot evaluates in RoboXim, in an empty environment with nothing but wheels (`make try-lerobot`)."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))

from environments import SetupError  # noqa: E402
from try_lerobot import PYTHON, Trial, interpreter  # noqa: E402


@pytest.mark.slow  # 6 GB of packages, minutes
def test_lerobots_own_commands_evaluate_in_roboxim(tmp_path):
    try:
        interpreter(PYTHON)
    except SetupError as error:
        pytest.skip(str(error))
    trial = Trial(tmp_path)
    versions = trial.install()
    assert versions["lerobot"].startswith("0.6."), versions
    result = trial.evaluate()
    assert str(result["make_env"]).startswith("success after "), result
    assert result["episodes"] == 2, result
