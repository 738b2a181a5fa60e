"""Episodes without cameras: generated, evaluated and exported like any others; there is nothing to picture."""

from __future__ import annotations

import pytest

import roboxim
from roboxim_datasets.formats import open_dataset

TASK = """
skill: pick_up
objects: {target: {models: {values: [cube]}}}
visible: {cameras: []}
reset: {cameras: {names: []}}
"""


@pytest.mark.slow
def test_a_task_without_cameras_is_recorded_evaluated_and_exported(tmp_path):
    task = tmp_path / "blind.yaml"
    task.write_text(TASK)
    demos = roboxim.generate(task=str(task), episodes=1, workers=1, out=tmp_path / "demos")
    assert len(demos.kept) == 1
    assert demos.picture is None
    done = roboxim.evaluate(task=str(task), policies=["expert"], episodes=1, workers=1, out=tmp_path / "evaluation")
    assert done.report.is_file()
    for name in ("rlds", "lerobot", "hdf5"):
        made = getattr(roboxim, f"export_{name}")(tmp_path / "demos", tmp_path / name, val_fraction=0.0)
        [episode] = list(open_dataset(made.path).episodes("train"))
        assert not episode.cameras
        assert sum(1 for _ in episode.steps()) == episode.length
