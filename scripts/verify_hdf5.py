"""Read an exported HDF5 dataset with robomimic's `SequenceDataset`, and with h5py: `verify_hdf5.py DATASET`.

Every item is compared with the file: windows of actions and observations, padding at the ends of episodes, splits.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import h5py
import numpy as np
import robomimic.utils.obs_utils as obs_utils
import torch
from robomimic.utils.dataset import SequenceDataset

WINDOW = 4


def check_file(file: h5py.File) -> tuple[list[str], list[str], list[str]]:
    """Check the file's layout; return problems, and the names of low-dimensional and of image observations."""
    problems, data = [], file["data"]
    total = sum(demo.attrs["num_samples"] for demo in data.values())
    if data.attrs["total"] != total:
        problems.append(f"total is {data.attrs['total']}, the episodes have {total} steps")
    json.loads(data.attrs["env_args"])
    names = sorted(data["demo_0"]["obs"])
    for name, demo in data.items():
        count = demo.attrs["num_samples"]
        if sorted(demo["obs"]) != names:
            problems.append(f"{name}: observations {sorted(demo['obs'])}, expected {names}")
        for key in ("actions", "rewards", "dones", *(f"obs/{key}" for key in demo["obs"])):
            if len(demo[key]) != count or not np.isfinite(demo[key][:]).all():
                problems.append(f"{name}/{key}: {len(demo[key])} rows, expected {count} finite ones")
        if demo["dones"][:].tolist() != [0] * (count - 1) + [1]:
            problems.append(f"{name}: dones {demo['dones'][:]}")
        if "subtask_index" in demo:
            words = json.loads(demo.attrs["roboxim"])["subtasks"]
            numbers = demo["subtask_index"][:]
            if len(numbers) != count or not all(words[number].strip() for number in numbers):
                problems.append(f"{name}: subtasks {numbers} of {words}")
    masked = [name.decode() for mask in file["mask"].values() for name in mask[:]]
    if sorted(masked) != sorted(data):
        problems.append("the masks do not name every episode once")
    images = [name for name in names if data["demo_0"]["obs"][name].ndim == 4]
    return problems, [name for name in names if name not in images], images


def check_items(path: Path, file: h5py.File, mask: str, low: list[str], images: list[str]) -> list[str]:
    """Compare every item of a split that robomimic returns with the file."""
    subtask = ("subtask_index",) if "subtask_index" in file["data/demo_0"] else ()
    dataset = SequenceDataset(
        hdf5_path=str(path), obs_keys=(*low, *images), dataset_keys=("actions", "rewards", "dones", *subtask),
        frame_stack=1, seq_length=WINDOW, pad_frame_stack=True, pad_seq_length=True, get_pad_mask=True, goal_mode=None,
        hdf5_cache_mode=None, hdf5_use_swmr=False, load_next_obs=True, filter_by_attribute=mask,
    )  # fmt: skip
    problems, at = [], 0
    names = sorted((name.decode() for name in file[f"mask/{mask}"][:]), key=lambda name: int(name[5:]))
    for name in names:
        demo = file["data"][name]
        count = demo.attrs["num_samples"]
        for step in range(count):
            item, inside = dataset[at], np.clip(np.arange(step, step + WINDOW), 0, count - 1)
            if not np.array_equal(item["actions"], demo["actions"][:][inside]):
                problems.append(f"{name}, step {step}: window of actions")
            if item["pad_mask"].ravel().tolist() != [step + i < count for i in range(WINDOW)]:
                problems.append(f"{name}, step {step}: padding")
            if subtask and not np.array_equal(item["subtask_index"], demo["subtask_index"][:][inside]):
                problems.append(f"{name}, step {step}: window of subtasks")
            for key in (*low, *images):
                for group, row in (("obs", step), ("next_obs", min(step + 1, count - 1))):
                    shown, stored = item[group][key][0], demo["obs"][key][row]
                    if key in images:
                        stored = np.moveaxis(stored.astype(np.float32) / 255, -1, 0) if shown.shape[0] == 3 else stored
                    if not np.allclose(shown, stored, atol=1e-6):
                        problems.append(f"{name}, step {step}: {group}/{key}")
            at += 1
    if at != len(dataset):
        problems.append(f"{mask}: {len(dataset)} items, expected {at}")
    batch = next(iter(torch.utils.data.DataLoader(dataset, batch_size=8)))
    print(f"{mask}: {len(names)} episodes, {at} items; a batch of actions {tuple(batch['actions'].shape)}")
    return problems


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path, help="the dataset's folder, or its HDF5 file")
    path = parser.parse_args().dataset
    path = path if path.is_file() else path / "dataset.hdf5"
    with h5py.File(path) as file:
        problems, low, images = check_file(file)
        print(f"{path}: {len(file['data'])} episodes, {file['data'].attrs['total']} steps; {low}, images {images}")
        flat = [name for name in images if file["data/demo_0/obs"][name].shape[-1] != 3]
        images = [name for name in images if name not in flat]
        obs_utils.initialize_obs_utils_with_obs_specs({"obs": {"low_dim": low, "rgb": images}})
        for mask in file["mask"]:
            problems += check_items(path, file, mask, low, images)
    for problem in problems[:20]:
        print(f"PROBLEM {problem}")
    print(f"{len(problems)} problems" if problems else "no problems found")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
