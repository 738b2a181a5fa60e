"""A command whose extra is not installed names it, in a process that cannot import the extra's modules."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import trimesh

from roboxim_core.plain_data.extras import EXTRAS

pytest.importorskip("rclpy")

HIDE = """
import os
from importlib.machinery import PathFinder
hidden, found = os.environ["HIDDEN_MODULES"].split(), PathFinder.find_spec
PathFinder.find_spec = classmethod(
    lambda cls, name, path=None, target=None: None if name.partition(".")[0] in hidden else found(name, path, target)
)
"""
CLI = ("-m", "roboxim_cli")
CASES = {
    "assets": (*CLI, "assets", "import", "ring.stl", "--noun", "ring"),
    "learn": (*CLI, "evaluate", "--policy", "bc", "--checkpoint", "CHECKPOINT", "--episodes", "1", "--out", "e"),
    "lerobot": (*CLI, "export", "lerobot", "BAGS", "--out", "dataset"),
    "pretrained": (*CLI, "train", "act", "RLDS", "--out", "act"),
    "ray": (*CLI, "evaluate", "--policy", "random", "--episodes", "1", "--executor", "ray", "--out", "e"),
    "store": (*CLI, "generate", "--episodes", "1", "--store", "s3://bucket/demos", "--out", "g"),
    "studio": (*CLI, "studio"),
    "video": (*CLI, "export", "lerobot", "BAGS", "--out", "dataset"),
    "vla-eval": ("-c", "import roboxim.vla_eval"),
}
"""Extra to a command that needs it."""


def run(words: tuple[str, ...], folder: Path, hidden: str) -> subprocess.CompletedProcess[str]:
    (folder / "sitecustomize.py").write_text(HIDE)
    path = os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])
    return subprocess.run(
        [sys.executable, *words], cwd=folder, env=os.environ | {"HIDDEN_MODULES": hidden, "PYTHONPATH": path},
        capture_output=True, text=True, stdin=subprocess.DEVNULL, check=False,
    )  # fmt: skip


@pytest.mark.thorough
@pytest.mark.parametrize("extra", CASES)
def test_a_command_without_its_extra_names_it(extra, tmp_path, small_bc, expert_bag):
    trimesh.creation.annulus(0.02, 0.04, 0.03).export(tmp_path / "ring.stl")  # not convex
    places = {"CHECKPOINT": str(small_bc)}
    if extra in ("lerobot", "pretrained", "video"):
        places["BAGS"] = str(expert_bag(seed=5, size=32)[0])
    if extra == "pretrained":
        made = run((*CLI, "export", "rlds", places["BAGS"], "--out", "rlds"), tmp_path, "")
        assert made.returncode == 0, made.stderr
        places["RLDS"] = "rlds"
    done = run(tuple(places.get(word, word) for word in CASES[extra]), tmp_path, " ".join(EXTRAS[extra]))
    assert done.returncode != 0, done.stdout
    named = "lerobot" if extra == "video" else extra  # which brings the same package
    assert f"roboxim[{named}]" in done.stderr, done.stderr
    assert CASES[extra][0] == "-c" or "Traceback" not in done.stderr, done.stderr


def test_every_extra_has_a_case():
    assert set(CASES) == set(EXTRAS)
