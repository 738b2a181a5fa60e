"""Every format holds the same: episodes from real bags go through each of them, there and back."""

from __future__ import annotations

import pytest

from roboxim_bringup.core_graph import CoreGraph
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_datasets.compare import compare, comparison_text
from roboxim_datasets.formats import FORMATS, open_dataset
from roboxim_datasets.plans import plan_of
from roboxim_datasets.rewrite import write_dataset
from roboxim_recorder.export import EXPORTERS, export_bags
from roboxim_runs.episodes.task_choice import task_text

TASKS = ("pick_cube", "place_on", "open_drawer")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Demonstrations of three skills, with noise, so that labels and executed actions differ."""
    folder = tmp_path_factory.mktemp("run")
    with CoreGraph(folder) as graph:
        for index, task in enumerate(TASKS):
            config = RunConfig(
                run_seed=5, purpose="demo", task_config=task_text(task), image_width=64, image_height=64,
                noise_translation_m=0.003, noise_rotation_rad=0.01, output_dir=str(folder),
            )  # fmt: skip
            assert EpisodeRunner(graph.ports, config).run_index(index).outcome == "success"
    return folder


KINDS = {
    "rlds": ("rlds", {"encoding": "jpeg"}),
    "rlds_png": ("rlds", {"encoding": "png"}),
    "lerobot_3.0": ("lerobot", {"version": "3.0"}),
    "lerobot_2.1": ("lerobot", {"version": "2.1"}),
    "lerobot_images": ("lerobot", {"version": "3.0", "images": True}),
    "hdf5": ("hdf5", {}),
}
SELECTIONS = {
    "default": {},
    "slower": {"rate_hz": 5.0, "actions": "end_effector_absolute,rotation_6d", "state": "joint_positions"},
    "joints": {"actions": "joint_velocity,absolute_open_0_closed_1"},
}


def require_equal(a, b):
    found = compare(a, b)
    assert found.equal, comparison_text(found, {"a": str(a.path), "b": str(b.path)})


@pytest.mark.slow
@pytest.mark.parametrize("selection", SELECTIONS)
def test_all_formats_hold_the_same(run, tmp_path, selection):
    opened = {}
    for name, (exporter, own) in KINDS.items():
        config = EXPORTERS[exporter]().config(keep_recovered=True, **SELECTIONS[selection], **own)
        opened[name] = open_dataset(export_bags(exporter, run, tmp_path / name, config).path)
    assert len(opened["hdf5"]) == len(TASKS)
    for name, dataset in opened.items():
        require_equal(opened["rlds_png"], dataset)
        assert (dataset.folder / "README.md").is_file(), name
        assert dataset.summaries()["action"]["q99"], name
    for lossless in ("rlds_png", "lerobot_images", "hdf5"):
        assert compare(opened["rlds_png"], opened[lossless]).compared["images"] == "pixel by pixel"


@pytest.mark.slow
@pytest.mark.parametrize("target", ["rlds", "lerobot", "hdf5"])
@pytest.mark.parametrize("source", ["rlds_png", "lerobot_2.1", "hdf5"])
def test_a_converted_dataset_is_the_same(run, tmp_path, source, target):
    exporter, own = KINDS[source]
    config = EXPORTERS[exporter]().config(keep_recovered=True, **own)
    first = open_dataset(export_bags(exporter, run, tmp_path / "a", config).path)
    lossless = {"rlds": {"encoding": "png"}, "lerobot": {"images": True}, "hdf5": {}}[target]
    options = FORMATS[target]().options(**lossless)
    written = write_dataset(plan_of(first), tmp_path / "b", target, options, how="convert")
    found = compare(first, open_dataset(written.path), images="exact")
    assert found.equal, comparison_text(found, {"a": source, "b": target})
