"""What a LeRobot dataset consists of: names of its columns, their types, and the files that hold them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from roboxim_core.errors import InvalidRequestError
from roboxim_datasets.episode import ImageSize
from roboxim_datasets.video.codecs import CODECS, video_codec

if TYPE_CHECKING:
    import pyarrow as pa

Version = Literal["3.0", "2.1"]
Info = dict[str, Any]

INFO_FILE = "meta/info.json"
STATS_FILE = "meta/stats.json"
TASKS = "task", "tasks"
"""Name of an instruction's column, and of the table of instructions."""
SUBTASKS = "subtask", "subtasks"
"""Name of a subtask's column, and of the table of subtasks."""
MODALITY_FILE = "meta/modality.json"
ROBOXIM_FILE = "meta/roboxim.json"
"""Facts that the format has no place for: action semantics, state fields, camera names."""
ROBOXIM_EPISODES_FILE = "meta/roboxim_episodes.jsonl"
"""One line for each episode: its id, its success and its further metadata."""

CHUNK = 1000
"""Files (3.0) or episodes (2.1) in a folder."""
_CHUNK_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
_EPISODE_FILE = "chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
DATA_PATH: Mapping[str, str] = {
    "3.0": f"data/{_CHUNK_FILE}.parquet",
    "2.1": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
}
VIDEO_PATH: Mapping[str, str] = {
    "3.0": "videos/{video_key}/" + _CHUNK_FILE + ".mp4",
    "2.1": f"videos/{_EPISODE_FILE}",
}
EPISODES_PATH = f"meta/episodes/{_CHUNK_FILE}.parquet"

DEPTH_UNITS_M = {"m": 1.0, "mm": 0.001}
"""Units of depth images that ``info.depth_unit`` states, from lerobot 0.6 on, in metres."""
DEPTH_UNIT_M = 2.5e-4
"""Unit of stored depth [m]; `MAX_DEPTH` units are 8.19 m. 0 is what is farther or unknown."""
MAX_DEPTH = 32767
"""Largest stored depth: torchvision reads 16-bit images as signed numbers."""


@dataclass(frozen=True, kw_only=True)
class LeRobotNames:
    """Names of the columns that trainers look for."""

    state: str = "observation.state"
    """State."""
    action: str = "action"
    """Action."""
    camera: str = "observation.images.{camera}"
    """Images of a camera."""
    reward: str = "next.reward"
    """Reward."""
    done: str = "next.done"
    """Whether the step is the episode's last."""


NAMES: Mapping[str, LeRobotNames] = {
    "lerobot": LeRobotNames(),
    "groot": LeRobotNames(),
    "openpi": LeRobotNames(state="state", action="actions", camera="{key}"),
}
"""Names by the trainer that looks for them. ``{camera}`` is a camera's name, ``{key}`` its image key (``image``,
``wrist_image``)."""


@dataclass(frozen=True, kw_only=True)
class Column:
    """A column of numbers."""

    names: tuple[str, ...] | None = None
    """Names of the components; None: a single number."""
    dtype: str = "float32"
    """NumPy's name of the type."""

    @property
    def size(self) -> int:
        """Number of components."""
        return 1 if self.names is None else len(self.names)

    @property
    def arrow(self) -> pa.DataType:
        """Type in Parquet."""
        import pyarrow as pa

        kind = pa.bool_() if self.dtype == "bool" else pa.type_for_alias(self.dtype)
        return kind if self.names is None else pa.list_(kind, self.size)


INDEX_COLUMNS: Mapping[str, Column] = {
    "timestamp": Column(),
    "frame_index": Column(dtype="int64"),
    "episode_index": Column(dtype="int64"),
    "index": Column(dtype="int64"),
    "task_index": Column(dtype="int64"),
}
"""Columns of every dataset."""
SUBTASK_INDEX = "subtask_index"
"""Column with the number of each step's subtask, as lerobot 0.4 and 0.5 read it; 0.6 ignores it."""


def table_of_texts(names: tuple[str, str], version: str) -> str:
    """Return the file of `TASKS` or `SUBTASKS`."""
    return f"meta/{names[1]}.{'parquet' if version == '3.0' else 'jsonl'}"


def image_type() -> pa.DataType:
    """Return the type of an image column in Parquet."""
    import pyarrow as pa

    return pa.struct([("bytes", pa.binary()), ("path", pa.string())])


@dataclass(frozen=True, kw_only=True)
class LeRobotLayout:
    """Layout of a dataset."""

    version: Version = "3.0"
    """Version of the format."""
    fps: int
    """Steps per second."""
    robot_type: str = ""
    """Id of the robot model."""
    cameras: Mapping[str, ImageSize]
    """Column of a camera's images to their size."""
    columns: Mapping[str, Column]
    """Name of a column to its type, without images and `INDEX_COLUMNS`."""
    depth: Mapping[str, ImageSize] = field(default_factory=dict)
    """Column of a camera's depth or segmentation (16-bit PNG images) to their size."""
    subtasks: bool = False
    """Whether each step has a subtask."""
    codec: str = "h264"
    """Video codec; empty: images are PNG columns."""
    data_file_bytes: int = 100 << 20
    """Size at which a data file is finished [B]; only for version 3.0."""
    video_file_bytes: int = 200 << 20
    """Size at which a video file is finished [B]; only for version 3.0."""

    def __post_init__(self) -> None:
        """Check the names and the video codec.

        Raises:
            InvalidRequestError: On an unknown version or codec, an image size that it does not support, a file size
                below 1, or a name with a slash.
        """
        if self.version not in DATA_PATH:
            raise InvalidRequestError(f"unknown version '{self.version}' of LeRobot datasets; expected 3.0 or 2.1")
        if min(self.data_file_bytes, self.video_file_bytes, self.fps) < 1:
            raise InvalidRequestError("the sizes of files and the frame rate must be at least 1")
        for size in self.cameras.values() if self.codec else ():
            video_codec(self.codec, height=size.height, width=size.width)
        for name in (*self.cameras, *self.columns):
            if "/" in name or name in (*INDEX_COLUMNS, SUBTASK_INDEX):
                raise InvalidRequestError(
                    f"a column cannot be called '{name}': it has a slash or is a column of indices"
                )

    @property
    def index_columns(self) -> Mapping[str, Column]:
        """Columns of indices."""
        return {**INDEX_COLUMNS, **({SUBTASK_INDEX: Column(dtype="int64")} if self.subtasks else {})}

    def features(self) -> Info:
        """Return ``features`` of ``meta/info.json``."""
        found: Info = {}
        for key, size in self.cameras.items():
            found[key] = _image_feature(size, 3, "video" if self.codec else "image")
            if self.codec:
                found[key]["info"] = self._video_info(size)
        for key, size in self.depth.items():
            found[key] = _image_feature(size, 1, "image")
        for key, column in {**self.columns, **self.index_columns}.items():
            names = None if column.names is None else list(column.names)
            found[key] = {"dtype": column.dtype, "shape": [column.size], "names": names}
        return found

    def _video_info(self, size: ImageSize) -> Info:
        codec = CODECS[self.codec]
        return {
            "video.height": size.height,
            "video.width": size.width,
            "video.codec": codec.codec,
            "video.pix_fmt": codec.pixel_format,
            "video.is_depth_map": False,
            "video.fps": self.fps,
            "video.channels": 3,
            "has_audio": False,
        }

    def info(self, *, tasks: int, frames: int, splits: Mapping[str, int]) -> Info:
        """Return ``meta/info.json``.

        Args:
            tasks: Number of different instructions.
            frames: Number of steps.
            splits: Split to its number of episodes, in their order in the dataset.
        """
        ranges, at = {}, 0
        for name, count in splits.items():
            ranges[name] = f"{at}:{at + count}"
            at += count
        if self.version == "3.0":
            own = {
                "data_files_size_in_mb": max(1, self.data_file_bytes >> 20),
                "video_files_size_in_mb": max(1, self.video_file_bytes >> 20),
            }
        else:
            own = {"total_videos": at * len(self.cameras) if self.codec else 0, "total_chunks": -(-at // CHUNK)}
        return {
            "codebase_version": f"v{self.version}",
            "robot_type": self.robot_type or None,
            "total_episodes": at,
            "total_frames": frames,
            "total_tasks": tasks,
            "chunks_size": CHUNK,
            **own,
            "fps": self.fps,
            "splits": ranges,
            "data_path": DATA_PATH[self.version],
            "video_path": VIDEO_PATH[self.version] if self.codec and self.cameras else None,
            "features": self.features(),
        }

    def schema(self) -> pa.Schema:
        """Return the schema of the data files, with the types as the library ``datasets`` wants them."""
        import pyarrow as pa

        images = [*self.depth, *(() if self.codec else self.cameras)]
        columns = {**self.columns, **self.index_columns}
        fields = [*((key, image_type()) for key in images), *((key, column.arrow) for key, column in columns.items())]
        types = {key: {"_type": "Image"} for key in images} | {
            key: self._dataset_type(column) for key, column in columns.items()
        }
        return pa.schema(fields, metadata={"huggingface": json.dumps({"info": {"features": types}})})

    def _dataset_type(self, column: Column) -> Info:
        value: Info = {"dtype": column.dtype, "_type": "Value"}
        if column.names is None:
            return value
        return {"feature": value, "length": column.size, "_type": "List" if self.version == "3.0" else "Sequence"}


def _image_feature(size: ImageSize, channels: int, dtype: str) -> Info:
    shape = [size.height, size.width, channels]
    return {"dtype": dtype, "shape": shape, "names": ["height", "width", "channels"]}
