"""Commands that only read import no library that they do not use, so that their first answer is quick."""

from __future__ import annotations

import subprocess
import sys

import numpy as np

from roboxim_core.vision.images import encode_image
from roboxim_datasets.rlds import RldsEpisode, RldsFeatures, RldsWriter
from roboxim_ros.testing import PATIENCE_S

NUMERICS = {
    "scipy", "trimesh", "networkx", "pinocchio", "coal", "ompl", "pybullet", "cv2", "jax", "h5py", "pyarrow", "av",
    "matplotlib", "jinja2", "rclpy", "ruamel.yaml",
}  # fmt: skip
READING = {"numpy", "cattrs", "yaml", "mcap", "rosbags", "PIL"}
SCRIPT = """
import sys
from roboxim_cli.main import group
*words, forbidden = sys.argv[1:]
try:
    group.main(words, prog_name="roboxim", standalone_mode=False)
finally:
    found = sorted(sys.modules.keys() & set(forbidden.split()))
    assert not found, f"imports {found}"
"""


def imports_none(forbidden: set[str], *words: object) -> str:
    """Run a command in a new process, which must not import a module; return its output."""
    command = [sys.executable, "-c", SCRIPT, *map(str, words), " ".join(forbidden)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    assert done.returncode == 0, f"{words}: {done.stderr}"
    return done.stdout


def test_help_and_runs_import_no_library(runtime):
    for words in (["--help"], ["generate", "--help"], ["runs"]):
        imports_none(NUMERICS | READING, *words)


def test_help_of_exports_imports_no_library_of_a_format():
    assert "--where" in imports_none(NUMERICS, "export", "rlds", "--help")
    assert "SOURCE" in imports_none(NUMERICS | {"mcap"}, "dataset", "convert", "lerobot", "--help")


def test_a_task_is_sampled_without_a_library_of_images():
    assert imports_none({"PIL", "cv2"}, "tasks", "sample", "--seed", "1")


def test_a_folder_and_a_dataset_are_described_without_numerics(tmp_path):
    (tmp_path / "run.json").write_text("{}")
    imports_none(NUMERICS, "runs", tmp_path)
    features = RldsFeatures(images={"image": (8, 8)}, encoding="png")
    picture = encode_image(np.zeros((8, 8, 3), np.uint8), "png")
    with RldsWriter(tmp_path / "a", features, name="theirs", version="1.0.0", description="Theirs.") as writer:
        episode = RldsEpisode(
            images={"image": [picture] * 2}, vectors={}, action=np.ones((2, 7), np.float32), instruction="a task",
            reward=np.float32([0, 1]), metadata={},
        )  # fmt: skip
        writer.add("train", episode)
    assert "1 train" in imports_none(NUMERICS | {"mcap"}, "dataset", "info", tmp_path / "a")
