"""Read an exported LeRobot dataset with the package lerobot itself: `verify_lerobot.py DATASET`.

Every frame is loaded through `LeRobotDataset` and compared with the file's frame of the same number, which FFmpeg
decodes in order. Windows (`delta_timestamps`), statistics, instructions and indices are compared with values computed
here. Warnings about the dataset are problems.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ["HF_HUB_OFFLINE"] = os.environ["HF_DATASETS_OFFLINE"] = "1"

import av  # noqa: E402 - after the environment
import lerobot  # noqa: E402
import numpy as np  # noqa: E402
import pyarrow.parquet as pq  # noqa: E402
import torch  # noqa: E402
from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: E402

ABOUT_THE_ENVIRONMENT = ("torchcodec", "video decoding", "video encoding", "torchvision")
"""Words of warnings that tell of the environment and not of the dataset."""


class Problems(logging.Handler):
    """Collects problems, and warnings that the library logs."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.found: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Collect a logged warning."""
        self.warning(record.getMessage())

    def warning(self, text: str) -> None:
        """Collect a warning about the dataset."""
        if not any(word in text.lower() for word in ABOUT_THE_ENVIRONMENT):
            self.found.append(f"warning: {text}")

    def require(self, right: Any, text: str) -> None:
        """Collect a problem."""
        if not bool(right):
            self.found.append(text)


def frames_in_order(dataset: LeRobotDataset, key: str, root: Path) -> Iterator[np.ndarray]:
    """Decode the videos of a camera from their beginning, one after another."""
    files = dict.fromkeys(
        str(dataset.meta.get_video_file_path(episode, key)) for episode in range(dataset.meta.total_episodes)
    )
    for name in files:
        with av.open(str(root / name)) as container:
            for frame in container.decode(video=0):
                yield frame.to_rgb().to_ndarray()


def subtasks_of(root: Path) -> list[str]:
    """Return the subtasks of a dataset by their number, read without lerobot."""
    if (root / "meta" / "subtasks.jsonl").exists():
        rows = [json.loads(line) for line in (root / "meta" / "subtasks.jsonl").read_text().splitlines()]
    else:
        rows = pq.read_table(root / "meta" / "subtasks.parquet").to_pylist()
    return [row["subtask"] for row in sorted(rows, key=lambda row: row["subtask_index"])]


def check_frames(dataset: LeRobotDataset, root: Path, problems: Problems) -> None:
    """Load every frame and compare it with what the files hold at its place."""
    meta = dataset.meta
    videos = {key: frames_in_order(dataset, key, root) for key in meta.video_keys}
    subtasks = subtasks_of(root) if "subtask_index" in meta.features else []
    expected_index = 0
    for episode in range(meta.total_episodes):
        about = meta.episodes[episode]
        for frame_index in range(about["length"]):
            item = dataset[expected_index]
            place = f"episode {episode}, frame {frame_index}"
            problems.require(item["index"].item() == expected_index, f"{place}: index {item['index']}")
            problems.require(item["episode_index"].item() == episode, f"{place}: of episode {item['episode_index']}")
            problems.require(item["frame_index"].item() == frame_index, f"{place}: number {item['frame_index']}")
            time = np.float32(frame_index / meta.fps)
            problems.require(item["timestamp"].item() == time, f"{place}: at {item['timestamp']} s, expected {time}")
            problems.require(item["task"] == about["tasks"][0], f"{place}: task '{item['task']}'")
            if subtasks:
                words = subtasks[item["subtask_index"].item()]
                problems.require(words.strip(), f"{place}: an empty subtask")
                if lerobot.__version__.startswith("0.4"):  # later and earlier ones do not read the words
                    problems.require(item["subtask"] == words, f"{place}: subtask '{item['subtask']}', not '{words}'")
            for key, frames in videos.items():
                shown = (item[key].permute(1, 2, 0).numpy() * 255).round().astype(np.int16)
                difference = int(np.abs(shown - next(frames).astype(np.int16)).max())
                problems.require(difference <= 1, f"{place}: {key} is another frame, pixels differ by {difference}")
            for key in meta.image_keys:
                problems.require(tuple(item[key].shape[1:]) == tuple(meta.shapes[key][:2]), f"{place}: shape of {key}")
            expected_index += 1
    problems.require(expected_index == len(dataset) == meta.total_frames, f"{len(dataset)} frames, {expected_index}")
    for key, frames in videos.items():
        problems.require(next(frames, None) is None, f"the videos of {key} have frames that no step uses")


def column(dataset: LeRobotDataset, key: str) -> np.ndarray:
    """Return a column of numbers, shape (N, size)."""
    values = dataset.hf_dataset.with_format("numpy")[key]
    return np.asarray(values[:]).reshape(len(dataset), -1)


def check_windows(dataset: LeRobotDataset, root: Path, action: str, problems: Problems) -> None:
    """Compare windows of actions and images around some frames with the frames themselves."""
    fps, meta = dataset.fps, dataset.meta
    steps = {action: [-2, -1, 0, 1, 5, 15], **{key: [-3, 0] for key in meta.camera_keys}}
    windows = LeRobotDataset(
        "local/dataset",
        root=root,
        video_backend="pyav",
        delta_timestamps={key: [step / fps for step in offsets] for key, offsets in steps.items()},
    )
    actions, episodes = column(dataset, action), column(dataset, "episode_index")[:, 0]
    chosen = np.random.default_rng(0).choice(len(dataset), min(60, len(dataset)), replace=False)
    for index in sorted({0, len(dataset) - 1, *map(int, chosen)}):
        item = windows[index]
        first, last = np.flatnonzero(episodes == episodes[index])[[0, -1]]
        for key, offsets in steps.items():
            wanted = [index + offset for offset in offsets]
            inside = np.clip(wanted, first, last)
            padded = [at != number for at, number in zip(inside, wanted, strict=True)]
            problems.require(item[f"{key}_is_pad"].tolist() == padded, f"frame {index}: padding of {key}")
            if key == action:
                problems.require(np.array_equal(item[key].numpy(), actions[inside]), f"frame {index}: window of {key}")
            else:
                same = all(torch.equal(item[key][i], dataset[int(at)][key]) for i, at in enumerate(inside))
                problems.require(same, f"frame {index}: window of {key}")


def check_statistics(dataset: LeRobotDataset, root: Path, problems: Problems) -> None:
    """Compare the statistics with values computed from all rows, and of images from some frames."""
    stats = {key: {name: np.asarray(value) for name, value in of.items()} for key, of in dataset.meta.stats.items()}
    file = root / "meta" / "stats.json"
    stored = json.loads(file.read_text()) if file.exists() else {}
    for key, feature in dataset.meta.features.items():
        problems.require(key in stats and key in stored, f"no statistics of {key}")
        if key not in stats or key not in stored:
            continue
        if feature["dtype"] in ("video", "image"):
            problems.require(stats[key]["mean"].shape == (feature["shape"][2], 1, 1), f"shape of statistics of {key}")
            if feature["shape"][2] == 3:
                check_image_statistics(dataset, key, stats[key], problems)
            continue
        values = column(dataset, key).astype(np.float64)
        expected = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
        for name, value in expected.items():
            near = np.allclose(stats[key][name], value, rtol=1e-5, atol=1e-6)
            problems.require(near, f"{key}: {name} {stats[key][name]}, recomputed {value}")
        for name, probability in (("q01", 0.01), ("q10", 0.1), ("q50", 0.5), ("q90", 0.9), ("q99", 0.99)):
            value = np.quantile(values, probability, axis=0)
            near = np.allclose(stored[key][name], value, rtol=1e-6, atol=1e-7)
            problems.require(near, f"{key}: {name} {stored[key][name]}, recomputed {value}")


def check_image_statistics(dataset: LeRobotDataset, key: str, stats: dict[str, Any], problems: Problems) -> None:
    """Compare mean and deviation of a camera with those of every tenth frame."""
    pixels = torch.stack([dataset[index][key] for index in range(0, len(dataset), 10)]).double()
    mean, std = pixels.mean((0, 2, 3)), pixels.std((0, 2, 3))
    problems.require(np.allclose(stats["mean"].ravel(), mean, atol=0.02), f"{key}: mean {stats['mean']}, {mean}")
    problems.require(np.allclose(stats["std"].ravel(), std, atol=0.02), f"{key}: std {stats['std']}, {std}")


def verify(root: Path) -> int:
    """Check a dataset, print its contents and problems, and return the number of problems."""
    problems = Problems()
    logging.getLogger().addHandler(problems)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        dataset = LeRobotDataset("local/dataset", root=root, video_backend="pyav")
        meta = dataset.meta
        print(
            f"lerobot {lerobot.__version__}: {root}, version {meta.info['codebase_version']}, robot {meta.robot_type}"
        )
        print(f"{meta.total_episodes} episodes, {len(dataset)} frames at {dataset.fps} Hz, {meta.total_tasks} tasks")
        if "subtask_index" in meta.features:
            print(f"subtasks: {', '.join(subtasks_of(root)[:5])}")
        print(f"cameras: {', '.join(f'{key} {meta.shapes[key]}' for key in meta.camera_keys)}")
        action = next(key for key in ("action", "actions") if key in meta.features)
        check_frames(dataset, root, problems)
        check_windows(dataset, root, action, problems)
        check_statistics(dataset, root, problems)
        batch = next(iter(torch.utils.data.DataLoader(dataset, batch_size=8, shuffle=True)))
        print(f"a batch: {', '.join(f'{k} {tuple(v.shape)}' for k, v in batch.items() if hasattr(v, 'shape'))}")
    for warning in {str(each.message) for each in caught}:
        problems.warning(warning)
    for problem in problems.found[:20]:
        print(f"PROBLEM {problem}")
    print(f"{len(problems.found)} problems" if problems.found else "no problems found")
    return len(problems.found)


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path, help="the dataset's folder, which holds meta/info.json")
    return 1 if verify(parser.parse_args().dataset.resolve()) else 0


if __name__ == "__main__":
    sys.exit(main())
