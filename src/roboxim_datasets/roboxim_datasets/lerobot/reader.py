"""Reads LeRobot datasets of versions 2.1 and 3.0, RoboXim's and others', without lerobot.

RoboXim's exports say in ``meta/roboxim.json`` what their numbers mean. Of another dataset only the format's own facts
are known: the meaning of its actions is unknown (None), its cameras are called like its image columns, and its vectors
like its columns ``observation.``... The account of the dataset names everything else.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from roboxim_core.errors import ConfigError, InvalidRequestError, RecorderError, printable
from roboxim_datasets.account import Account
from roboxim_datasets.dataset import Dataset, Description, Features
from roboxim_datasets.depth import camera_of
from roboxim_datasets.episode import EXECUTED, SIGNAL_PREFIX, Episode, ImageSize, RGBImage, Step, Wanted, solved
from roboxim_datasets.files import file_in, files_below, has_file, reading
from roboxim_datasets.lerobot import tables
from roboxim_datasets.lerobot.columns import cells, floats, peek
from roboxim_datasets.lerobot.content import LeRobotContent
from roboxim_datasets.lerobot.layout import (
    DEPTH_UNIT_M,
    DEPTH_UNITS_M,
    INDEX_COLUMNS,
    INFO_FILE,
    NAMES,
    ROBOXIM_EPISODES_FILE,
    ROBOXIM_FILE,
    STATS_FILE,
    SUBTASK_INDEX,
    SUBTASKS,
    TASKS,
    LeRobotNames,
)
from roboxim_datasets.lerobot.parquet_file import open_parquet
from roboxim_datasets.lerobot.tables import Place, Rows, damaged
from roboxim_datasets.pictures import MOST_PIXELS, colour_picture, decoded, deep_picture, head_of
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
_MOST_NUMBERS = 1024  # of a column that is read as a vector
_SPLIT = re.compile(r"\s*(\d{1,15})\s*:\s*(\d{1,15})\s*")
_FASTEST = 10_000.0  # steps per second that are believed
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


class LeRobotDataset(Dataset):
    """A dataset. Only the table of episodes is kept; their numbers and images are read on demand."""

    format = "lerobot"

    def __init__(self, path: Path, *, depth_unit_m: float = 0.0) -> None:
        """Open a dataset.

        Args:
            path: Its folder, which holds ``meta/info.json``.
            depth_unit_m: Unit of the 16-bit depth images of others [m]; 0: unknown, so they are left out.

        Raises:
            InvalidRequestError: When a unit is stated of RoboXim's own dataset, which says it.
            RecorderError: When there is no dataset, its description is damaged, or its version is unknown.
        """
        super().__init__(path)
        self.depth_unit_m = depth_unit_m
        if not has_file(path, INFO_FILE):
            raise RecorderError(f"{self.path} is not a LeRobot dataset: it has no {INFO_FILE}")
        self.info = tables.json_object(self.path, INFO_FILE)
        try:
            self._open()
        except (
            ConfigError,
            KeyError,
            TypeError,
            ValueError,
            AttributeError,
            ZeroDivisionError,
            OverflowError,
        ) as error:
            raise damaged(f"{self.path}: its description is damaged: {printable(repr(error), 300)}") from None
        self._decoder = VideoDecoder()
        self._file: tuple[str, pq.ParquetFile] | None = None
        self._index: Rows | None = None

    def _open(self) -> None:
        self.version = str(self.info["codebase_version"]).removeprefix("v")
        if self.version not in _VERSIONS:
            raise RecorderError(
                f"{self.path} is of version {printable(self.version, 60)}; expected one of {', '.join(_VERSIONS)}. The "
                "package lerobot converts older ones"
            )
        self._fps = Fraction(str(self.info["fps"]))
        if not 0 < self._fps <= _FASTEST:
            raise damaged(f"{self.path / INFO_FILE}: fps is {float(self._fps):g}, expected steps per second above 0")
        self._features: dict[str, Any] = dict(self.info["features"])
        self._unread: dict[str, str] = {}  # column to why it is not read
        own = has_file(self.path, ROBOXIM_FILE)
        videos = self._video_keys(own=own)
        if self.version == "3.0":
            self._table = tables.episodes_30(self.path, self.info, videos, float(self._fps))
        else:
            self._table = tables.episodes_21(self.path, self.info, videos)
        self._tasks = tables.texts_of(self.path, TASKS, self.version)
        self._subtasks = tables.texts_of(self.path, SUBTASKS, self.version) if SUBTASK_INDEX in self._features else {}
        self._places, self._lost_splits = self._split()
        if not self._table.places:
            raise damaged(f"{self.path} has no episode with steps in its table of episodes (meta/episodes)")
        self.content = self._own_content() if own else self._content()

    def _own_content(self) -> LeRobotContent:
        if self.depth_unit_m:
            raise InvalidRequestError(f"{self.path} says itself what its depth means; leave --depth-unit out")
        data = tables.json_object(self.path, ROBOXIM_FILE)
        content = LeRobotContent.from_json(data, str(self.path / ROBOXIM_FILE))
        for key in (*content.cameras, *content.vectors, *content.signals, content.names.action):
            self._shape(key)
        return content

    def _video_keys(self, *, own: bool) -> list[str]:
        found = []
        for key, feature in self._features.items():
            if feature["dtype"] == "video":
                self._unread |= {} if own or not (why := self._no_colour(key)) else {key: why}
                found += [] if key in self._unread else [key]
        return found

    def _no_colour(self, key: str) -> str:
        """Return why a column of images is none of colour images; empty: it is one, as far as its description says."""
        feature = self._features[key]
        shape = self._shape(key)
        if feature["dtype"] == "video" and (why := self._deep_video(key)):
            return why
        if len(shape) != 3 or 3 not in (shape[0], shape[2]):
            what = "16-bit depth or grey images" if len(shape) == 3 and 1 in (shape[0], shape[2]) else "images"
            return f"{what} of shape {shape}; only colour images of three channels are read"
        size = _size(shape)
        if not 0 < size.height * size.width <= MOST_PIXELS:
            return f"images of {size.width} x {size.height} pixels; 1 to {MOST_PIXELS} are read"
        return ""

    def _about(self, key: str) -> Mapping[str, Any]:
        """Return what ``info.json`` says of a column's images."""
        feature = self._features[key]
        parts = [feature[name] for name in ("video_info", "info") if isinstance(feature.get(name), dict)]
        return {name: value for part in parts for name, value in part.items()}

    def _deep_video(self, key: str) -> str:
        """Return that a video is one of depth, and what is said of its numbers; empty: it is none."""
        about = self._about(key)
        pixels = str(about.get("video.pix_fmt", about.get("pix_fmt", "")))
        deep = any(bool(about.get(name)) for name in ("video.is_depth_map", "is_depth_map"))
        if not deep and not pixels.startswith(("gray1", "gray9")):
            return ""
        said = f"a video of depth ({printable(pixels or 'is_depth_map', 40)})"
        names = [f"video.{name}" for name in ("depth_min", "depth_max", "shift", "use_log")]
        if not any(name in about for name in names):
            return f"{said}, whose unit the format does not state"
        scale = ", ".join(f"{name.removeprefix('video.')} {printable(about.get(name), 20)}" for name in names)
        return f"{said} whose numbers are quantised ({scale}); no video of depth is read"

    def _unit_m(self, key: str) -> float:
        """Return the unit of a column of depth images [m], as ``info.json`` or the user states it; 0: unknown."""
        return DEPTH_UNITS_M.get(str(self._about(key).get("depth_unit")), self.depth_unit_m)

    def _content(self) -> LeRobotContent:
        """Return where the parts of an episode are by the usual names."""
        first = next(iter(self._table.places.values()))
        columns = peek(self.path, first.data_file)
        cameras: dict[str, str] = {}
        vectors: list[str] = []
        signals: list[str] = []
        state = next((name for name in _STATES if name in self._features), "")
        action = next((name for name in _ACTIONS if name in self._features), "")
        if not action:
            raise RecorderError(f"{self.path} has no column of actions; expected {' or '.join(_ACTIONS)}")
        for key, feature in self._features.items():
            if key in self._unread or key in INDEX_COLUMNS or (key == SUBTASK_INDEX and self._subtasks):
                continue
            kind = feature["dtype"]
            if kind not in ("image", "video") and kind != "string" and key not in columns:
                self._unread[key] = f"{first.data_file} has no such column"
            elif kind == "image" and (why := self._no_colour(key) or self._deep(columns.get(key))):
                self._unread[key] = why
            elif kind in ("image", "video"):
                cameras[key] = key.removeprefix(_CAMERA_PREFIX).replace("/", ".")
            elif key not in (action, "next.reward", "next.done", "next.success"):
                self._unread |= {key: why} if (why := self._no_vector(key)) else {}
                if not self._unread.get(key):
                    (signals if key.startswith(SIGNAL_PREFIX) else vectors).append(key)
        if why := self._unread.get(action) or self._no_vector(action):
            raise damaged(f"{self.path}: the column '{action}' cannot be read as actions: {why}")
        named = _apart(cameras)
        return LeRobotContent(
            names=LeRobotNames(state=state, action=action),
            cameras=named,
            depth=self._depth(named, columns),
            segmentation={},
            vectors=_apart(
                {k: "state" if k == state else k.removeprefix(_OBSERVED).replace("/", ".") for k in vectors}
            ),
            signals={key: key for key in signals},
            outcomes="next.success" in self._features and "next.success" not in self._unread,
        )

    def _deep(self, cell: Any) -> str:
        """Return why the images of a column are none of colours, by its first one; empty: they are."""
        data = cell.get("bytes") if isinstance(cell, dict) else None
        deep = data and head_of(data).deep
        return "16-bit depth images, whose unit the format does not state (--depth-unit does)" if deep else ""

    def _depth(self, cameras: Mapping[str, str], columns: Mapping[str, Any]) -> dict[str, str]:
        """Return the columns of 16-bit depth images that become the depth of a camera, if their unit is stated."""
        found: dict[str, str] = {}
        for key in self._unread:
            if self._features[key]["dtype"] != "image" or not self._unit_m(key) or not self._deep(columns.get(key)):
                continue
            if self.depth_unit_m not in (0, self._unit_m(key)):
                unit = self._about(key)["depth_unit"]
                raise InvalidRequestError(f"{self.path} says that '{key}' is in {unit}; leave --depth-unit out")
            camera = camera_of(key.removeprefix(_CAMERA_PREFIX), cameras.values())
            size = head_of(columns[key]["bytes"]).size
            colour = next((_size(self._shape(name)) for name, own in cameras.items() if own == camera), None)
            if colour == size and camera not in found.values():
                found[key] = camera
            else:
                self._unread[key] = (
                    f"16-bit depth images of {size.width} x {size.height} without a colour camera of that name and size"
                )
        self._unread = {key: why for key, why in self._unread.items() if key not in found}
        return found

    def _no_vector(self, key: str) -> str:
        """Return why a column is no vector of observed numbers; empty: it is one."""
        dtype = str(self._features[key]["dtype"])
        if not dtype.startswith(("float", "int", "uint", "bool")):
            return f"values of the type {printable(dtype, 60)}"
        size = math.prod(self._shape(key))
        if not 0 < size <= _MOST_NUMBERS:
            return f"shape {self._shape(key)}; 1 to {_MOST_NUMBERS} numbers are read as a vector"
        if key in _ACTIONS or key in _STATES or key.startswith((_OBSERVED, SIGNAL_PREFIX)):
            return ""
        return f"{dtype} of shape {self._shape(key)}, not an observation"

    def _shape(self, key: str) -> tuple[int, ...]:
        if key not in self._features:
            raise damaged(f"{self.path / INFO_FILE} has no feature '{key}'")
        shape = self._features[key].get("shape")
        return tuple(int(side) for side in (shape if isinstance(shape, list) else [1]))

    def _split(self) -> tuple[dict[str, list[Place]], dict[str, str]]:
        """Return split to its episodes, and split to what is wrong with it.

        Episodes that no split names are in ``train``: lerobot reads them too, and edited datasets lag behind.
        """
        splits = self.info.get("splits")
        found: dict[str, list[Place]] = {"train": []}
        lost: dict[str, str] = {}
        left = dict(sorted(self._table.places.items()))
        for name, text in (splits if isinstance(splits, dict) else {}).items():
            match = _SPLIT.fullmatch(str(text))
            if match is None or int(match[1]) > int(match[2]):
                lost[name] = f"'{printable(text, 60)}' is no range of episodes, as 0:10"
                continue
            begin, end = int(match[1]), int(match[2])
            members = [place for number, place in left.items() if begin <= number < end]
            if len(members) < end - begin:
                lost[name] = (
                    f"{end - begin - len(members)} of its {end - begin} episodes ({text}) are not there to be read"
                )
            found.setdefault(str(name), []).extend(members)
            left = {number: place for number, place in left.items() if not begin <= number < end}
        self._in_no_split = set(left)
        found["train"].extend(left.values())
        return {name: places for name, places in found.items() if places}, lost

    @property
    def splits(self) -> Mapping[str, int]:
        """Split to its number of episodes."""
        return {name: len(places) for name, places in self._places.items()}

    @cached_property
    def statistics(self) -> dict[str, Any]:
        """Content of ``meta/stats.json``; empty when there is none that can be read."""
        return self._statistics[0]

    @cached_property
    def _statistics(self) -> tuple[dict[str, Any], str]:
        try:
            return (tables.json_object(self.path, STATS_FILE) if has_file(self.path, STATS_FILE) else {}), ""
        except RecorderError as error:
            return {}, str(error)

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
        encoding = about.get("video.codec"), about.get("video.pix_fmt")
        codec = next((name for name, codec in CODECS.items() if (codec.codec, codec.pixel_format) == encoding), None)
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
                cameras={camera: _size(self._shape(key)) for key, camera in content.cameras.items()},
                keys={camera: key for key, camera in content.cameras.items()},
                lossless=all(self._features[key]["dtype"] == "image" for key in content.cameras),
                depth=tuple(content.depth.values()),
                segmentation=tuple(content.segmentation.values()),
                action=self._names(content.names.action),
                vectors={vector: self._names(key) for key, vector in content.vectors.items()},
                signals={signal: self._names(key) for key, signal in content.signals.items()},
                subtasks=bool(self._subtasks),
            ),
            fps=float(self._fps),
            robot=str(self.info.get("robot_type") or ""),
            joint_names=content.joint_names,
            semantics=content.semantics,
            parts=content.parts,
            outcomes=content.outcomes,
        )

    def _names(self, key: str) -> tuple[str, ...]:
        """Return the names of a column's components; numbered ones when the dataset has none."""
        names, size = self._features[key].get("names"), math.prod(self._shape(key))
        if not 0 < size <= _MOST_NUMBERS:
            raise damaged(f"{self.path}: column '{key}' of shape {self._shape(key)}")
        if isinstance(names, dict) and len(names) == 1:  # as early versions nest them: {"motors": [...]}
            names = next(iter(names.values()))
        if isinstance(names, list) and len(names) == size:
            return tuple(str(name) for name in names)
        return tuple(f"{key}.{index}" for index in range(size))

    def read(self, split: str, index: int) -> Episode:
        """Read an episode of a split; its steps are read on demand."""
        place = self._places[split][index]
        with reading(self._where(place)):
            said = self._said[place.number] if place.number < len(self._said) else {}
            texts = self._texts(place)
            return self.description.episode(
                length=place.length,
                instruction=texts[0],
                instructions=tuple(dict.fromkeys(texts)),
                subtasks=tuple(dict.fromkeys(filter(None, self._subtasks_of(place)))),
                success=said.get("success") if said else self._succeeded(place),
                metadata=said,
                read=lambda wanted: self._steps(place, wanted),
            )

    def _where(self, place: Place) -> str:
        return f"{self.path / place.data_file}, episode {place.number}"

    @cached_property
    def _said(self) -> list[dict[str, Any]]:
        """What RoboXim's export says of each episode; empty: it is another's dataset."""
        name = ROBOXIM_EPISODES_FILE
        return tables.json_lines(self.path, name) if has_file(self.path, name) else []

    def _succeeded(self, place: Place) -> bool | None:
        """Return whether the last step says success, as far as the dataset has such a column."""
        if "next.success" in self._features and "next.success" not in self._unread:
            return bool(floats(self._rows(place, ["next.success"]), "next.success", 1, self._where(place))[-1, 0] > 0)
        if "next.reward" in self._features and "next.reward" not in self._unread:
            return solved(floats(self._rows(place, ["next.reward"]), "next.reward", 1, self._where(place)))
        return None

    def _texts(self, place: Place) -> list[str]:
        """Return the instruction of each step."""
        index = self._rows_of(place.data_file)
        rows = index.of(place)
        numbers = [] if index.task is None else index.task[rows].tolist()
        if numbers and all(number in self._tasks for number in set(numbers)):
            return [self._tasks[number] for number in numbers]
        if len(place.tasks) > 1 or (numbers and not place.tasks and self._tasks):
            missing = next((number for number in numbers if number not in self._tasks), "missing")
            raise damaged(f"{self._where(place)}: task_index is {missing} in a step, which meta/tasks does not have")
        return [place.tasks[0] if place.tasks else ""] * place.length

    def _subtasks_of(self, place: Place) -> list[str | None]:
        """Return the subtask of each step; None: the step has none."""
        index = self._rows_of(place.data_file)
        if not self._subtasks or index.subtask is None:
            return [None] * place.length
        return [self._subtasks.get(number) for number in index.subtask[index.of(place)].tolist()]

    # -- steps

    def _steps(self, place: Place, wanted: Wanted) -> Iterator[Step]:
        with reading(self._where(place)):
            yield from self._read_steps(place, wanted)

    def _read_steps(self, place: Place, wanted: Wanted) -> Iterator[Step]:
        content, where = self.content, self._where(place)
        keys = {camera: key for key, camera in content.cameras.items() if camera in wanted.cameras}
        stored = {camera: key for camera, key in keys.items() if self._features[key]["dtype"] == "image"}
        depth = {camera: key for key, camera in content.depth.items() if camera in wanted.depth}
        masks = {camera: key for key, camera in content.segmentation.items() if camera in wanted.segmentation}
        columns = [key for key in self._number_columns() if key in self._features and key not in self._unread]
        encoded = [*stored.values(), *depth.values(), *masks.values()]
        table = self._rows(place, [*columns, *encoded])
        numbers = {key: floats(table, key, math.prod(self._shape(key)), where) for key in columns}
        videos = {camera: self._frames(place, key) for camera, key in keys.items() if camera not in stored}
        texts = self._texts(place)
        several, subtasks = len(set(texts)) > 1, self._subtasks_of(place)
        deep, sizes = [*depth.items(), *masks.items()], self.features.cameras
        units = {key: self._unit_m(key) or DEPTH_UNIT_M for key in depth.values()}
        for step in range(place.length):
            read = {key: self._image_bytes(cells(table, key, step, where)) for key in encoded}
            images: dict[str, RGBImage] = {camera: next(frames) for camera, frames in videos.items()}
            with reading(f"{where}, step {step}"):
                images |= {
                    camera: decoded(colour_picture, read[key], sizes[camera], f"{where}, step {step}, '{key}'")
                    for camera, key in stored.items()
                }
                maps = {
                    key: decoded(deep_picture, read[key], sizes[camera], f"{where}, step {step}, '{key}'")
                    for camera, key in deep
                }
            yield Step(
                index=step,
                images={camera: images[camera] for camera in keys},
                depth={camera: maps[key] * np.float32(units[key]) for camera, key in depth.items()},
                segmentation={camera: maps[key] for camera, key in masks.items()},
                proprio={vector: numbers[key][step] for key, vector in content.vectors.items()},
                action=numbers[content.names.action][step],
                action_executed=numbers[EXECUTED][step] if EXECUTED in numbers else None,
                signals={name: numbers[key][step] for key, name in content.signals.items() if key != EXECUTED},
                reward=float(numbers[content.names.reward][step, 0]) if content.names.reward in numbers else 0.0,
                instruction=texts[step] if several else None,
                subtask=subtasks[step],
                stamp_s=float(numbers[_TIMESTAMP][step, 0]) if _TIMESTAMP in numbers else None,
            )
        for frames in videos.values():  # ends the decoding; a broken file says so
            next(frames, None)

    def _number_columns(self) -> tuple[str, ...]:
        """Return the columns of numbers that steps consist of."""
        content = self.content
        return (*content.vectors, content.names.action, *content.signals, content.names.reward, _TIMESTAMP)

    def _frames(self, place: Place, key: str) -> Iterator[RGBImage]:
        file, first = place.videos[key]
        size = _size(self._shape(key))
        sizes = {"height": size.height, "width": size.width}
        return self._decoder.frames(file_in(self.path, file), rate=self._fps, first=first, count=place.length, **sizes)

    def _image_bytes(self, cell: Mapping[str, Any]) -> bytes:
        if cell.get("bytes"):
            return bytes(cell["bytes"])
        return file_in(self.path, str(cell.get("path"))).read_bytes()

    def _rows_of(self, name: str) -> Rows:
        """Return which rows of a data file belong to which episode; the last file is kept."""
        if self._index is None or self._index.file != name:
            self._index = tables.rows_of(self.path, name)
        return self._index

    def _rows(self, place: Place, columns: Sequence[str]) -> pa.Table:
        """Read the rows of an episode."""
        rows = self._rows_of(place.data_file).of(place)
        if self._file is None or self._file[0] != place.data_file:
            self._file = (place.data_file, open_parquet(self.path, place.data_file))
        file, begin, start = self._file[1], 0, 0
        lacking = [name for name in columns if name not in file.schema_arrow.names]
        if lacking:
            raise damaged(f"{self._where(place)}: the file has no column '{lacking[0]}'")
        first, last = int(rows.min()), int(rows.max())
        groups: list[int] = []
        for group in range(file.num_row_groups):
            count = file.metadata.row_group(group).num_rows
            if begin <= last and begin + count > first:
                start = begin if not groups else start
                groups.append(group)
            begin += count
        table = file.read_row_groups(groups, columns=list(columns))
        if last - first + 1 == len(rows) and bool((np.diff(rows) == 1).all()):
            return table.slice(first - start, len(rows))
        return table.take(rows - start)

    def tasks(self) -> list[str]:
        """Return the instructions, by their number."""
        return [text for _, text in sorted(self._tasks.items())]

    # -- what the files hold

    def _take_stock(self, account: Account) -> None:
        self._take_stock_of_episodes(account)
        content = self.content
        own = bool(self._said)
        read = {*self._number_columns(), *content.cameras, *content.depth, *content.segmentation, "next.success"}
        read |= {SUBTASK_INDEX} if self._subtasks else set()
        taken: set[int] = set()
        steps = sum(place.length for place in self._table.places.values())
        lengths: dict[str, int] = {}
        for place in self._table.places.values():
            lengths[place.data_file] = lengths.get(place.data_file, 0) + place.length
        for file in files_below(self.path, "data/**/*.parquet"):
            name = str(file.relative_to(self.path.resolve())) if file.is_relative_to(self.path.resolve()) else file.name
            rows, columns = tables.rows_of(self.path, name), peek(self.path, name)
            account.holds("row", name, rows.count)
            account.reads("row", name, lengths.get(name, 0))
            account.leaves_out("row", name, "no episode of meta/episodes has them")
            if rows.task is not None:
                taken |= set(np.unique(rows.task).tolist())
            for key in columns:
                account.holds("key", key, rows.count)
                if key in INDEX_COLUMNS and key != _TIMESTAMP or key == content.names.done:
                    account.implies("key", key, "the order of the rows", rows.count)
                elif key in read and key not in self._unread:
                    account.reads("key", key, lengths.get(name, 0), "" if own else self._changed(key))
                    account.leaves_out("key", key, "in rows of no episode", rows.count - lengths.get(name, 0))
                else:
                    account.leaves_out("key", key, self._unread.get(key, "meta/info.json does not name it"), rows.count)
        for key, feature in self._features.items():
            if feature["dtype"] == "video":
                account.holds("key", key, steps)
                account.leaves_out("key", key, self._unread.get(key, ""), steps * (key in self._unread))
                account.reads("key", key)
            elif not account.knows("key", key):
                account.holds("key", key, 0)
        for number, text in self._tasks.items():
            account.holds("task", f"{number} '{text}'")
            account.leaves_out("task", f"{number} '{text}'", "no step has it", int(number not in taken))
            account.reads("task", f"{number} '{text}'")
        account.holds("rate", f"{float(self._fps):g} Hz")
        account.reads("rate", f"{float(self._fps):g} Hz")
        if has_file(self.path, STATS_FILE):
            account.holds("statistics", STATS_FILE)
            if why := self._statistics[1]:
                account.leaves_out("statistics", STATS_FILE, f"{why}; {self._not_finite()}")
            account.reads("statistics", STATS_FILE)

    def _take_stock_of_episodes(self, account: Account) -> None:
        for split, places in self._places.items():
            for place in places:
                account.holds("episode", str(place.number))
                lag = "no split names it, read as train" if place.number in self._in_no_split else ""
                account.reads("episode", str(place.number), changed=lag)
            account.holds("split", split, 0)
        for name, why in self._table.left_out.items():
            account.holds("episode", name)
            account.leaves_out("episode", name, why)
        splits = self.info.get("splits")
        for split in splits if isinstance(splits, dict) else ():
            account.holds("split", str(split))
            if split in self._lost_splits:
                account.leaves_out("split", str(split), self._lost_splits[split])
            account.reads("split", str(split))
        for name, number in (
            ("total_episodes", len(self._table.places) + len(self._table.left_out)),
            ("total_frames", sum(place.length for place in self._table.places.values())),
        ):
            if name in self.info:
                account.holds("metadata", name)
                if self.info[name] != number:
                    why = f"it says {printable(self.info[name], 60)}, the table of episodes has {number}"
                    account.leaves_out("metadata", name, why)
                account.implies("metadata", name, "the table of episodes")

    def _changed(self, key: str) -> str:
        dtype = str(self._features[key]["dtype"])
        if key in self.content.depth:
            return f"depth in units of {self._unit_m(key) or DEPTH_UNIT_M:g} m, read as metres"
        return "" if dtype in ("float32", "image", "video") or key == "next.success" else f"{dtype}, read as float32"

    def _not_finite(self) -> str:
        """Return which episodes have numbers that are not finite."""
        found = []
        for place in self._table.places.values():
            for key in (*self.content.vectors, self.content.names.action):
                with reading(self._where(place)):
                    values = floats(self._rows(place, [key]), key, math.prod(self._shape(key)), self._where(place))
                if not np.isfinite(values).all():
                    found.append(f"episode {place.number} in '{key}'")
        return "not finite: " + ", ".join(found[:5]) if found else "all numbers that are read are finite"


def _apart(names: Mapping[str, str]) -> dict[str, str]:
    """Return names of columns of which no two are equal: those that were get the column's own."""
    found = list(names.values())
    return {key: name if found.count(name) == 1 else key.replace("/", ".") for key, name in names.items()}


def _size(shape: Sequence[int]) -> ImageSize:
    """Return the size of a column of images, whose shape has the channels last, or first in some datasets.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when it is no shape of an image.
    """
    if len(shape) != 3:
        raise damaged(f"images of shape {tuple(shape)}, expected (height, width, channels)")
    if shape[0] in (1, 3) and shape[-1] not in (1, 3):
        shape = [*shape[1:], shape[0]]
    return ImageSize(height=shape[0], width=shape[1])
