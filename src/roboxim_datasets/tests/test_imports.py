"""A format's libraries are imported when a dataset of that format is read or written, and not before."""

from __future__ import annotations

import subprocess
import sys

import pytest

SCRIPT = """
import sys
from pathlib import Path
from roboxim_datasets.formats import open_dataset
from roboxim_datasets.plans import plan_of
from roboxim_datasets.rewrite import write_dataset
source, target, format = sys.argv[1:]
written = write_dataset(plan_of(open_dataset(source)), Path(target), format, how="convert")
open_dataset(written.path)
heavy = {"h5py", "pyarrow", "av", "pandas", "scipy", "trimesh", "pinocchio", "jinja2", "jax", "rclpy", "tensorflow"}
print(*sorted(heavy & sys.modules.keys()))
"""


@pytest.mark.thorough
@pytest.mark.parametrize(("format", "expected"), [("rlds", []), ("hdf5", ["h5py"]), ("lerobot", ["pyarrow"])])
def test_a_format_imports_its_own_libraries_alone(tmp_path, write, format, expected):
    write(tmp_path / "source", train=[0])
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, tmp_path / "source", tmp_path / "target", format],
        capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == expected
