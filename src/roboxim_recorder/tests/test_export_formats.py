"""Every format holds what the bags hold, in the same words; a killed export goes on."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from roboxim_core.errors import RecorderError
from roboxim_datasets.formats import open_dataset
from roboxim_recorder.export import EXPORTERS, export_bags

LOSSLESS = {
    "rlds": ("rlds", {"encoding": "png"}),
    "lerobot 3.0": ("lerobot", {"images": True}),
    "lerobot 2.1": ("lerobot", {"images": True, "version": "2.1"}),
    "hdf5": ("hdf5", {}),
}
FORMATS = {**LOSSLESS, "video 3.0": ("lerobot", {}), "video 2.1": ("lerobot", {"version": "2.1"})}


@pytest.fixture(scope="module")
def run(tmp_path_factory, fake) -> Path:
    """A run's folder with episodes of different lengths and two instructions."""
    folder = tmp_path_factory.mktemp("run")
    for index in range(5):
        instruction = f"Pick up the {'red' if index % 2 else 'blue'} cube"
        fake(index=index, steps=4 + index, instruction=instruction).record(folder)
    return folder


CARD = {"README.md", "preview.jpg"}


def export(run: Path, target: Path, case: str, **options):
    name, own = FORMATS[case]
    return export_bags(name, run, target, EXPORTERS[name]().config(**own, **options))


def contents(folder: Path) -> dict[str, bytes]:
    return {str(f.relative_to(folder)): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}


@pytest.mark.parametrize("case", LOSSLESS)
def test_a_dataset_holds_what_the_bags_hold(case, run, tmp_path, fake):
    maps = {"depth": ("workspace",)} if case != "rlds" else {}
    report = export(run, tmp_path / "out", case, split={"train": 4, "val": 1}, **maps)
    assert (report.splits, report.steps) == ({"train": 4, "val": 1}, 30)
    assert set(report.dead_dimensions) >= {"droll", "dpitch"}
    dataset = open_dataset(report.path)
    assert dataset.format == FORMATS[case][0]
    assert (dataset.description.robot, dataset.description.fps) == ("panda", 10.0)
    assert dataset.features.action == ("dx", "dy", "dz", "droll", "dpitch", "dyaw", "gripper")
    assert sorted(int(episode.metadata["index"]) for episode in dataset.episodes()) == list(range(5))
    for episode in dataset.episodes():
        index = int(episode.metadata["index"])
        bag = fake(index=index, steps=4 + index)
        assert (episode.episode_id, episode.length) == (bag.info.episode_id, bag.steps)
        assert (episode.semantics, episode.success) == (bag.info.semantics, True)
        assert episode.metadata["final_state_hash"] == bag.result.final_state_hash
        assert episode.instruction == f"Pick up the {'red' if index % 2 else 'blue'} cube"
        for step in episode.steps(depth=maps.get("depth", ())):
            label = np.array(bag.label(step.index + 1), np.float32)
            np.testing.assert_array_equal(step.action_executed, label)
            label[3] = 0.0  # below 1e-5
            np.testing.assert_array_equal(step.action, label)
            np.testing.assert_array_equal(step.images["workspace"], bag.image("workspace", step.index))
            np.testing.assert_array_equal(step.images["wrist"], bag.image("wrist", step.index))
            np.testing.assert_array_equal(
                step.proprio["joint_positions"], np.float32(bag.state(step.index).robot.joint_positions)
            )
            assert step.proprio["state"].shape == (10,)
            for depth in step.depth.values():
                np.testing.assert_allclose(depth, bag.depth(step.index), atol=1.26e-4)
            assert step.reward == float(step.index == bag.steps - 1)


@pytest.mark.thorough
@pytest.mark.parametrize("case", ["lerobot 3.0", "hdf5", "video 3.0", "video 2.1"])
def test_two_exports_are_the_same_bytes_and_an_interrupted_one_goes_on(case, run, tmp_path):
    name, own = FORMATS[case]
    config = EXPORTERS[name]().config(**own)
    first = export_bags(name, run, tmp_path / "a", config)

    def interrupt(done, total):
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export_bags(name, run, tmp_path / "b", config, progress=interrupt)
    assert not (tmp_path / "b").exists()
    second = export_bags(name, run, tmp_path / "b", config)
    assert second.resumed <= 3
    assert contents(first.path) == contents(second.path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b"]
    assert export_bags(name, run, tmp_path / "a", config, if_exists="keep").resumed == 5
    with pytest.raises(RecorderError, match="exists"):
        export_bags(name, run, tmp_path / "a", config)


def test_robomimic_finds_its_names(run, tmp_path):
    path = export(run, tmp_path / "out", "hdf5").path
    with h5py.File(path / "dataset.hdf5") as file:
        data = file["data"]
        assert (data.attrs["total"], len(data)) == (30, 5)
        assert '"type": 2' in data.attrs["env_args"]
        assert [name.decode() for name in file["mask/train"]] == ["demo_0", "demo_1", "demo_2", "demo_3"]
        assert [name.decode() for name in file["mask/valid"]] == ["demo_4"]
        demo = data["demo_1"]
        assert demo.attrs["num_samples"] == len(demo["actions"]) == 5
        assert set(demo["obs"]) == {"state", "joint_positions", "workspace_image", "wrist_image"}
        for name, values in demo["obs"].items():
            np.testing.assert_array_equal(demo["next_obs"][name], np.concatenate([values[1:], values[-1:]]))
        assert demo["obs/workspace_image"].shape == (5, 24, 32, 3)
        assert demo["dones"][:].tolist() == [0, 0, 0, 0, 1]


def test_an_hdf5_file_of_another_tool_is_read_without_guesses(run, tmp_path):
    path = export(run, tmp_path / "out", "hdf5").path / "dataset.hdf5"
    with h5py.File(path, "r+") as file:
        del file["data"].attrs["roboxim"], file["mask"]
        for demo in file["data"].values():
            del demo.attrs["roboxim"], demo.attrs["instruction"], demo["sim.action_executed"]
    dataset = open_dataset(path)
    assert dict(dataset.splits) == {"train": 5}
    assert (dataset.description.semantics, dataset.features.vectors["state"][0]) == (None, "state.0")
    episode = dataset.episode(1)
    assert (episode.instruction, episode.success, episode.episode_id) == ("Pick up the red cube", True, "demo_1")
    step = next(episode.steps())
    assert step.action_executed is None
    assert step.images["workspace"].shape == (24, 32, 3)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["video 3.0", "video 2.1", "hdf5"])
def test_an_export_killed_again_and_again_gives_the_same_bytes(case, run, tmp_path):
    whole = contents(export(run, tmp_path / "whole", case).path)
    name, own = FORMATS[case]
    code = (
        "import sys; from pathlib import Path; from roboxim_recorder.export import EXPORTERS, export_bags\n"
        f"config = EXPORTERS[{name!r}]().config(**{own!r})\n"
        "print('ready', flush=True)\n"
        f"export_bags({name!r}, Path(sys.argv[1]), Path(sys.argv[2]), config, if_exists='keep')\n"
    )
    target = tmp_path / "killed"
    kills = 0
    for attempt in range(10):
        process = subprocess.Popen([sys.executable, "-c", code, run, target], stdout=subprocess.PIPE)
        process.stdout.readline()
        try:
            process.wait(0.05 + 0.2 * attempt)  # whenever it is killed, it must not matter
            break
        except subprocess.TimeoutExpired:
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
            kills += 1
            found = contents(target)  # the card is written last, by the next call if need be
            assert not found or {k: v for k, v in whole.items() if k not in CARD} == {
                k: v for k, v in found.items() if k not in CARD
            }
    else:
        process = subprocess.run([sys.executable, "-c", code, run, target], check=True)
    assert kills
    assert contents(target) == whole


@pytest.mark.slow
def test_memory_does_not_grow_with_an_episode(tmp_path, fake):
    """An episode of 40 times as many steps needs no more memory than its numbers."""
    peaks = []
    for steps in (5, 200):
        folder = tmp_path / str(steps)
        fake(steps=steps).record(folder)
        code = (
            "import resource, sys; from pathlib import Path; from roboxim_recorder.export import export_bags\n"
            "export_bags('lerobot', Path(sys.argv[1]), Path(sys.argv[2]))\n"
            "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)\n"
        )
        command = [sys.executable, "-c", code, folder, tmp_path / f"out{steps}"]
        peaks.append(int(subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()[-1]))
    assert peaks[1] - peaks[0] < 40_000  # KiB
