"""The tables of a LeRobot dataset: which episodes it has, where each one's rows, frames and instructions are.

Datasets are edited, so nothing is found by its position: episodes by ``episode_index``, rows by ``episode_index`` and
``frame_index``, instructions by ``task_index``.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ConfigError, ErrorCode, RecorderError, printable
from roboxim_core.plain_data.documents import read_json_object, read_text
from roboxim_datasets.files import file_in, files_below, has_file, reading
from roboxim_datasets.lerobot.layout import SUBTASK_INDEX, table_of_texts
from roboxim_datasets.lerobot.parquet_file import open_parquet

if TYPE_CHECKING:
    import pyarrow as pa

Ints = npt.NDArray[np.int64]
_MAX_TEXT_BYTES = 2**28
_WORD = re.compile(r"\{(\w+)(?::0?(\d{1,2})d)?\}")
INDICES = ("episode_index", "frame_index", "task_index", SUBTASK_INDEX)


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where an episode is."""

    number: int
    """Its ``episode_index``."""
    length: int
    """Number of its steps."""
    tasks: tuple[str, ...]
    """Its instructions, as the table of episodes says."""
    data_file: str
    """File of its rows."""
    videos: Mapping[str, tuple[str, Fraction]]
    """Column to the video file and the time of its first step in it [steps]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Rows:
    """Which rows of a data file belong to which episode."""

    file: str
    """The file."""
    episode: Ints | None
    """Episode of each row; None: the file does not say."""
    frame: Ints | None
    """Number of each row in its episode; None: the file does not say."""
    task: Ints | None
    """Number of each row's instruction; None: the file does not say."""
    subtask: Ints | None
    """Number of each row's subtask; None: the file does not say."""
    count: int
    """Number of rows."""

    def of(self, place: Place) -> Ints:
        """Return the numbers of an episode's rows in the file, in the order of its steps.

        Raises:
            RecorderError: With code ``BAG_DAMAGED`` when they are not exactly its steps.
        """
        rows = np.arange(self.count) if self.episode is None else np.flatnonzero(self.episode == place.number)
        where = f"{self.file}, episode {place.number}"
        if len(rows) != place.length:
            raise damaged(f"{where}: {len(rows)} rows, but the table of episodes says {place.length} steps")
        if self.frame is None:
            return rows
        rows = rows[np.argsort(self.frame[rows], kind="stable")]
        wrong = np.flatnonzero(self.frame[rows] != np.arange(len(rows)))
        if len(wrong):
            raise damaged(
                f"{where}: its rows are not numbered 0 to {place.length - 1} by frame_index; "
                f"{int(self.frame[rows[wrong[0]]])} stands where {int(wrong[0])} is expected"
            )
        return rows


@dataclass(kw_only=True)
class Episodes:
    """The table of episodes."""

    places: dict[int, Place] = field(default_factory=dict)
    """``episode_index`` to the episode."""
    left_out: dict[str, str] = field(default_factory=dict)
    """Name of a row that is no episode to the reason."""

    def add(self, place: Place) -> None:
        """Add a row; one without steps or of a number that another row has is left out."""
        name = str(place.number)
        if place.number in self.places or name in self.left_out:
            self.left_out[f"{name} (again)"] = "an earlier row has the same episode_index"
        elif not place.length:
            self.left_out[name] = "it has no steps"
        else:
            self.places[place.number] = place


def damaged(message: str) -> RecorderError:
    """Return the error of a damaged file."""
    return RecorderError(message, ErrorCode.BAG_DAMAGED)


def path_of(template: object, **values: str | int) -> str:
    """Return the path that a template of ``info.json`` stands for.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when it is no such template.
    """
    text = str(template)
    rest = _WORD.sub("", text)
    unknown = {found[1] for found in _WORD.finditer(text)} - values.keys()
    if not isinstance(template, str) or "{" in rest or "}" in rest or unknown:
        raise damaged(f"meta/info.json: unknown template of paths '{printable(text, 200)}'; known: {', '.join(values)}")

    def filled(found: re.Match[str]) -> str:
        value = values[found[1]]
        return f"{value:0{found[2]}d}" if found[2] and isinstance(value, int) else str(value)

    return _WORD.sub(filled, text)


def json_object(folder: Path, name: str) -> dict[str, Any]:
    """Read a JSON file of a dataset.

    Raises:
        RecorderError: With code ``BAG_DAMAGED``, naming it.
    """
    try:
        return read_json_object(file_in(folder, name), _MAX_TEXT_BYTES)
    except ConfigError as error:
        raise damaged(f"the dataset's description cannot be read: {error}") from None


def json_lines(folder: Path, name: str) -> list[dict[str, Any]]:
    """Read the objects in the lines of a file. Only a line feed ends a line: texts may have other separators.

    Raises:
        RecorderError: With code ``BAG_DAMAGED``, naming it.
    """
    try:
        text = read_text(file_in(folder, name), _MAX_TEXT_BYTES)
    except ConfigError as error:
        raise damaged(str(error)) from None
    found = []
    for number, line in enumerate(text.split("\n"), start=1):
        if not line.strip():
            continue
        try:
            value = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise damaged(f"{folder / name} line {number} is damaged: {error}") from None
        if not isinstance(value, dict):
            raise damaged(f"{folder / name} line {number} is damaged: expected a JSON object")
        found.append(value)
    return found


def episodes_30(folder: Path, info: Mapping[str, Any], videos: Sequence[str], fps: float) -> Episodes:
    """Read the table of episodes of version 3.0.

    Raises:
        RecorderError: With code ``BAG_DAMAGED``, naming the file.
    """
    parts = ("chunk_index", "file_index", "from_timestamp")
    wanted = ["episode_index", "length", "tasks", "data/chunk_index", "data/file_index"]
    wanted += [f"videos/{key}/{name}" for key in videos for name in parts]
    rows: list[dict[str, Any]] = []
    for file in files_below(folder, "meta/episodes/*/*.parquet"):
        with reading(file):
            opened = open_parquet(folder, file)
            names = opened.schema_arrow.names
            rows += opened.read(columns=[name for name in wanted if name in names]).to_pylist()
    found = Episodes()
    for row in rows:
        number = _count(row, "episode_index", "meta/episodes")
        where = f"meta/episodes, episode {number}"
        at = {name: _count(row, f"data/{name}", where) for name in parts[:2]}
        starts = {}
        for key in videos:
            chunk, part = (_count(row, f"videos/{key}/{name}", where) for name in parts[:2])
            begin = row.get(f"videos/{key}/from_timestamp")
            if not isinstance(begin, int | float) or not math.isfinite(begin * fps) or begin < 0:
                raise damaged(f"{where}: 'videos/{key}/from_timestamp' is {begin}, expected seconds")
            name = path_of(info.get("video_path"), video_key=key, chunk_index=chunk, file_index=part)
            starts[key] = name, Fraction(begin) * Fraction(fps)
        found.add(
            Place(
                number=number,
                length=_count(row, "length", where),
                tasks=_texts(row.get("tasks")),
                data_file=path_of(info.get("data_path"), **at),
                videos=starts,
            )
        )
    return found


def episodes_21(folder: Path, info: Mapping[str, Any], videos: Sequence[str]) -> Episodes:
    """Read the table of episodes of versions 2.1 and 2.0.

    Raises:
        RecorderError: With code ``BAG_DAMAGED``, naming the file.
    """
    size = _count({"chunks_size": 1000, **info}, "chunks_size", "meta/info.json")
    found = Episodes()
    for row in json_lines(folder, "meta/episodes.jsonl"):
        number = _count(row, "episode_index", "meta/episodes.jsonl")
        at = {"episode_chunk": number // max(size, 1), "episode_index": number}
        found.add(
            Place(
                number=number,
                length=_count(row, "length", f"meta/episodes.jsonl, episode {number}"),
                tasks=_texts(row.get("tasks")),
                data_file=path_of(info.get("data_path"), **at),
                videos={key: (path_of(info.get("video_path"), video_key=key, **at), Fraction()) for key in videos},
            )
        )
    return found


def texts_of(folder: Path, names: tuple[str, str], version: str) -> dict[int, str]:
    """Return ``task_index`` to the instruction, or ``subtask_index`` to the subtask.

    Args:
        folder: The dataset.
        names: `TASKS` or `SUBTASKS`.
        version: Version of the format.

    Returns:
        Empty: the dataset has no such table.

    Raises:
        RecorderError: With code ``BAG_DAMAGED``, naming the file.
    """
    text, index, file = names[0], f"{names[0]}_index", table_of_texts(names, version)
    if not has_file(folder, file):
        return {}
    if version == "3.0":
        with reading(folder / file):
            table = open_parquet(folder, file).read()
            texts = next(name for name in (text, *table.column_names) if name in table.column_names and name != index)
            numbers = [int(number) for number in table.column(index).to_pylist()]
            found = list(zip(numbers, table.column(texts).to_pylist(), strict=True))
    else:
        found = [(_count(row, index, file), row.get(text)) for row in json_lines(folder, file)]
    by_number: dict[int, str] = {}
    for number, value in found:
        named = "" if value is None else str(value)
        if by_number.setdefault(number, named) != named:
            texts = f"'{printable(by_number[number], 80)}' and '{printable(named, 80)}'"
            raise damaged(f"{folder / file}: {index} {number} is {texts}, expected one text of a number")
    return by_number


def rows_of(folder: Path, name: str) -> Rows:
    """Read which rows of a data file belong to which episode.

    Raises:
        RecorderError: With code ``BAG_DAMAGED``, naming the file.
    """
    with reading(folder / name):
        file = open_parquet(folder, name)
        have = [key for key in INDICES if key in file.schema_arrow.names]
        table = file.read(columns=have)
        found = {key: _whole_numbers(table.column(key)) for key in have}
        episode, frame, task, subtask = (found.get(key) for key in INDICES)
        count = int(file.metadata.num_rows)
        return Rows(file=name, episode=episode, frame=frame, task=task, subtask=subtask, count=count)


def _whole_numbers(column: pa.ChunkedArray) -> Ints:
    values = np.asarray(column.combine_chunks().to_numpy(zero_copy_only=False))
    if values.dtype.kind == "O":  # lists of one number, as some converters write them
        values = np.array([value[0] if value is not None and np.ndim(value) else value for value in values])
    numbers = values.astype(np.float64)
    return np.where(np.isfinite(numbers), numbers, -1).astype(np.int64)


def _count(row: Mapping[str, Any], key: str, where: str) -> int:
    """Return a number of a row that is 0 or more.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when it is none.
    """
    value = row.get(key)
    if not isinstance(value, int | float) or isinstance(value, bool) or value != value or not 0 <= value < 2**53:
        raise damaged(f"{where}: '{key}' is {printable(value, 60)}, expected a whole number of 0 or more")
    if int(value) != value:
        raise damaged(f"{where}: '{key}' is {value}, expected a whole number")
    return int(value)


def _texts(value: object) -> tuple[str, ...]:
    """Return the instructions of a row: a list of texts or, as some converters write it, one text."""
    if isinstance(value, str):
        return (value,)
    return tuple(str(text) for text in value) if isinstance(value, list) else ()
