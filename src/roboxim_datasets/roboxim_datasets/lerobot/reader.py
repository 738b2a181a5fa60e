"""Reads LeRobot datasets of versions 2.1 and 3.0, RoboXim's and others', without lerobot.

RoboXim's exports say in ``meta/roboxim.json`` what their numbers mean. Of another dataset only the format's own facts
are known: the meaning of its actions is unknown (None), its cameras are called like its image columns, and its vectors
like its columns ``observation.``...
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from roboxim_core.documents import read_json_object
from roboxim_core.errors import ConfigError, ErrorCode, InvalidRequestError, RecorderError
from roboxim_core.images import decode_image
from roboxim_datasets.dataset import Dataset, Description, Features
from roboxim_datasets.episode import EXECUTED, SIGNAL_PREFIX, Episode, Floats, ImageSize, RGBImage, Step, Wanted
from roboxim_datasets.lerobot.content import LeRobotContent
from roboxim_datasets.lerobot.layout import (
    DEPTH_UNIT_M,
    INFO_FILE,
    NAMES,
    ROBOXIM_EPISODES_FILE,
    ROBOXIM_FILE,
    STATS_FILE,
    TASKS_FILE,
    LeRobotNames,
)
from roboxim_datasets.lerobot.pieces import column_array
from roboxim_datasets.video.client import VideoDecoder
from roboxim_datasets.video.codecs import CODECS

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

_TIMESTAMP = "timestamp"
_STATES = ("observation.state", "state")
_ACTIONS = ("action", "actions")
_OBSERVED = "observation."
_CAMERA_PREFIX = "observation.images."
_VERSIONS = ("3.0", "2.1", "2.0")
_LOADING_2 = """```python
from lerobot.datasets.lerobot_dataset import LeRobotDataset  # lerobot 0.3.3; openpi: lerobot.common.datasets
dataset = LeRobotDataset("roboxim/dataset", root="...")  # this folder
```

GR00T reads `meta/modality.json` and `meta/stats.json`. Columns that start with `sim.` are ignored by trainers.
"""
_LOADING = {
    "3.0": """```python
from lerobot.datasets.lerobot_dataset import LeRobotDataset  # lerobot 0.4 or newer
dataset = LeRobotDataset("roboxim/dataset", root="...")  # this folder
```

```bash
lerobot-train --dataset.repo_id=roboxim/dataset --dataset.root=... --policy.type=act
```

Statistics are in `meta/stats.json`, quantiles over all steps. Columns that start with `sim.` are ignored by trainers.
""",
    "2.1": _LOADING_2,
    "2.0": _LOADING_2,
}
"""Version to how a dataset is loaded, in Markdown."""


@dataclass(frozen=True, kw_only=True)
class _Place:
    """Where an episode is."""

    length: int
    tasks: tuple[str, ...]
    data_file: str
    first_row: int
    videos: Mapping[str, tuple[str, int]]
    """Column to the video file and the number of its first frame in it."""


class LeRobotDataset(Dataset):
    """A dataset. Only the table of episodes is kept; their numbers and images are read on demand."""

    format = "lerobot"

    def __init__(self, path: Path) -> None:
        """Open a dataset.

        Args:
            path: Its folder, which holds ``meta/info.json``.

        Raises:
            RecorderError: When there is no dataset, its description is damaged, or its version is unknown.
        """
        super().__init__(path)
        if not (self.path / INFO_FILE).is_file():
            raise RecorderError(f"{self.path} is not a LeRobot dataset: it has no {INFO_FILE}")
        self.info = _object(self.path / INFO_FILE)
        try:
            self.version = str(self.info["codebase_version"]).removeprefix("v")
            if self.version not in _VERSIONS:
                raise RecorderError(
                    f"{self.path} is of version {self.version}; expected one of {', '.join(_VERSIONS)}. The package "
                    "lerobot converts older ones"
                )
            self._fps = Fraction(str(self.info["fps"]))
            self._features: dict[str, Any] = dict(self.info["features"])
            self._ranges = {name: _range(text) for name, text in self.info["splits"].items()}
            self.content = self._content()
            self._places = self._places_30() if self.version == "3.0" else self._places_21()
        except (ConfigError, KeyError, TypeError, ValueError, AttributeError) as error:
            raise RecorderError(f"{self.path}: its description is damaged: {error!r}", ErrorCode.BAG_DAMAGED) from None
        self._decoder = VideoDecoder()
        self._file: tuple[str, pq.ParquetFile] | None = None

    def _content(self) -> LeRobotContent:
        """Return where the parts of an episode are: as RoboXim wrote it, else by the usual names."""
        file = self.path / ROBOXIM_FILE
        if file.is_file():
            return LeRobotContent.from_json(_object(file), str(file))
        keys = {name: feature["dtype"] for name, feature in self._features.items()}
        vectors = [name for name in keys if name in _STATES or name.startswith(_OBSERVED) and self._is_vector(name)]
        state = next((name for name in _STATES if name in keys), "")
        action = next((name for name in _ACTIONS if name in keys), "")
        if not action:
            raise RecorderError(f"{self.path} has no column of actions; expected {' or '.join(_ACTIONS)}")
        return LeRobotContent(
            names=LeRobotNames(state=state, action=action),
            cameras={
                name: name.removeprefix(_CAMERA_PREFIX) for name, kind in keys.items() if kind in ("image", "video")
            },
            depth={},
            segmentation={},
            vectors={name: "state" if name == state else name.removeprefix(_OBSERVED) for name in vectors},
            signals={name: name for name in keys if name.startswith(SIGNAL_PREFIX) and self._is_vector(name)},
        )

    def _is_vector(self, name: str) -> bool:
        feature = self._features[name]
        return str(feature["dtype"]).startswith(("float", "int", "uint")) and len(feature["shape"]) == 1

    @property
    def splits(self) -> Mapping[str, int]:
        """Split to its number of episodes."""
        return {name: len(episodes) for name, episodes in self._ranges.items() if len(episodes)}

    @cached_property
    def statistics(self) -> dict[str, Any]:
        """Content of ``meta/stats.json``; empty when there is none.

        Raises:
            RecorderError: When the file cannot be read.
        """
        file = self.path / STATS_FILE
        return _object(file) if file.is_file() else {}

    def summaries(self) -> Mapping[str, Mapping[str, Sequence[float]]]:
        """Return the statistics of actions and observed vectors."""
        columns = {self.content.names.action: "action", **self.content.vectors}
        stored = {name: self.statistics[key] for key, name in columns.items() if key in self.statistics}
        return {name: value for name, value in stored.items() if isinstance(value, dict)}

    @property
    def options(self) -> Mapping[str, Any]:
        """Options with which a dataset like this one is written."""
        found: dict[str, Any] = {"version": "3.0" if self.version == "3.0" else "2.1"}
        if self.content.names.action == NAMES["openpi"].action:
            found["columns"] = "openpi"
        kinds = [self._features[key] for key in self.content.cameras]
        found["images"] = bool(kinds) and all(feature["dtype"] == "image" for feature in kinds)
        about: dict[str, Any] = next(
            (feature["info"] for feature in kinds if isinstance(feature.get("info"), dict)), {}
        )
        said = about.get("video.codec"), about.get("video.pix_fmt")
        codec = next((name for name, codec in CODECS.items() if (codec.codec, codec.pixel_format) == said), None)
        return {**found, "codec": codec} if codec else found

    @property
    def usage(self) -> str:
        """How the dataset is loaded."""
        return _LOADING[self.version]

    @cached_property
    def description(self) -> Description:
        """What ``meta/`` says."""
        content = self.content
        return Description(
            features=Features(
                cameras={camera: _size(self._features[key]) for key, camera in content.cameras.items()},
                keys={camera: key for key, camera in content.cameras.items()},
                lossless=all(self._features[key]["dtype"] == "image" for key in content.cameras),
                depth=tuple(content.depth.values()),
                segmentation=tuple(content.segmentation.values()),
                action=self._names(content.names.action),
                vectors={vector: self._names(key) for key, vector in content.vectors.items()},
                signals={signal: self._names(key) for key, signal in content.signals.items()},
            ),
            fps=float(self._fps),
            robot=str(self.info.get("robot_type") or ""),
            joint_names=content.joint_names,
            semantics=content.semantics,
            parts=content.parts,
        )

    def _names(self, key: str) -> tuple[str, ...]:
        """Return the names of a column's components; numbered ones when the dataset has none."""
        feature = self._features[key]
        names, size = feature.get("names"), int(feature["shape"][0])
        if isinstance(names, dict) and len(names) == 1:  # as early versions nest them: {"motors": [...]}
            names = next(iter(names.values()))
        if isinstance(names, list) and len(names) == size:
            return tuple(str(name) for name in names)
        return tuple(f"{key}.{index}" for index in range(size))

    def read(self, split: str, index: int) -> Episode:
        """Read an episode of a split; its steps are read on demand."""
        number = self._ranges[split][index]
        if number >= len(self._places):
            raise RecorderError(
                f"{self.path}: split '{split}' names episode {number}, but there are {len(self._places)}",
                ErrorCode.BAG_DAMAGED,
            )
        place = self._places[number]
        said = self._said[number] if number < len(self._said) else {}
        return self.description.episode(
            length=place.length,
            instruction=place.tasks[0] if place.tasks else "",
            success="success" not in said and self._succeeded(place),
            said=said,
            read=lambda wanted: self._steps(place, wanted),
        )

    @cached_property
    def _said(self) -> list[dict[str, Any]]:
        """What RoboXim's export says of each episode; empty: it is another's dataset."""
        file = self.path / ROBOXIM_EPISODES_FILE
        return [_parsed(line, file) for line in _lines(file)] if file.is_file() else []

    def _succeeded(self, place: _Place) -> bool:
        """Return whether the last step says success, as far as the dataset has such a column."""
        for name in ("next.success", "next.reward"):
            if name in self._features:
                return bool(column_array(self._rows(place, [name]).column(name)).reshape(-1)[-1] > 0)
        return False

    # -- steps

    def _steps(self, place: _Place, wanted: Wanted) -> Iterator[Step]:
        content = self.content
        keys = {camera: key for key, camera in content.cameras.items() if camera in wanted.cameras}
        stored = {camera: key for camera, key in keys.items() if self._features[key]["dtype"] == "image"}
        depth = {camera: key for key, camera in content.depth.items() if camera in wanted.depth}
        masks = {camera: key for key, camera in content.segmentation.items() if camera in wanted.segmentation}
        columns = [key for key in (*self._number_columns(), _TIMESTAMP) if key in self._features]
        encoded = [*stored.values(), *depth.values(), *masks.values()]
        table = self._rows(place, [*columns, *encoded])
        numbers = {key: self._floats(table, key) for key in columns}
        videos = {camera: self._frames(place, key) for camera, key in keys.items() if camera not in stored}
        for step in range(place.length):
            cells = {key: table.column(key)[step].as_py() for key in encoded}
            images: dict[str, RGBImage] = {camera: next(frames) for camera, frames in videos.items()}
            images |= {camera: self._picture(cells[key]) for camera, key in stored.items()}
            yield Step(
                index=step,
                images={camera: images[camera] for camera in keys},
                depth={camera: self._map(cells[key]) * np.float32(DEPTH_UNIT_M) for camera, key in depth.items()},
                segmentation={camera: self._map(cells[key]) for camera, key in masks.items()},
                proprio={vector: numbers[key][step] for key, vector in content.vectors.items()},
                action=numbers[content.names.action][step],
                action_executed=numbers[EXECUTED][step] if EXECUTED in numbers else None,
                signals={name: numbers[key][step] for key, name in content.signals.items() if key != EXECUTED},
                reward=float(numbers[content.names.reward][step, 0]) if content.names.reward in numbers else 0.0,
                stamp_s=float(numbers[_TIMESTAMP][step, 0]) if _TIMESTAMP in numbers else None,
            )
        for frames in videos.values():  # ends the decoding; a broken file says so
            next(frames, None)

    def _number_columns(self) -> tuple[str, ...]:
        """Return the columns of numbers that steps consist of."""
        content = self.content
        return (*content.vectors, content.names.action, *content.signals, content.names.reward)

    def _floats(self, table: pa.Table, key: str) -> Floats:
        values = column_array(table.column(key))
        return np.asarray(values.reshape(len(values), -1), np.float32)

    def _frames(self, place: _Place, key: str) -> Iterator[RGBImage]:
        file, first = place.videos[key]
        return self._decoder.frames(self.path / file, rate=self._fps, first=first, count=place.length)

    def _picture(self, cell: Mapping[str, Any]) -> RGBImage:
        try:
            return decode_image(self._image_bytes(cell))
        except (InvalidRequestError, OSError) as error:
            raise RecorderError(f"{self.path}: an image cannot be read: {error}", ErrorCode.BAG_DAMAGED) from None

    def _image_bytes(self, value: Mapping[str, Any]) -> bytes:
        if value.get("bytes"):
            return bytes(value["bytes"])
        return (self.path / str(value.get("path"))).read_bytes()

    def _map(self, value: Mapping[str, Any]) -> Any:
        import cv2

        picture = cv2.imdecode(np.frombuffer(self._image_bytes(value), np.uint8), cv2.IMREAD_UNCHANGED)
        if picture is None:
            raise RecorderError(f"{self.path}: an image of depth or segmentation is damaged", ErrorCode.BAG_DAMAGED)
        return picture

    def _rows(self, place: _Place, columns: Sequence[str]) -> pa.Table:
        """Read the rows of an episode."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            if self._file is None or self._file[0] != place.data_file:
                self._file = (place.data_file, pq.ParquetFile(self.path / place.data_file))
            file, begin, start = self._file[1], 0, 0
            groups: list[int] = []
            for group in range(file.num_row_groups):
                rows = file.metadata.row_group(group).num_rows
                if begin < place.first_row + place.length and begin + rows > place.first_row:
                    start = begin if not groups else start
                    groups.append(group)
                begin += rows
            table = file.read_row_groups(groups, columns=list(columns))
        except (OSError, pa.ArrowException) as error:
            raise RecorderError(f"cannot read {self.path / place.data_file}: {error}", ErrorCode.BAG_DAMAGED) from None
        table = table.slice(place.first_row - start, place.length)
        if table.num_rows != place.length:
            raise RecorderError(
                f"{self.path / place.data_file} holds {table.num_rows} steps of an episode, expected {place.length}",
                ErrorCode.BAG_DAMAGED,
            )
        return table

    # -- the table of episodes

    def _places_30(self) -> list[_Place]:
        import pyarrow as pa
        import pyarrow.parquet as pq

        videos = self._video_keys()
        wanted = ["length", "tasks", "data/chunk_index", "data/file_index", "dataset_from_index"]
        for key in videos:
            wanted += [f"videos/{key}/{name}" for name in ("chunk_index", "file_index", "from_timestamp")]
        rows: list[dict[str, Any]] = []
        for file in sorted((self.path / "meta" / "episodes").glob("*/*.parquet")):
            try:
                rows += pq.read_table(file, columns=["episode_index", *wanted]).to_pylist()
            except (OSError, pa.ArrowException) as error:
                raise RecorderError(f"cannot read {file}: {error}", ErrorCode.BAG_DAMAGED) from None
        rows.sort(key=lambda row: row["episode_index"])
        found: list[_Place] = []
        begins: dict[str, int] = {}
        for row in rows:
            place = {"chunk_index": row["data/chunk_index"], "file_index": row["data/file_index"]}
            file_name = self.info["data_path"].format(**place)
            begin = begins.setdefault(file_name, row["dataset_from_index"])
            starts = {key: self._video_30(row, key) for key in videos}
            found.append(
                _Place(
                    length=row["length"],
                    tasks=tuple(row["tasks"]),
                    data_file=file_name,
                    first_row=row["dataset_from_index"] - begin,
                    videos=starts,
                )
            )
        return found

    def _video_30(self, row: Mapping[str, Any], key: str) -> tuple[str, int]:
        chunk, file, begin = (row[f"videos/{key}/{name}"] for name in ("chunk_index", "file_index", "from_timestamp"))
        name = self.info["video_path"].format(video_key=key, chunk_index=chunk, file_index=file)
        return name, round(begin * float(self._fps))

    def _places_21(self) -> list[_Place]:
        videos, size = self._video_keys(), int(self.info.get("chunks_size", 1000))
        file = self.path / "meta" / "episodes.jsonl"
        rows = sorted((_parsed(line, file) for line in _lines(file)), key=lambda row: int(row["episode_index"]))
        found = []
        for row in rows:
            index = int(row["episode_index"])
            place = {"episode_chunk": index // size, "episode_index": index}
            found.append(
                _Place(
                    length=int(row["length"]),
                    tasks=tuple(row["tasks"]),
                    data_file=self.info["data_path"].format(**place),
                    first_row=0,
                    videos={key: (self.info["video_path"].format(video_key=key, **place), 0) for key in videos},
                )
            )
        return found

    def _video_keys(self) -> list[str]:
        return [key for key, feature in self._features.items() if feature["dtype"] == "video"]

    def tasks(self) -> list[str]:
        """Return the instructions, by their number.

        Raises:
            RecorderError: When the file cannot be read.
        """
        import pyarrow.parquet as pq

        if self.version == "3.0":
            table = pq.read_table(self.path / TASKS_FILE)
            texts = next(name for name in table.column_names if name != "task_index")
            return [str(text) for text in table.column(texts).to_pylist()]
        file = self.path / "meta" / "tasks.jsonl"
        return [str(_parsed(line, file)["task"]) for line in _lines(file)]


def _object(file: Path) -> dict[str, Any]:
    try:
        return read_json_object(file)
    except ConfigError as error:
        raise RecorderError(f"the dataset's description cannot be read: {error}", ErrorCode.BAG_DAMAGED) from None


def _lines(file: Path) -> list[str]:
    try:
        return [line for line in file.read_text().splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError) as error:
        raise RecorderError(f"cannot read {file}: {error}", ErrorCode.BAG_DAMAGED) from None


def _parsed(line: str, file: Path) -> dict[str, Any]:
    try:
        value = json.loads(line)
    except ValueError as error:
        raise RecorderError(f"{file} is damaged: {error}", ErrorCode.BAG_DAMAGED) from None
    if not isinstance(value, dict):
        raise RecorderError(f"{file} is damaged: expected a JSON object in each line", ErrorCode.BAG_DAMAGED)
    return value


def _range(text: str) -> range:
    begin, end = text.split(":")
    return range(int(begin), int(end))


def _size(feature: Mapping[str, Any]) -> ImageSize:
    """Return the size of a column of images, whose shape has the channels last, or first in some datasets."""
    shape = [int(side) for side in feature["shape"]]
    if shape[0] in (1, 3) and shape[-1] not in (1, 3):
        shape = [*shape[1:], shape[0]]
    return ImageSize(height=shape[0], width=shape[1])
