"""Small datasets as other tools write them: no file of RoboXim's beside them."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from roboxim_datasets.rlds.tfrecord import encode_example, write_record

EPISODES, STEPS, SIDE = 3, 4, 8
CAMERA = "observation.images.top"
TASKS = ("reach the cube", "grasp the cube")


def png(values: np.ndarray) -> bytes:
    """Encode a picture as PNG."""
    out = io.BytesIO()
    Image.fromarray(values).save(out, "PNG")
    return out.getvalue()


def colour(rng: np.random.Generator, side: int = SIDE) -> np.ndarray:
    """Return a random colour picture."""
    return rng.integers(0, 255, (side, side, 3), dtype=np.uint8)


def hdf5(folder: Path) -> Path:
    """Write a file as robosuite and robomimic do."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    with h5py.File(folder / "data.hdf5", "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps({"env_name": "Lift", "type": 1, "env_kwargs": {"control_freq": 20}})
        for number in range(EPISODES):
            demo = data.create_group(f"demo_{number}")
            demo.attrs["num_samples"] = STEPS
            demo["actions"] = rng.normal(size=(STEPS, 7)).astype("f4")
            demo["rewards"] = np.eye(STEPS)[-1]
            demo["obs/eef_pos"] = rng.normal(size=(STEPS, 3))
            demo["obs/gripper"] = rng.normal(size=STEPS)
            demo["obs/agentview_image"] = np.stack([colour(rng) for _ in range(STEPS)])
            demo["states"] = rng.normal(size=(STEPS, 5))
        file["mask/train"] = np.array([b"demo_0", b"demo_1"])
        file["mask/valid"] = np.array([b"demo_2"])
    return folder


def lerobot_rows(*, subtasks: bool = False, deep: bool = False) -> dict[str, Any]:
    """Return the columns of all episodes."""
    rng, rows = np.random.default_rng(0), EPISODES * STEPS
    depth = (np.arange(SIDE * SIDE).reshape(SIDE, SIDE) + 1000).astype(np.uint16)
    step = np.arange(rows) % STEPS
    vectors = rng.normal(size=(rows, 6)).astype("f4").tolist()
    cells = [{"bytes": png(depth if deep else colour(rng)), "path": None} for _ in range(rows)]
    return {
        "observation.state": pa.array(vectors, pa.list_(pa.float32())),
        "action": pa.array(vectors, pa.list_(pa.float32())),
        CAMERA: pa.array(cells, pa.struct([("bytes", pa.binary()), ("path", pa.string())])),
        "timestamp": pa.array(step / 10, pa.float32()),
        "frame_index": pa.array(step),
        "episode_index": pa.array(np.arange(rows) // STEPS),
        "index": pa.array(np.arange(rows)),
        "task_index": pa.array((step >= STEPS // 2).astype(int) if subtasks else np.zeros(rows, int)),
    }


def lerobot_info(version: str, **changes: Any) -> dict[str, Any]:
    """Return the content of ``meta/info.json``."""
    number = {"dtype": "int64", "shape": [1], "names": None}
    vector = {"dtype": "float32", "shape": [6], "names": None}
    return {
        "codebase_version": f"v{version}", "robot_type": "so100", "fps": 10, "total_episodes": EPISODES,
        "total_frames": EPISODES * STEPS, "chunks_size": 1000, "splits": {"train": f"0:{EPISODES}"}, "video_path": None,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet" if version == "3.0"
        else "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "features": {
            "observation.state": vector, "action": vector,
            CAMERA: {"dtype": "image", "shape": [SIDE, SIDE, 3], "names": ["height", "width", "channels"]},
            "timestamp": {"dtype": "float32", "shape": [1], "names": None},
            **{name: number for name in ("frame_index", "episode_index", "index", "task_index")},
        },
        **changes,
    }  # fmt: skip


def lerobot30(folder: Path, *, subtasks: bool = False, deep: bool = False, **info: Any) -> Path:
    """Write a dataset of version 3.0."""
    for place in ("meta/episodes/chunk-000", "data/chunk-000"):
        (folder / place).mkdir(parents=True)
    pq.write_table(pa.table(lerobot_rows(subtasks=subtasks, deep=deep)), folder / "data/chunk-000/file-000.parquet")
    tasks = list(TASKS[: 1 + subtasks])
    begin, zeros = np.arange(EPISODES) * STEPS, np.zeros(EPISODES, int)
    table = {
        "episode_index": np.arange(EPISODES), "length": np.full(EPISODES, STEPS), "tasks": [tasks] * EPISODES,
        "data/chunk_index": zeros, "data/file_index": zeros, "dataset_from_index": begin,
        "dataset_to_index": begin + STEPS,
    }  # fmt: skip
    pq.write_table(pa.table(table), folder / "meta/episodes/chunk-000/file-000.parquet")
    pq.write_table(pa.table({"task_index": np.arange(len(tasks)), "task": tasks}), folder / "meta/tasks.parquet")
    (folder / "meta/info.json").write_text(json.dumps(lerobot_info("3.0", **info)))
    return folder


def lerobot21(folder: Path, *, tasks: Any = (TASKS[0],)) -> Path:
    """Write a dataset of version 2.1."""
    (folder / "meta").mkdir(parents=True)
    (folder / "data/chunk-000").mkdir(parents=True)
    rows = pa.table(lerobot_rows())
    lines = []
    for number in range(EPISODES):
        path = folder / f"data/chunk-000/episode_{number:06d}.parquet"
        pq.write_table(rows.slice(number * STEPS, STEPS), path)
        said = {"episode_index": number, "tasks": tasks, "length": STEPS}
        lines.append(json.dumps(said, ensure_ascii=False) + "\n")
    (folder / "meta/episodes.jsonl").write_text("".join(lines), encoding="utf-8")
    (folder / "meta/tasks.jsonl").write_text(json.dumps({"task_index": 0, "task": TASKS[0]}) + "\n")
    (folder / "meta/info.json").write_text(json.dumps(lerobot_info("2.1")))
    return folder


def _tensor(kind: str, *shape: int) -> dict[str, Any]:
    return {"tensor": {"shape": {"dimensions": [str(n) for n in shape]}, "dtype": kind, "encoding": "none"}}


def _group(**features: Any) -> dict[str, Any]:
    return {"featuresDict": {"features": features}}


def rlds(folder: Path, *, ids: tuple[int, ...] = (0, 1, 0), side: int = SIDE, template: str = "") -> Path:
    """Write a dataset as a builder of TensorFlow Datasets does."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    image = {"image": {"shape": {"dimensions": [str(side), str(side), "3"]}, "dtype": "uint8", "encodingFormat": "png"}}
    steps = _group(
        action=_tensor("float32", 7), language_instruction={"text": {}}, reward=_tensor("float32"),
        is_first=_tensor("bool"),
        observation=_group(image=image, state=_tensor("float32", 7), pose=_tensor("float32", 2, 2)),
    )  # fmt: skip
    data = _group(
        steps={"sequence": {"feature": steps, "length": "-1"}}, episode_metadata=_group(episode_id=_tensor("int32"))
    )
    (folder / "features.json").write_text(json.dumps(data))
    pattern = template or "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}"
    split = {"name": "train", "filepathTemplate": pattern, "shardLengths": [str(len(ids))], "numBytes": "1"}
    info = {"name": "bridge", "version": "1.0.0", "fileFormat": "tfrecord", "splits": [split]}
    (folder / "dataset_info.json").write_text(json.dumps(info))
    name = pattern.format(DATASET="bridge", SPLIT="train", FILEFORMAT="tfrecord", SHARD_X_OF_Y="00000-of-00001",
                          SHARD_INDEX="00000", NUM_SHARDS="00001")  # fmt: skip
    with (folder / name).open("wb") as file:
        for episode in ids:
            write_record(file, encode_example({
                "steps/action": rng.normal(size=7 * STEPS).astype(np.float32),
                "steps/reward": np.eye(STEPS, dtype=np.float32)[-1],
                "steps/language_instruction": [b"put the carrot on the plate"] * STEPS,
                "steps/is_first": np.eye(STEPS, dtype=np.int64)[0],
                "steps/observation/image": [png(colour(rng)) for _ in range(STEPS)],
                "steps/observation/state": rng.normal(size=7 * STEPS).astype(np.float32),
                "steps/observation/pose": np.ones(4 * STEPS, np.float32),
                "episode_metadata/episode_id": np.array([episode], np.int64),
            }))  # fmt: skip
    return folder
