"""A dataset that another tool wrote, to every format and back: ``SOURCE=folder pytest -m slow ... test_genuine.py``.

Octo's debug set (``tests/debug_dataset`` of its repository), what lerobot's writer makes, and what robosuite and
robomimic's scripts make are measured so; docs/how-to/data.md has the results. None of them is part of this repository.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from roboxim_datasets.compare import compare
from roboxim_datasets.dataset import Dataset
from roboxim_datasets.formats import FORMATS, open_dataset
from roboxim_datasets.lerobot import LeRobotOptions
from roboxim_datasets.plans import plan_of
from roboxim_datasets.rewrite import write_dataset
from roboxim_datasets.rlds.dataset import RldsOptions

SOURCE = os.environ.get("SOURCE", "")
OPTIONS = {"lerobot": LeRobotOptions(images=True), "rlds": RldsOptions(encoding="png"), "hdf5": None}
"""Options with which images are stored without loss."""


@pytest.mark.slow
@pytest.mark.skipif(not SOURCE, reason="SOURCE names no dataset")
@pytest.mark.parametrize("format", list(FORMATS))
def test_a_dataset_of_another_tool_survives_every_format(format: str, tmp_path: Path) -> None:
    source = open_dataset(SOURCE)
    rate = source.description.fps or 5.0
    made = open_dataset(_written(source, tmp_path / "there", format, rate))
    back = open_dataset(_written(made, tmp_path / "back", source.format, rate))
    for found in (made, back):
        said = {str(difference) for difference in compare(source, found, images="exact").differences}
        assert said <= {f"steps per second: 0.0 against {rate}"}


def _written(source: Dataset, target: Path, format: str, rate: float) -> Path:
    fps = 0.0 if source.description.fps else rate
    return write_dataset(plan_of(source), target, format, OPTIONS[format], how="convert", fps=fps).path
