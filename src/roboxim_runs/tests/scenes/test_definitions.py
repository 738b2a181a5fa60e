"""Files that a task names count in the configuration of its run."""

import shutil
from pathlib import Path

import pytest

from roboxim_core.config import to_plain
from roboxim_core.config_folders import config_dir
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError
from roboxim_runs.episodes.generation import GenerationConfig, generate
from roboxim_runs.episodes.task_choice import cells_of, task_text
from roboxim_runs.executors import Done
from roboxim_runs.scenes.definitions import definitions_of, task_files

MIX = """
cells: [{tasks: [mine], models: {target: [mug2]}}]
set:
  scene: bare
  wordings: trained
  reset:
    cameras: {names: [workspace, near], views: {near: {values: [far]}}}
    look: {set: rooms, lights: {values: [dusk]}}
    surfaces: {table: {texture: {values: [PICTURE]}}}
"""
CHANGES = {
    "cameras/workspace.yaml": "rate_hz: 5\n",
    "cameras/far.yaml": "rate_hz: 5\n",
    "scenes/bare.yaml": "control_rate_hz: 5\n",
    "looks/rooms.yaml": "  other: {background: plain}\n",
    "lights/dusk.yaml": "ambient: [0.1, 0.2, 0.3]\n",
    "wordings/pick_up.yaml": "more: ['Hold the {target}']\n",
    "tasks/mine.yaml": "max_draws: 7\n",
    "objects/mug2.yaml": "# even a comment\n",
    "wood.png": "other",
}
"""File of the user's folder to what is appended to it."""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """Return a folder with the user's own files."""
    folder = tmp_path / "own"
    for name, text in {
        "cameras/far.yaml": "eye: [1, 0, 1]\ntarget: [0.5, 0, 0]\n",
        "scenes/bare.yaml": "cameras: []\n",
        "looks/rooms.yaml": "looks:\n  one: {background: plain}\n",
        "lights/dusk.yaml": "lights: []\n",
        "tasks/mine.yaml": "skill: pick_up\n",
        "wood.png": "picture",
        "tasks/mix.yaml": MIX.replace("PICTURE", str(folder / "wood.png")),
    }.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    for kind, name, copy in (
        ("cameras", "workspace", "workspace"), ("wordings", "pick_up", "pick_up"), ("objects", "cube", "mug2"),
    ):  # fmt: skip
        (folder / kind).mkdir(exist_ok=True)
        shutil.copy(config_dir() / kind / f"{name}.yaml", folder / kind / f"{copy}.yaml")
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(folder))
    return folder


def definitions(folder):
    text = task_text(str(folder / "tasks" / "mix.yaml"))
    return definitions_of(cells_of(text), task_files(text))


def test_every_file_that_a_mix_names_is_among_its_definitions(own):
    before = definitions(own)
    for name in CHANGES:
        if name.endswith(".yaml") and not name.startswith("objects"):
            (own / name).write_text(f"{(own / name).read_text()}# a comment\n")
    assert definitions(own) == before
    for name, more in CHANGES.items():
        (own / name).write_text((own / name).read_text() + more)
    after = definitions(own)
    assert {key for key in after if after[key] != before[key]} == {
        "camera workspace", "camera far", "scene bare", "look rooms", "light dusk", "wording pick_up", "task mine",
        "model mug2", "file config://wood.png",
    }  # fmt: skip
    assert {key.partition(" ")[0] for key in after if after[key] == before[key]} == {"model"}, "the robot's"


class Executor:
    """An executor whose episodes succeed."""

    def run(self, work, jobs, **_):
        for job in jobs:
            made = EpisodeResult(episode_id=f"demo-0-{job.data:05d}-0", index=job.data, outcome="success")
            yield Done(key=job.key, value=to_plain(made))


def test_a_run_does_not_continue_with_another_camera(own, tmp_path):
    def run(episodes):
        task = str(own / "tasks" / "mix.yaml")
        return generate(GenerationConfig(out=tmp_path / "out", task=task, episodes=episodes), executor=Executor())

    run(1)
    assert len(run(2).results) == 2
    camera = Path(own, "cameras", "far.yaml")
    camera.write_text(camera.read_text().replace("[1, 0, 1]", "[1, 0, 2]"))
    with pytest.raises(ConfigError, match=r"another configuration \(definitions.camera far: .* choose another output"):
        run(3)
