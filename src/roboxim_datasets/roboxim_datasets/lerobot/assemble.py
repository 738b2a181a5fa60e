"""Puts a dataset together from the pieces of its episodes: files of many episodes (3.0) or of one each (2.1)."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from roboxim_core.errors import ErrorCode, RecorderError
from roboxim_datasets.build import Facts, ResumableBuild, link, write_files
from roboxim_datasets.lerobot.layout import (
    CHUNK,
    DATA_PATH,
    EPISODES_PATH,
    INFO_FILE,
    ROBOXIM_EPISODES_FILE,
    STATS_FILE,
    SUBTASK_INDEX,
    SUBTASKS,
    TASKS,
    VIDEO_PATH,
    LeRobotLayout,
    table_of_texts,
)
from roboxim_datasets.lerobot.pieces import Array, Piece, complete_table, index_arrays
from roboxim_datasets.lerobot.stats import DatasetStatistics, Stats, episode_stats
from roboxim_datasets.video.client import VideoFile, VideoWriters

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

_EPISODES_TOGETHER = 64  # rows of the episodes' table that are written at once


@dataclass(frozen=True, kw_only=True, eq=False)
class _Numbered:
    """An episode with its place in the dataset."""

    index: int
    first: int
    facts: Facts
    piece: Piece
    indices: Mapping[str, Array]

    @property
    def length(self) -> int:
        return len(self.piece)


def assemble(build: ResumableBuild, layout: LeRobotLayout, videos: VideoWriters) -> None:
    """Write the dataset into the build's staging folder, all but `MODALITY_FILE` and `ROBOXIM_FILE`.

    Args:
        build: The build with all its pieces.
        layout: Layout of the dataset.
        videos: Workers that join videos.

    Raises:
        RecorderError: ``EXPORT_REFUSED`` when there is no episode; ``BAG_DAMAGED`` when a piece has been changed.
        OSError: When the disk is full.
    """
    splits = build.split_entries()
    entries = [entry for split in splits.values() for entry in split]
    tasks = list(dict.fromkeys(text for entry in entries for text in _instructions(entry)))
    subtasks = list(dict.fromkeys(text for entry in entries for text in entry.get("subtasks", ())))
    build.staged.mkdir()
    statistics = DatasetStatistics(layout)
    target = _Version30(build, layout) if layout.version == "3.0" else _Version21(build, layout)
    joined = target.videos(entries, videos)
    lines = []
    with target:
        for episode in _numbered(build, layout, entries, tasks, subtasks):
            target.add(episode, episode_stats(layout, episode.piece, episode.indices))
            statistics.add(episode.piece, episode.indices)
            lines.append(json.dumps(episode.piece.facts["episode"]) + "\n")
    target.texts(TASKS, tasks)
    if layout.subtasks:
        target.texts(SUBTASKS, subtasks)
    frames = sum(entry["length"] for entry in entries)
    info = layout.info(tasks=len(tasks), frames=frames, splits={name: len(split) for name, split in splits.items()})
    texts = {
        INFO_FILE: json.dumps(info, indent=4, ensure_ascii=False),
        STATS_FILE: json.dumps(statistics.stats(), indent=4),
        ROBOXIM_EPISODES_FILE: "".join(lines),
    }
    write_files(build.staged, texts)
    for future, expected, path in joined:
        if future.result().frames != expected:
            raise RecorderError(
                f"{path} has {future.result().frames} frames, expected {expected}; export again", ErrorCode.BAG_DAMAGED
            )


def _numbered(
    build: ResumableBuild, layout: LeRobotLayout, entries: list[Facts], tasks: list[str], subtasks: list[str]
) -> Iterator[_Numbered]:
    first = 0
    numbers, parts = ({text: number for number, text in enumerate(texts)} for texts in (tasks, subtasks))
    for index, entry in enumerate(entries):
        piece = Piece.read(build.piece(entry["split"], entry["number"], "rows.arrow"))
        instructions = entry.get("spoken") or [None] * len(piece)
        task = np.array([numbers[entry["instruction"] if text is None else text] for text in instructions], np.int64)
        indices = index_arrays(len(piece), fps=layout.fps, episode=index, first=first, task=task)
        if layout.subtasks:
            indices[SUBTASK_INDEX] = np.array([parts[text] for text in entry["subtasks"]], np.int64)
        yield _Numbered(index=index, first=first, facts=entry, piece=piece, indices=indices)
        first += len(piece)


def _instructions(facts: Facts) -> list[str]:
    """Return the instructions of an episode, each once."""
    found: list[str] = facts.get("instructions") or [facts["instruction"]]
    return found


def _video_piece(build: ResumableBuild, entry: Facts, key: str) -> Path:
    return build.piece(entry["split"], entry["number"], f"{key}.mp4")


_Joined = list[tuple["Future[VideoFile]", int, Path]]


class _Version30:
    """Files of many episodes each."""

    def __init__(self, build: ResumableBuild, layout: LeRobotLayout) -> None:
        self._build, self._layout, self._root = build, layout, build.staged
        self._data = _Files(self._root, DATA_PATH["3.0"], layout.data_file_bytes)
        self._episodes = _Files(self._root, EPISODES_PATH, layout.data_file_bytes)
        self._rows: list[dict[str, Any]] = []
        self._places: dict[str, list[dict[str, Any]]] = {}

    def videos(self, entries: list[Facts], videos: VideoWriters) -> _Joined:
        """Start to join the episodes' videos; note where each episode begins."""
        joined: _Joined = []
        for key in self._layout.cameras if self._layout.codec else ():
            groups = _grouped([entry["videos"][key] for entry in entries], self._layout.video_file_bytes)
            places = self._places[key] = []
            for number, group in enumerate(groups):
                chunk, file = divmod(number, CHUNK)
                name = VIDEO_PATH["3.0"].format(video_key=key, chunk_index=chunk, file_index=file)
                path = self._root / name
                path.parent.mkdir(parents=True, exist_ok=True)
                frames = 0
                for entry in entries[group.start : group.stop]:
                    begin, frames = frames, frames + entry["length"]
                    places.append(
                        {
                            f"videos/{key}/chunk_index": chunk,
                            f"videos/{key}/file_index": file,
                            f"videos/{key}/from_timestamp": begin / self._layout.fps,
                            f"videos/{key}/to_timestamp": frames / self._layout.fps,
                        }
                    )
                pieces = [_video_piece(self._build, entry, key) for entry in entries[group.start : group.stop]]
                joined.append((videos.join(pieces, path, Fraction(self._layout.fps)), frames, path))
        return joined

    def add(self, episode: _Numbered, stats: Stats) -> None:
        """Append an episode."""
        table = complete_table(self._layout, episode.piece, episode.indices)
        chunk, file = self._data.write(table)
        self._rows.append(
            {
                "episode_index": episode.index,
                "tasks": _instructions(episode.facts),
                "length": episode.length,
                "data/chunk_index": chunk,
                "data/file_index": file,
                "dataset_from_index": episode.first,
                "dataset_to_index": episode.first + episode.length,
                **{name: value for places in self._places.values() for name, value in places[episode.index].items()},
                **{f"stats/{key}/{name}": value for key, of in stats.items() for name, value in of.items()},
            }
        )
        if len(self._rows) == _EPISODES_TOGETHER:
            self._write_rows()

    def _write_rows(self) -> None:
        import pyarrow as pa

        if self._rows:
            chunk, file = self._episodes.place
            place = {"meta/episodes/chunk_index": chunk, "meta/episodes/file_index": file}
            table = pa.Table.from_pylist([{**row, **place} for row in self._rows])
            if self._episodes.write(table) != (chunk, file):
                raise AssertionError("the table of episodes was written to a file other than the one that it names")
            self._rows = []

    def texts(self, names: tuple[str, str], texts: list[str]) -> None:
        """Write instructions or subtasks; row k is number k, with the text as pandas' index."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        name, index = names[0], f"{names[0]}_index"
        table = pa.table({index: pa.array(range(len(texts)), pa.int64()), name: texts})
        column = {"field_name": name, "name": name, "pandas_type": "unicode", "numpy_type": "object"}
        number = {"field_name": index, "name": index, "pandas_type": "int64", "numpy_type": "int64"}
        about = {
            "index_columns": [name],
            "column_indexes": [],
            "columns": [{**number, "metadata": None}, {**column, "metadata": None}],
            "pandas_version": "2.3.0",
        }
        file = self._root / table_of_texts(names, "3.0")
        pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(about)}), file)

    def __enter__(self) -> _Version30:
        return self

    def __exit__(self, *_: object) -> None:
        self._write_rows()
        self._data.close()
        self._episodes.close()


class _Version21:
    """A file for each episode."""

    def __init__(self, build: ResumableBuild, layout: LeRobotLayout) -> None:
        self._build, self._layout, self._root = build, layout, build.staged
        (self._root / "meta").mkdir()
        self._episodes = (self._root / "meta" / "episodes.jsonl").open("w")
        self._stats = (self._root / "meta" / "episodes_stats.jsonl").open("w")

    def videos(self, entries: list[Facts], videos: VideoWriters) -> _Joined:
        """Put the episodes' videos into place."""
        for key in self._layout.cameras if self._layout.codec else ():
            for index, entry in enumerate(entries):
                name = VIDEO_PATH["2.1"].format(video_key=key, episode_chunk=index // CHUNK, episode_index=index)
                path = self._root / name
                path.parent.mkdir(parents=True, exist_ok=True)
                link(_video_piece(self._build, entry, key), path)
        return []

    def add(self, episode: _Numbered, stats: Stats) -> None:
        """Append an episode."""
        import pyarrow.parquet as pq

        index = episode.index
        path = self._root / DATA_PATH["2.1"].format(episode_chunk=index // CHUNK, episode_index=index)
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(complete_table(self._layout, episode.piece, episode.indices), path)
        entry = {"episode_index": index, "tasks": _instructions(episode.facts), "length": episode.length}
        self._episodes.write(json.dumps(entry, ensure_ascii=False) + "\n")
        self._stats.write(json.dumps({"episode_index": index, "stats": stats}) + "\n")

    def texts(self, names: tuple[str, str], texts: list[str]) -> None:
        """Write instructions or subtasks."""
        rows = [{f"{names[0]}_index": number, names[0]: text} for number, text in enumerate(texts)]
        lines = "".join(json.dumps(row, ensure_ascii=False) + "\n" for row in rows)
        (self._root / table_of_texts(names, "2.1")).write_text(lines)

    def __enter__(self) -> _Version21:
        return self

    def __exit__(self, *_: object) -> None:
        self._episodes.close()
        self._stats.close()


class _Files:
    """Parquet files that are closed when they reach a size."""

    def __init__(self, root: Path, pattern: str, max_bytes: int) -> None:
        self._root, self._pattern, self._max_bytes = root, pattern, max_bytes
        self._writer: pq.ParquetWriter | None = None
        self._number, self._bytes = 0, 0

    @property
    def place(self) -> tuple[int, int]:
        """Chunk and file of the next rows."""
        chunk, file = divmod(self._number, CHUNK)
        return chunk, file

    def write(self, table: pa.Table) -> tuple[int, int]:
        """Append rows as one row group; return the chunk and the file that holds them.

        A file is closed after the rows with which it reaches the size, so `place` is known before.
        """
        import pyarrow.parquet as pq

        chunk, file = self.place
        if self._writer is None:
            path = self._root / self._pattern.format(chunk_index=chunk, file_index=file)
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = pq.ParquetWriter(path, table.schema, compression="snappy")
        self._writer.write_table(table, row_group_size=max(1, table.num_rows))
        self._bytes += table.nbytes
        if self._bytes >= self._max_bytes:
            self.close()
            self._number, self._bytes = self._number + 1, 0
        return chunk, file

    def close(self) -> None:
        """Finish the open file."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None


def _grouped(sizes: list[int], max_size: int) -> list[range]:
    """Return ranges of consecutive items whose sizes sum up to at most ``max_size``, each of at least one item."""
    groups, begin, total = [], 0, 0
    for index, size in enumerate(sizes):
        if index > begin and total + size > max_size:
            groups.append(range(begin, index))
            begin, total = index, 0
        total += size
    return [*groups, range(begin, len(sizes))]
