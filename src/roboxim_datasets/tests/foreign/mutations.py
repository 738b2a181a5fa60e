"""Mutations of datasets that know their structure: JSON, Parquet, HDF5 and TFRecord files are changed as such."""

from __future__ import annotations

import json
import os
import random
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from roboxim_datasets.rlds.tfrecord import decode_example, encode_example, read_records, write_record

VALUES: tuple[Any, ...] = (
    None, "", "x", "../../x", "/etc/hostname",
    "a\u2028b", "{episode_index:999999999d}", 0, -1, 1, 3, 2.5, 10**9, 10**30,
    True, False, [], {}, [1, 2], [[1]], {"a": 1}, float("nan"), "nan", ["x"], "0:1", "5:2", "0:1000000000",
)  # fmt: skip


def mutate(folder: Path, rng: random.Random) -> str:
    """Change a dataset in one place or two; return what was done."""
    done = []
    for _ in range(rng.choice((1, 1, 2))):
        files = sorted(file for file in folder.rglob("*") if file.is_file() and not file.is_symlink())
        if not files:
            break
        file = rng.choice(files)
        kinds = {".json": _json, ".jsonl": _jsonl, ".parquet": _parquet, ".hdf5": _hdf5}
        change = _bytes if rng.random() < 0.15 else kinds.get(file.suffix, _records)
        try:
            done.append(f"{file.relative_to(folder)}: {change(file, rng)}")
        except Exception as error:  # noqa: BLE001 - the file was damaged before
            done.append(f"{file.relative_to(folder)}: {_bytes(file, rng)} ({type(error).__name__})")
    return "; ".join(done)


def _bytes(file: Path, rng: random.Random) -> str:
    data = bytearray(file.read_bytes())
    kind = rng.choice(("truncate", "flip", "empty", "remove", "lfs", "link", "fifo"))
    if kind == "truncate":
        del data[rng.randrange(len(data) + 1) :]
    elif kind == "flip" and data:
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    elif kind == "empty":
        data.clear()
    elif kind == "lfs":
        data = bytearray(b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 12\n")
    file.unlink()
    if kind == "link":
        file.symlink_to("/etc/hostname")
    elif kind == "fifo":
        os.mkfifo(file)
    elif kind != "remove":
        file.write_bytes(data)
    return kind


def _places(value: Any) -> list[tuple[Any, Any]]:
    found = []
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in inner:
        found += [(value, key), *_places(item)]
    return found


def _edit(value: Any, rng: random.Random) -> str:
    places = _places(value)
    if not places:
        return "nothing"
    holder, key = rng.choice(places)
    kind = rng.choice(("set", "set", "drop", "rename", "duplicate"))
    if kind == "drop":
        del holder[key]
    elif kind == "rename" and isinstance(holder, dict):
        holder[rng.choice(("renamed", "observation.new", "a/b", "x" * 300, ""))] = holder.pop(key)
    elif kind == "duplicate" and isinstance(holder, list):
        holder.append(holder[key])
    else:
        holder[key] = rng.choice(VALUES)
    return f"{kind} {key}"


def _json(file: Path, rng: random.Random) -> str:
    value = json.loads(file.read_text())
    said = _edit(value, rng)
    file.write_text(json.dumps(value))
    return said


def _jsonl(file: Path, rng: random.Random) -> str:
    rows = [json.loads(line) for line in file.read_text().split("\n") if line]
    said = _edit(rows, rng)
    file.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return said


def _parquet(file: Path, rng: random.Random) -> str:
    table = pq.read_table(file)
    name = rng.choice(table.column_names)
    at = table.column_names.index(name)
    column = table.column(name)
    values = column.to_pylist()
    row = rng.randrange(max(len(values), 1))
    kind = rng.choice(("drop", "rename", "null", "value", "retype", "empty", "gap", "repeat", "shuffle", "allnull"))
    if kind == "drop":
        table = table.drop_columns([name])
    elif kind == "rename":
        table = table.rename_columns([f"{name}x" if other == name else other for other in table.column_names])
    elif kind == "empty":
        table = table.slice(0, 0)
    elif kind == "gap":
        table = pa.concat_tables([table.slice(0, row), table.slice(row + 1)])
    elif kind == "repeat":
        table = pa.concat_tables([table, table.slice(row, 1)])
    elif kind == "shuffle":
        order = list(range(len(values)))
        rng.shuffle(order)
        table = table.take(order)
    elif kind == "retype":
        table = table.set_column(at, name, pa.array([str(value) for value in values]))
    else:
        new = rng.choice((None, [float("nan")], [1.0], float("nan"), -1, 10**9, "x", {"bytes": b"x", "path": None}))
        new = None if kind in ("null", "allnull") else new
        values = [new] * len(values) if kind == "allnull" else [*values[:row], new, *values[row + 1 :]]
        try:
            table = table.set_column(at, name, pa.array(values, column.type))
        except (pa.ArrowException, TypeError, ValueError):
            table = table.set_column(at, name, pa.array([str(value) for value in values]))
    pq.write_table(table, file)
    return f"{kind} {name}[{row}]"


def _hdf5(file: Path, rng: random.Random) -> str:
    with h5py.File(file, "r+") as opened:
        names: list[str] = []
        opened.visit(names.append)
        name = rng.choice(names)
        item = opened[name]
        kinds = ("drop", "rename", "attribute", "external", "soft", "group")
        more = ("retype", "shorten", "reshape", "nan", "huge", "empty", "scalar", "storage", "text")
        kind = rng.choice(kinds if isinstance(item, h5py.Group) else (*kinds, *more, *more))
        values = item[()] if isinstance(item, h5py.Dataset) else None
        if kind == "attribute":
            new = rng.choice(
                (h5py.Empty("f"), "[[[", "{}", 3, np.ones(3), '{"env_kwargs": []}', b"\xff", float("nan"), "true")
            )
            item.attrs[rng.choice(("env_args", "success", "num_samples", "ep_meta", "roboxim", "x"))] = new
            return f"attribute of {name}"
        del opened[name]
        if kind == "rename":
            opened[f"{name}_x"] = np.zeros(2) if values is None else values
        elif kind == "external":
            opened[name] = h5py.ExternalLink("/etc/hostname", "/data")
        elif kind == "soft":
            opened[name] = h5py.SoftLink(rng.choice(("/data", "/nothing", "/")))
        elif kind == "group":
            opened.create_group(name)
        elif kind == "retype":
            opened[name] = np.asarray(values).astype(rng.choice(("f8", "i8", "S8", "?")))
        elif kind == "shorten":
            opened[name] = values[: rng.randrange(len(values) + 1)]
        elif kind == "reshape":
            opened[name] = np.asarray(values)[..., None]
        elif kind == "nan":
            opened[name] = np.full(np.shape(values), np.nan)
        elif kind == "huge":
            opened.create_dataset(name, (10**9, 7), "f8", chunks=(1000, 7))
        elif kind == "empty":
            opened[name] = h5py.Empty("f4")
        elif kind == "scalar":
            opened[name] = 3.0
        elif kind == "storage":
            opened.create_dataset(name, (2, 2), "u1", external=[("/etc/hostname", 0, 4)])
        elif kind == "text":
            opened[name] = np.array(["a", "b"], dtype=h5py.string_dtype())
    return f"{kind} {name}"


def _records(file: Path, rng: random.Random) -> str:
    payloads = list(read_records(file))
    number = rng.randrange(len(payloads))
    features = dict(decode_example(payloads[number]))
    key = rng.choice(sorted(features))
    kind = rng.choice(("drop", "rename", "shorten", "nan", "retype", "bytes", "empty", "record", "repeat", "length"))
    values = features[key]
    if kind == "record":
        del payloads[number]
    elif kind == "repeat":
        payloads.append(payloads[number])
    else:
        if kind in ("drop", "rename"):
            del features[key]
            features |= {f"{key}_x": values} if kind == "rename" else {}
        elif kind == "shorten":
            features[key] = values[: rng.randrange(len(values) + 1)]
        elif kind == "nan":
            features[key] = np.full(len(values), np.nan, np.float32)
        elif kind == "retype":
            features[key] = np.arange(len(values), dtype=np.int64)
        elif kind == "bytes":
            features[key] = [b"\xffx"] * len(values)
        elif kind == "empty":
            features[key] = []
        else:
            features[key] = np.zeros(3, np.float32)
        payloads[number] = encode_example(features)
    with file.open("wb") as target:
        for payload in payloads:
            write_record(target, payload)
    return f"{kind} {key} of record {number}"
