"""The account of a LeRobot dataset: everything that its files hold, and what became of it."""

from __future__ import annotations

from typing import Any

import numpy as np

from roboxim_core.errors import printable
from roboxim_datasets.account import Account
from roboxim_datasets.files import files_below, has_file, reading
from roboxim_datasets.lerobot import tables
from roboxim_datasets.lerobot.columns import floats, peek
from roboxim_datasets.lerobot.layout import (
    DEPTH_UNIT_M,
    INDEX_COLUMNS,
    STATS_FILE,
    SUBTASK_INDEX,
)
from roboxim_datasets.lerobot.meta import TIMESTAMP, LeRobotMeta
from roboxim_datasets.lerobot.parquet_file import open_parquet
from roboxim_datasets.lerobot.tables import Rows
from roboxim_datasets.pictures import head_of

_SAME_TIME_S = 1e-3
_ROUNDED = 1e-6  # of a time, as float32


def take_stock(account: Account, meta: LeRobotMeta, *, own: bool, unusable: str) -> None:
    """Note the parts of a dataset's files and which of them are read.

    Args:
        account: What is noted.
        meta: What the dataset says of itself.
        own: Whether it is RoboXim's own.
        unusable: Why its statistics are not read; empty: they are read, or there are none.
    """
    _take_stock_of_episodes(account, meta)
    content = meta.content
    read = {*meta.number_columns, *content.cameras, *content.depth, *content.segmentation, "next.success"}
    read |= {SUBTASK_INDEX} if meta.subtasks else set()
    taken: set[int] = set()
    steps = sum(place.length for place in meta.table.places.values())
    lengths: dict[str, int] = {}
    for place in meta.table.places.values():
        lengths[place.data_file] = lengths.get(place.data_file, 0) + place.length
    for file in files_below(meta.path, "data/**/*.parquet"):
        name = str(file.relative_to(meta.path.resolve())) if file.is_relative_to(meta.path.resolve()) else file.name
        rows, columns = tables.rows_of(meta.path, name), peek(meta.path, name)
        account.holds("row", name, rows.count)
        account.reads("row", name, lengths.get(name, 0))
        account.leaves_out("row", name, "no episode of meta/episodes has them")
        if rows.task is not None:
            taken |= set(np.unique(rows.task).tolist())
        off, largest = (0, 0.0) if own or TIMESTAMP not in columns else _off_the_clock(meta, name, rows)
        why = f"not frame_index / {float(meta.fps):g} Hz, by up to {largest:.3g} s; a new dataset has even times"
        for key, first in columns.items():
            account.holds("key", key, rows.count)
            if key == TIMESTAMP:
                account.leaves_out("key", key, why, off)
            if key in INDEX_COLUMNS and key != TIMESTAMP or key == content.names.done:
                account.implies("key", key, "the order of the rows", rows.count)
            elif key in read and key not in meta.unread:
                account.reads("key", key, lengths.get(name, 0), "" if own else _changed(meta, key, first))
                account.leaves_out("key", key, "in rows of no episode", rows.count - lengths.get(name, 0))
            else:
                account.leaves_out("key", key, meta.unread.get(key, "meta/info.json does not name it"), rows.count)
    for key, feature in meta.features.items():
        if feature["dtype"] == "video":
            account.holds("key", key, steps)
            account.leaves_out("key", key, meta.unread.get(key, ""), steps * (key in meta.unread))
            account.reads("key", key, changed="" if own else _changed(meta, key))
        elif not account.knows("key", key):
            account.holds("key", key, 0)
    for number, text in meta.tasks.items():
        account.holds("task", f"{number} '{text}'")
        account.leaves_out("task", f"{number} '{text}'", "no step has it", int(number not in taken))
        account.reads("task", f"{number} '{text}'")
    account.holds("rate", f"{float(meta.fps):g} Hz")
    account.reads("rate", f"{float(meta.fps):g} Hz")
    if has_file(meta.path, STATS_FILE):
        account.holds("statistics", STATS_FILE)
        if unusable:
            account.leaves_out("statistics", STATS_FILE, unusable)
        account.reads("statistics", STATS_FILE)


def _take_stock_of_episodes(account: Account, meta: LeRobotMeta) -> None:
    for split, places in meta.splits.items():
        for place in places:
            account.holds("episode", str(place.number))
            lag = "no split names it, read as train" if place.number in meta.in_no_split else ""
            account.reads("episode", str(place.number), changed=lag)
        account.holds("split", split, 0)
    for name, why in meta.table.left_out.items():
        account.holds("episode", name)
        account.leaves_out("episode", name, why)
    splits = meta.info.get("splits")
    for split in splits if isinstance(splits, dict) else ():
        account.holds("split", str(split))
        if split in meta.lost_splits:
            account.leaves_out("split", str(split), meta.lost_splits[split])
        account.reads("split", str(split))
    for name, number in (
        ("total_episodes", len(meta.table.places) + len(meta.table.left_out)),
        ("total_frames", sum(place.length for place in meta.table.places.values())),
    ):
        if name in meta.info:
            account.holds("metadata", name)
            if meta.info[name] != number:
                why = f"it says {printable(meta.info[name], 60)}, the table of episodes has {number}"
                account.leaves_out("metadata", name, why)
            account.implies("metadata", name, "the table of episodes")


def _off_the_clock(meta: LeRobotMeta, name: str, rows: Rows) -> tuple[int, float]:
    """Return how many times of a data file are not those of their frames, and by how much at most [s]."""
    if rows.frame is None:
        return 0, 0.0
    with reading(meta.path / name):
        times = floats(open_parquet(meta.path, name).read(columns=[TIMESTAMP]), TIMESTAMP, 1, name)[:, 0].astype(float)
    apart = np.abs(times - rows.frame / float(meta.fps))
    off = ~(apart <= _SAME_TIME_S + _ROUNDED * np.abs(times))
    return int(off.sum()), float(apart[off].max(initial=0.0))


def _changed(meta: LeRobotMeta, key: str, first: Any = None) -> str:
    """Return how the read values of a column differ from the stored ones.

    Args:
        meta: What the dataset says of itself.
        key: The column.
        first: Its first value, if it holds images.
    """
    dtype, shape = str(meta.features[key]["dtype"]), meta.shape(key)
    if dtype == "image" and isinstance(first, dict) and first.get("bytes") and head_of(first["bytes"]).alpha:
        return "pictures with an alpha channel, read without it"
    if len(shape) > 1 and dtype not in ("image", "video"):
        return f"{dtype} of shape {shape}, read as a vector of float32"
    if key in meta.content.depth:
        if levels := meta.levels(key):
            return str(levels)
        return f"depth in units of {meta.unit_m(key) or DEPTH_UNIT_M:g} m, read as metres"
    return "" if dtype in ("float32", "image", "video") or key == "next.success" else f"{dtype}, read as float32"
