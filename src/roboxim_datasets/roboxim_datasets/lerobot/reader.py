"""Reads LeRobot datasets of versions 2.1 and 3.0, RoboXim's and others', without lerobot.

RoboXim's exports say in ``meta/roboxim.json`` what their numbers mean. What is known of another
dataset, `meta` describes. The account of the dataset names everything that is not read.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from roboxim_core.errors import RecorderError
from roboxim_datasets.account import Account
from roboxim_datasets.dataset import Dataset, Description, Features
from roboxim_datasets.episode import EXECUTED, Episode, RGBImage, Step, Wanted, solved
from roboxim_datasets.files import file_in, has_file, reading
from roboxim_datasets.lerobot import tables
from roboxim_datasets.lerobot.account import take_stock
from roboxim_datasets.lerobot.columns import cells, floats
from roboxim_datasets.lerobot.layout import (
    DEPTH_UNIT_M,
    NAMES,
    ROBOXIM_EPISODES_FILE,
    STATS_FILE,
)
from roboxim_datasets.lerobot.meta import TIMESTAMP, LeRobotMeta, image_size
from roboxim_datasets.lerobot.parquet_file import open_parquet
from roboxim_datasets.lerobot.tables import Place, Rows, damaged
from roboxim_datasets.pictures import colour_picture, decoded, deep_picture
from roboxim_datasets.video.client import VideoDecoder
from roboxim_datasets.video.codecs import CODECS

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

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
        self.meta = LeRobotMeta(path, depth_unit_m)
        self.version, self.content = self.meta.version, self.meta.content
        self._decoder = VideoDecoder()
        self._file: tuple[str, pq.ParquetFile] | None = None
        self._index: Rows | None = None

    @property
    def splits(self) -> Mapping[str, int]:
        """Split to its number of episodes."""
        return {name: len(places) for name, places in self.meta.splits.items()}

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
        found: dict[str, Any] = {"version": "3.0" if self.meta.version == "3.0" else "2.1"}
        if self.content.names.action == NAMES["openpi"].action:
            found["columns"] = "openpi"
        kinds = [self.meta.features[key] for key in self.content.cameras]
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
        return _LOADING[self.meta.version]

    @cached_property
    def description(self) -> Description:
        """What ``meta/`` says."""
        content = self.content
        return Description(
            features=Features(
                cameras={camera: image_size(self.meta.shape(key)) for key, camera in content.cameras.items()},
                keys={camera: key for key, camera in content.cameras.items()},
                lossless=all(self.meta.features[key]["dtype"] == "image" for key in content.cameras),
                depth=tuple(content.depth.values()),
                segmentation=tuple(content.segmentation.values()),
                action=self.meta.names(content.names.action),
                vectors={vector: self.meta.names(key) for key, vector in content.vectors.items()},
                signals={signal: self.meta.names(key) for key, signal in content.signals.items()},
                subtasks=bool(self.meta.subtasks),
            ),
            fps=float(self.meta.fps),
            robot=str(self.meta.info.get("robot_type") or ""),
            joint_names=content.joint_names,
            semantics=content.semantics,
            parts=content.parts,
            outcomes=content.outcomes,
        )

    def read(self, split: str, index: int) -> Episode:
        """Read an episode of a split; its steps are read on demand."""
        place = self.meta.splits[split][index]
        with reading(self._where(place)):
            metadata = self._exported[place.number] if place.number < len(self._exported) else {}
            texts = self._texts(place)
            return self.description.episode(
                length=place.length,
                instruction=texts[0],
                instructions=tuple(dict.fromkeys(texts)),
                subtasks=tuple(dict.fromkeys(filter(None, self._subtasks_of(place)))),
                success=metadata.get("success") if metadata else self._succeeded(place),
                metadata=metadata,
                read=lambda wanted: self._steps(place, wanted),
            )

    def _where(self, place: Place) -> str:
        return f"{self.path / place.data_file}, episode {place.number}"

    @cached_property
    def _exported(self) -> list[dict[str, Any]]:
        """What RoboXim's export says of each episode; empty: it is another's dataset."""
        name = ROBOXIM_EPISODES_FILE
        return tables.json_lines(self.path, name) if has_file(self.path, name) else []

    def _succeeded(self, place: Place) -> bool | None:
        """Return whether the last step is marked as a success; None: the dataset has no such column."""
        if "next.success" in self.meta.features and "next.success" not in self.meta.unread:
            return bool(floats(self._rows(place, ["next.success"]), "next.success", 1, self._where(place))[-1, 0] > 0)
        if "next.reward" in self.meta.features and "next.reward" not in self.meta.unread:
            return solved(floats(self._rows(place, ["next.reward"]), "next.reward", 1, self._where(place)))
        return None

    def _texts(self, place: Place) -> list[str]:
        """Return the instruction of each step."""
        index = self._rows_of(place.data_file)
        rows = index.of(place)
        numbers = [] if index.task is None else index.task[rows].tolist()
        if numbers and all(number in self.meta.tasks for number in set(numbers)):
            return [self.meta.tasks[number] for number in numbers]
        if len(place.tasks) > 1 or (numbers and not place.tasks and self.meta.tasks):
            missing = next((number for number in numbers if number not in self.meta.tasks), "missing")
            raise damaged(f"{self._where(place)}: task_index is {missing} in a step, which meta/tasks does not have")
        return [place.tasks[0] if place.tasks else ""] * place.length

    def _subtasks_of(self, place: Place) -> list[str | None]:
        """Return the subtask of each step; None: the step has none."""
        index = self._rows_of(place.data_file)
        if not self.meta.subtasks or index.subtask is None:
            return [None] * place.length
        return [self.meta.subtasks.get(number) for number in index.subtask[index.of(place)].tolist()]

    # -- steps

    def _steps(self, place: Place, wanted: Wanted) -> Iterator[Step]:
        with reading(self._where(place)):
            yield from self._read_steps(place, wanted)

    def _read_steps(self, place: Place, wanted: Wanted) -> Iterator[Step]:
        content, where = self.content, self._where(place)
        keys = {camera: key for key, camera in content.cameras.items() if camera in wanted.cameras}
        stored = {camera: key for camera, key in keys.items() if self.meta.features[key]["dtype"] == "image"}
        depth = {camera: key for key, camera in content.depth.items() if camera in wanted.depth}
        masks = {camera: key for key, camera in content.segmentation.items() if camera in wanted.segmentation}
        columns = [key for key in self.meta.number_columns if key in self.meta.features and key not in self.meta.unread]
        films = {camera: levels for camera, key in depth.items() if (levels := self.meta.levels(key))}
        pictured = {camera: key for camera, key in depth.items() if camera not in films}
        encoded = [*stored.values(), *pictured.values(), *masks.values()]
        table = self._rows(place, [*columns, *encoded])
        numbers = {key: floats(table, key, math.prod(self.meta.shape(key)), where) for key in columns}
        videos = {camera: self._frames(place, key) for camera, key in keys.items() if camera not in stored}
        texts = self._texts(place)
        several, subtasks = len(set(texts)) > 1, self._subtasks_of(place)
        films_of_depth = {camera: self._frames(place, depth[camera], deep=True) for camera in films}
        deep, sizes = [*pictured.items(), *masks.items()], self.features.cameras
        units = {key: self.meta.unit_m(key) or DEPTH_UNIT_M for key in pictured.values()}
        for step in range(place.length):
            read = {key: self._image_bytes(cells(table, key, step, where)) for key in encoded}
            images: dict[str, RGBImage] = {camera: next(frames) for camera, frames in videos.items()}
            filmed = {camera: films[camera].metres(next(frames)) for camera, frames in films_of_depth.items()}
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
                depth=filmed | {camera: maps[key] * np.float32(units[key]) for camera, key in pictured.items()},
                segmentation={camera: maps[key] for camera, key in masks.items()},
                proprio={vector: numbers[key][step] for key, vector in content.vectors.items()},
                action=numbers[content.names.action][step],
                action_executed=numbers[EXECUTED][step] if EXECUTED in numbers else None,
                signals={name: numbers[key][step] for key, name in content.signals.items() if key != EXECUTED},
                reward=float(numbers[content.names.reward][step, 0]) if content.names.reward in numbers else 0.0,
                instruction=texts[step] if several else None,
                subtask=subtasks[step],
                stamp_s=float(numbers[TIMESTAMP][step, 0]) if TIMESTAMP in numbers else None,
            )
        for frames in (*videos.values(), *films_of_depth.values()):  # ends the decoding; a broken file says so
            next(frames, None)

    def _frames(self, place: Place, key: str, *, deep: bool = False) -> Iterator[Any]:
        file, first = place.videos[key]
        size, path = image_size(self.meta.shape(key)), file_in(self.path, file)
        shape = {"height": size.height, "width": size.width}
        return self._decoder.frames(path, rate=self.meta.fps, first=first, count=place.length, deep=deep, **shape)

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
        return [text for _, text in sorted(self.meta.tasks.items())]

    def _take_stock(self, account: Account) -> None:
        why = self._statistics[1]
        take_stock(account, self.meta, own=bool(self._exported), unusable=f"{why}; {self._not_finite()}" if why else "")

    def _not_finite(self) -> str:
        """Return which episodes have numbers that are not finite."""
        found = []
        for place in self.meta.table.places.values():
            for key in (*self.content.vectors, self.content.names.action):
                with reading(self._where(place)):
                    values = floats(self._rows(place, [key]), key, math.prod(self.meta.shape(key)), self._where(place))
                if not np.isfinite(values).all():
                    found.append(f"episode {place.number} in '{key}'")
        return "not finite: " + ", ".join(found[:5]) if found else "all numbers that are read are finite"
