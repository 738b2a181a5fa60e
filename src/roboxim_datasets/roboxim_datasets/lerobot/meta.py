"""What the files in ``meta/`` of a LeRobot dataset say: its columns, episodes, splits, instructions.

Of a dataset of others only the format's own facts are known: the meaning of its actions is unknown (None), its cameras
are called like its image columns, and its vectors like its columns ``observation.``... A column that is not read is in
`LeRobotMeta.unread`, with the reason.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

from roboxim_core.errors import ConfigError, InvalidRequestError, RecorderError, printable
from roboxim_datasets.depth import camera_of
from roboxim_datasets.episode import SIGNAL_PREFIX, ImageSize
from roboxim_datasets.files import has_file
from roboxim_datasets.lerobot import tables
from roboxim_datasets.lerobot.columns import peek
from roboxim_datasets.lerobot.content import LeRobotContent
from roboxim_datasets.lerobot.depth_video import Levels, is_depth_video, levels_of
from roboxim_datasets.lerobot.layout import (
    DEPTH_UNITS_M,
    INDEX_COLUMNS,
    INFO_FILE,
    ROBOXIM_FILE,
    SUBTASK_INDEX,
    SUBTASKS,
    TASKS,
    LeRobotNames,
)
from roboxim_datasets.lerobot.tables import Place, damaged
from roboxim_datasets.pictures import MAX_PIXELS, head_of

TIMESTAMP = "timestamp"
_STATES = ("observation.state", "state")
_ACTIONS = ("action", "actions")
_OBSERVED = "observation."
_CAMERA_PREFIX = "observation.images."
_VERSIONS = ("3.0", "2.1", "2.0")
_MAX_NUMBERS = 1024  # of a column that is read as a vector
_SPLIT = re.compile(r"\s*(\d{1,15})\s*:\s*(\d{1,15})\s*")
_FASTEST = 10_000.0  # steps per second that are believed


class LeRobotMeta:
    """Content of ``meta/``, checked.

    Attributes:
        info: Content of ``info.json``.
        version: Version of the format, e.g. ``3.0``.
        fps: Steps per second.
        features: Column to its description in ``info.json``.
        unread: Column that is not read, to the reason.
        table: The episodes, and where each one's rows and frames are.
        tasks: Number to instruction.
        subtasks: Number to subtask; empty when steps state none.
        splits: Split to its episodes.
        lost_splits: Split to what is wrong with it.
        in_no_split: Numbers of the episodes that no split names.
        content: Where the parts of an episode are.
    """

    def __init__(self, path: Path, depth_unit_m: float) -> None:
        """Read the files.

        Args:
            path: Folder of the dataset, which holds ``meta/info.json``.
            depth_unit_m: Unit of the 16-bit depth images of others [m]; 0: unknown, so they are left out.

        Raises:
            InvalidRequestError: When a unit is stated of RoboXim's own dataset, which says it.
            RecorderError: When there is no dataset, its description is damaged, or its version is unknown.
        """
        self.path, self.depth_unit_m = path, depth_unit_m
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

    def _open(self) -> None:
        self.version = str(self.info["codebase_version"]).removeprefix("v")
        if self.version not in _VERSIONS:
            raise RecorderError(
                f"{self.path} is of version {printable(self.version, 60)}; expected one of {', '.join(_VERSIONS)}. The "
                "package lerobot converts older ones"
            )
        try:
            self.fps = Fraction(str(self.info["fps"]))
        except ValueError:
            stated = printable(self.info["fps"], 60)
            raise damaged(f"{self.path / INFO_FILE}: fps is {stated}, expected steps per second above 0") from None
        if not 0 < self.fps <= _FASTEST:
            raise damaged(f"{self.path / INFO_FILE}: fps is {float(self.fps):g}, expected steps per second above 0")
        self.features: dict[str, Any] = dict(self.info["features"])
        self.unread: dict[str, str] = {}  # column to why it is not read
        own = has_file(self.path, ROBOXIM_FILE)
        videos = self._video_keys(own=own)
        if self.version == "3.0":
            self.table = tables.episodes_30(self.path, self.info, videos, float(self.fps))
        else:
            self.table = tables.episodes_21(self.path, self.info, videos)
        self.tasks = tables.texts_of(self.path, TASKS, self.version)
        self.subtasks = tables.texts_of(self.path, SUBTASKS, self.version) if SUBTASK_INDEX in self.features else {}
        self.splits, self.lost_splits = self._split()
        if not self.table.places:
            raise damaged(f"{self.path} has no episode with steps in its table of episodes (meta/episodes)")
        self.content = self._own_content() if own else self._content()

    def _own_content(self) -> LeRobotContent:
        if self.depth_unit_m:
            raise InvalidRequestError(f"{self.path} states the unit of its depth; leave --depth-unit out")
        data = tables.json_object(self.path, ROBOXIM_FILE)
        content = LeRobotContent.from_json(data, str(self.path / ROBOXIM_FILE))
        for key in (*content.cameras, *content.vectors, *content.signals, content.names.action):
            self.shape(key)
        return content

    def _video_keys(self, *, own: bool) -> list[str]:
        found = []
        for key, feature in self.features.items():
            if feature["dtype"] == "video":
                self.unread |= {} if own or not (why := self._no_colour(key)) else {key: why}
                found += [] if key in self.unread and not self._is_of_camera(key) else [key]
        return found

    def _is_of_camera(self, key: str) -> bool:
        """Return whether a video of depth can be that of a camera, by its name."""
        images = [name for name, feature in self.features.items() if feature["dtype"] in ("image", "video")]
        cameras = [name.removeprefix(_CAMERA_PREFIX) for name in images if not self._no_colour(name)]
        return self.levels(key) is not None and bool(camera_of(key.removeprefix(_CAMERA_PREFIX), cameras))

    def _no_colour(self, key: str) -> str:
        """Return why a column of images is none of colour images; empty: it is one, as far as its description says."""
        feature = self.features[key]
        shape = self.shape(key)
        if feature["dtype"] == "video" and (why := self._deep_video(key)):
            return why
        if len(shape) != 3 or 3 not in (shape[0], shape[2]):
            what = "16-bit depth or grey images" if len(shape) == 3 and 1 in (shape[0], shape[2]) else "images"
            return f"{what} of shape {shape}; only colour images of three channels are read"
        size = image_size(shape)
        if not 0 < size.height * size.width <= MAX_PIXELS:
            return f"images of {size.width} x {size.height} pixels; 1 to {MAX_PIXELS} are read"
        return ""

    def _about(self, key: str) -> Mapping[str, Any]:
        """Return what ``info.json`` says of a column's images."""
        feature = self.features[key]
        parts = [feature[name] for name in ("video_info", "info") if isinstance(feature.get(name), dict)]
        return {name: value for part in parts for name, value in part.items()}

    def _deep_video(self, key: str) -> str:
        """Return why a video is none of colours; empty: it is one, as far as its description says."""
        about = self._about(key)
        if not is_depth_video(about):
            return ""
        levels = levels_of(about, self.unit_m(key))
        return levels if isinstance(levels, str) else str(levels)

    def levels(self, key: str) -> Levels | None:
        """Return what the numbers of a video of depth mean; None: it is none, or nothing says it."""
        about = self._about(key)
        if self.features[key]["dtype"] != "video" or not is_depth_video(about):
            return None
        levels = levels_of(about, self.unit_m(key))
        return None if isinstance(levels, str) else levels

    def unit_m(self, key: str) -> float:
        """Return the unit of a column of depth images [m], as ``info.json`` or the user states it; 0: unknown."""
        return DEPTH_UNITS_M.get(str(self._about(key).get("depth_unit")), self.depth_unit_m)

    def _content(self) -> LeRobotContent:
        """Return where the parts of an episode are by the usual names."""
        first = next(iter(self.table.places.values()))
        columns = peek(self.path, first.data_file)
        cameras: dict[str, str] = {}
        vectors: list[str] = []
        signals: list[str] = []
        state = next((name for name in _STATES if name in self.features), "")
        action = next((name for name in _ACTIONS if name in self.features), "")
        if not action:
            raise RecorderError(f"{self.path} has no column of actions; expected {' or '.join(_ACTIONS)}")
        for key, feature in self.features.items():
            if key in self.unread or key in INDEX_COLUMNS or (key == SUBTASK_INDEX and self.subtasks):
                continue
            kind = feature["dtype"]
            if kind not in ("image", "video") and kind != "string" and key not in columns:
                self.unread[key] = f"{first.data_file} has no such column"
            elif kind == "image" and (why := self._no_colour(key) or self._deep(columns.get(key))):
                self.unread[key] = why
            elif kind in ("image", "video"):
                cameras[key] = key.removeprefix(_CAMERA_PREFIX).replace("/", ".")
            elif key not in (action, "next.reward", "next.done", "next.success"):
                self.unread |= {key: why} if (why := self._no_vector(key)) else {}
                if not self.unread.get(key):
                    (signals if key.startswith(SIGNAL_PREFIX) else vectors).append(key)
        if why := self.unread.get(action) or self._no_vector(action):
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
            outcomes="next.success" in self.features and "next.success" not in self.unread,
        )

    def _deep(self, cell: Any) -> str:
        """Return why the images of a column are none of colours, by its first one; empty: they are."""
        data = cell.get("bytes") if isinstance(cell, dict) else None
        deep = data and head_of(data).deep
        return "16-bit depth images, whose unit the format does not state (--depth-unit does)" if deep else ""

    def _depth(self, cameras: Mapping[str, str], columns: Mapping[str, Any]) -> dict[str, str]:
        """Return the columns of depth images and videos that become a camera's depth, if it is known what they mean."""
        found: dict[str, str] = {}
        for key in self.unread:
            video = self.levels(key) is not None
            image = self.features[key]["dtype"] == "image" and self.unit_m(key) and self._deep(columns.get(key))
            if not video and not image:
                continue
            if self.depth_unit_m not in (0, self.unit_m(key)):
                unit = self._about(key)["depth_unit"]
                raise InvalidRequestError(f"{self.path} says that '{key}' is in {unit}; leave --depth-unit out")
            camera = camera_of(key.removeprefix(_CAMERA_PREFIX), cameras.values())
            size = image_size(self.shape(key)) if video else head_of(columns[key]["bytes"]).size
            colour = next((image_size(self.shape(name)) for name, own in cameras.items() if own == camera), None)
            if colour == size and camera not in found.values():
                found[key] = camera
            else:
                kind = "a video of depth" if video else "16-bit depth images"
                self.unread[key] = (
                    f"{kind} of {size.width} x {size.height} without a colour camera of that name and size"
                )
        self.unread = {key: why for key, why in self.unread.items() if key not in found}
        return found

    def _no_vector(self, key: str) -> str:
        """Return why a column is no vector of observed numbers; empty: it is one."""
        dtype = str(self.features[key]["dtype"])
        if not dtype.startswith(("float", "int", "uint", "bool")):
            return f"values of the type {printable(dtype, 60)}"
        size = math.prod(self.shape(key))
        if not 0 < size <= _MAX_NUMBERS:
            return f"shape {self.shape(key)}; 1 to {_MAX_NUMBERS} numbers are read as a vector"
        if key in _ACTIONS or key in _STATES or key.startswith((_OBSERVED, SIGNAL_PREFIX)):
            return ""
        return f"{dtype} of shape {self.shape(key)}, not an observation"

    def shape(self, key: str) -> tuple[int, ...]:
        """Return the shape of a column's values in one step.

        Raises:
            RecorderError: With code ``BAG_DAMAGED`` when there is no such column.
        """
        if key not in self.features:
            raise damaged(f"{self.path / INFO_FILE} has no feature '{key}'")
        shape = self.features[key].get("shape")
        return tuple(int(side) for side in (shape if isinstance(shape, list) else [1]))

    def _split(self) -> tuple[dict[str, list[Place]], dict[str, str]]:
        """Return split to its episodes, and split to what is wrong with it.

        Episodes that no split names are in ``train``: lerobot reads them too, and edited datasets lag behind.
        """
        splits = self.info.get("splits")
        found: dict[str, list[Place]] = {"train": []}
        lost: dict[str, str] = {}
        left = dict(sorted(self.table.places.items()))
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
        self.in_no_split = set(left)
        found["train"].extend(left.values())
        return {name: places for name, places in found.items() if places}, lost

    def names(self, key: str) -> tuple[str, ...]:
        """Return the names of a column's components; numbered ones when the dataset has none."""
        names, size = self.features[key].get("names"), math.prod(self.shape(key))
        if not 0 < size <= _MAX_NUMBERS:
            raise damaged(f"{self.path}: column '{key}' of shape {self.shape(key)}")
        if isinstance(names, dict) and len(names) == 1:  # as early versions nest them: {"motors": [...]}
            names = next(iter(names.values()))
        if isinstance(names, list) and len(names) == size:
            return tuple(str(name) for name in names)
        return tuple(f"{key}.{index}" for index in range(size))

    @property
    def number_columns(self) -> tuple[str, ...]:
        """The columns of numbers that steps consist of."""
        content = self.content
        return (*content.vectors, content.names.action, *content.signals, content.names.reward, TIMESTAMP)


def _apart(names: Mapping[str, str]) -> dict[str, str]:
    """Return names of columns of which no two are equal: those that were get the column's own."""
    found = list(names.values())
    return {key: name if found.count(name) == 1 else key.replace("/", ".") for key, name in names.items()}


def image_size(shape: Sequence[int]) -> ImageSize:
    """Return the size of a column of images, whose shape has the channels last, or first in some datasets.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when it is no shape of an image.
    """
    if len(shape) != 3:
        raise damaged(f"images of shape {tuple(shape)}, expected (height, width, channels)")
    if shape[0] in (1, 3) and shape[-1] not in (1, 3):
        shape = [*shape[1:], shape[0]]
    return ImageSize(height=shape[0], width=shape[1])
