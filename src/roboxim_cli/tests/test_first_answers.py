"""Commands that only read import no library that they do not use, so that their first answer is quick."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

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


AT_ONCE = {
    "action", "completion", "demo", "doctor", "down", "env", "interface", "node", "param", "runs", "schema", "service",
    "topic", "bag info", "dataset info", "experiment list", "planner dumps",
    "policy conventions", "policy describe", "policy list", "policy new-server", "tasks",
}  # fmt: skip
"""Commands that answer at once, or, of a running graph, say themselves for what they wait."""
BEGUN = f"""
import sys, click
from roboxim_cli.main import group
echo = click.echo
def heard(text, **more):
    echo(text, **more)
    print("imported:", sorted(sys.modules.keys() & {NUMERICS!r}), flush=True)
click.echo = heard
group.main(sys.argv[1:], prog_name="roboxim", standalone_mode=False)
"""
"""Runs a command and prints, with each line that it says, which libraries it has imported until then."""
WALK = """
import sys, click
from roboxim_cli.main import group
def walk(group, context, name):
    for word in group.list_commands(context):
        command = group.get_command(context, word)
        if isinstance(command, click.Group):
            walk(command, click.Context(command), [*name, word])
        else:
            print(" ".join([*name, word]), getattr(command, "begins", ""), sep=":")
walk(group, click.Context(group), [])
assert not (found := sorted(sys.modules.keys() & set(sys.argv[1].split()))), f"imports {found}"
"""


def imports_none(forbidden: set[str], *words: object) -> str:
    """Run a command in a new process, which must not import a module; return its output."""
    command = [sys.executable, "-c", SCRIPT, *map(str, words), " ".join(forbidden)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    assert done.returncode == 0, f"{words}: {done.stderr}"
    return done.stdout


def test_every_slow_command_says_at_once_what_begins():
    words = [sys.executable, "-c", WALK, " ".join(NUMERICS - {"rclpy"})]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    assert done.returncode == 0, done.stderr
    said = dict(line.split(":") for line in done.stdout.splitlines())
    silent = {name for name, begins in said.items() if not begins}
    assert {name for name in silent if not {name, name.split()[0]} & AT_ONCE} == set()


@pytest.mark.thorough
def test_a_conversion_says_what_begins_before_its_libraries_are_imported(tmp_path):
    words = ["dataset", "convert", "lerobot", tmp_path / "none", "--out", tmp_path / "out"]
    done = subprocess.run([sys.executable, "-c", BEGUN, *map(str, words)], capture_output=True, text=True, check=False)
    assert done.stderr.startswith("converting ...\n"), done.stderr
    assert done.stdout == "imported: []\n"


def test_help_and_runs_import_no_library(runtime):
    for words in (["--help"], ["generate", "--help"], ["runs"]):
        imports_none(NUMERICS | READING, *words)


def test_help_of_exports_imports_no_library_of_a_format():
    assert "--where" in imports_none(NUMERICS, "export", "rlds", "--help")
    assert "SOURCE" in imports_none(NUMERICS | {"mcap"}, "dataset", "convert", "lerobot", "--help")


@pytest.mark.thorough
def test_a_task_is_sampled_without_a_library_of_images():
    assert imports_none({"PIL", "cv2"}, "tasks", "sample", "--seed", "1")


@pytest.mark.thorough
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
