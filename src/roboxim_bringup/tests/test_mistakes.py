"""A user's mistake on the command line gets one short message that says what to do."""

from __future__ import annotations

import pytest
from click.testing import CliRunner

from roboxim_bringup.cli import group
from roboxim_core.errors import RoboximError


def mistake(*words) -> str:
    """Return what a command answers to a mistake."""
    with pytest.raises(RoboximError) as error:
        CliRunner().invoke(group, [str(word) for word in words], standalone_mode=False, catch_exceptions=False)
    said = str(error.value)
    assert len(said) < 500
    assert "\n" not in said
    return said


@pytest.fixture
def run(tmp_path):
    """A folder that looks like a run of two bags."""
    for number in range(2):
        bag = tmp_path / "run" / "episodes" / f"demo-0-0000{number}-0"
        bag.mkdir(parents=True)
        (bag / "metadata.yaml").touch()
        (bag / f"{bag.name}_0.mcap").write_bytes(b"\x89MCAP0\r\n")
    return tmp_path / "run"


def test_training_needs_a_data_set_not_a_run(run, tmp_path):
    assert f"roboxim export rlds {run} {run}-rlds" in mistake("train", "bc", run, "--out", tmp_path / "bc")
    assert "no such folder" in mistake("train", "bc", tmp_path / "nothere", "--out", tmp_path / "bc")
    assert not (tmp_path / "bc").exists()


def test_training_refuses_a_file_as_its_folder_and_an_empty_configuration(run, tmp_path):
    (tmp_path / "file").touch()
    assert "it is a file; choose another --out" in mistake("train", "bc", run, "--out", tmp_path / "file")
    assert "is empty" in mistake("train", "bc", run, "--config", tmp_path / "file")
