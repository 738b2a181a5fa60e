"""Exports bags to any registered format."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from roboxim_core.config import digest, to_json, to_plain
from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.documents import read_json_object
from roboxim_datasets.build import only_build
from roboxim_datasets.card import card_path, write_card
from roboxim_datasets.dataset import CONVENTION_FILE, EXPORT_FILE, DatasetWriter, EncodingWriter
from roboxim_datasets.formats import FORMATS
from roboxim_recorder.bag_writer import disk_errors
from roboxim_recorder.export.content import Content, content_of
from roboxim_recorder.export.convention_file import convention_text
from roboxim_recorder.export.episodes import exported_episode
from roboxim_recorder.export.fit import firsts_of_robots
from roboxim_recorder.export.processes import add_in_processes, available_cores
from roboxim_recorder.export.registry import EXPORTERS, Exporter
from roboxim_recorder.export.selection import Chosen, Selection, choose
from roboxim_recorder.export.sources import Source
from roboxim_recorder.run_bags import run_bags, run_name

Progress = Callable[[int, int], None]
SWITCH_INTERVAL_S = 0.5e-3
"""Time after which a thread that decompresses or encodes gets the interpreter from the one that converts [s]. Python's
default, 5 ms, is longer than most of their steps."""


MANY_EPISODES = 100
"""Number of episodes from which an export starts several processes; each takes seconds to start."""


@dataclass(frozen=True, kw_only=True)
class ExportReport:
    """Result of an export."""

    path: Path
    """The dataset."""
    splits: dict[str, int]
    """Split to number of episodes."""
    steps: int
    """Steps in all."""
    left_out: dict[str, int]
    """Reason to number of bags left out for that reason."""
    dead_dimensions: tuple[str, ...]
    """Components of the action that (nearly) never change; a policy cannot learn them."""
    resumed: int = 0
    """Episodes that an interrupted export had already written."""
    missing: tuple[str, ...] = ()
    """Missing bags that the run's results name, relative to the run."""
    unexpected: tuple[Path, ...] = ()
    """Bags that no result of the run names; they are not exported."""
    cells: dict[str, dict[str, int]] = field(default_factory=dict)
    """Split to cell to number of episodes; a cell is that of the task's mix, else the skill."""
    robots: tuple[str, ...] = ()
    """Robots of the episodes."""
    columns_left_out: tuple[str, ...] = ()
    """Vectors that the dataset does not have because its robots have different joints."""


def export_bags(
    name: str,
    source: Path | str | Sequence[Path | str],
    target: Path | str,
    config: Selection | None = None,
    *,
    if_exists: Literal["refuse", "overwrite", "keep"] = "refuse",
    workers: int = 1,
    progress: Progress = lambda done, total: None,
) -> ExportReport:
    """Export runs' folders, folders of bags or bags.

    An interrupted export continues where it stopped; the dataset gets its final name only when it is complete. Equal
    bags and configuration give equal bytes.

    Args:
        name: Registered format, e.g. ``rlds``.
        source: Path of the bags, or several paths; bags in ``set_apart`` are ignored.
        target: Folder that the dataset is written into.
        config: Configuration, of the format's class; None: the defaults.
        if_exists: Whether an existing dataset is an error, is replaced when the new one is complete, or is left
            unchanged if it has the same bags and configuration (else an error).
        workers: Processes that read and encode episodes, for formats that allow it (RLDS); 0: one for each core if
            there are many episodes. With several, the calling script needs a main guard, as for `multiprocessing`.
        progress: Called with the episodes done and their total.

    Raises:
        ConfigError: On an unknown format, or a configuration of another one, or when another process writes the same
            dataset.
        InvalidRequestError: On an invalid dataset name, camera or image size.
        RecorderError: ``EXPORT_REFUSED`` if there is nothing to export, bags are missing or differ in kind, or the
            dataset exists; ``BAG_DAMAGED`` naming the bag; ``DISK`` if the dataset cannot be written.
    """
    exporter = EXPORTERS[name]()
    config = config if config is not None else exporter.config()
    if not isinstance(config, exporter.config):
        raise ConfigError(f"exporter '{name}' takes a {exporter.config.__name__}, got a {type(config).__name__}")
    paths = [Path(source)] if isinstance(source, str | Path) else [Path(path) for path in source]
    chosen = choose([run_bags(path) for path in paths], config)
    content = content_of(chosen.sources, config)
    identity = _identity(name, chosen, content, config)
    path, total = exporter.path(Path(target), config), len(chosen.sources)
    resumed = total
    if if_exists == "keep" and _exported_identity(path) == identity:
        progress(total, total)
    else:
        description = content.describe(chosen.sources)
        overwrite = if_exists == "overwrite"
        with (
            disk_errors(path),
            only_build(path),
            exporter.open(Path(target), config, description, identity=identity, overwrite=overwrite) as writer,
            _frequent_switches(),
        ):
            resumed = _write_episodes(writer, chosen, content, config, workers, progress)
            facts = {
                "format": name,
                "identity": identity,
                "config": to_plain(config),
                "runs": list(map(run_name, paths)),
                "left_out": chosen.left_out,
                "cells": chosen.cells,
                **({"robots": list(content.robots)} if len(content.robots) > 1 else {}),
            }
            texts = {
                EXPORT_FILE: json.dumps(facts, indent=2, sort_keys=True) + "\n",
                CONVENTION_FILE: convention_text(content.convention),
            }
            writer.complete(texts)
    if name in FORMATS and not card_path(path).is_file():
        with disk_errors(path):
            write_card(FORMATS[name]().open(path))
    return _report(exporter, path, chosen, content, resumed)


@contextmanager
def _frequent_switches() -> Iterator[None]:
    before = sys.getswitchinterval()
    sys.setswitchinterval(min(before, SWITCH_INTERVAL_S))
    try:
        yield
    finally:
        sys.setswitchinterval(before)


def _write_episodes(
    writer: DatasetWriter, chosen: Chosen, content: Content, config: Selection, workers: int, progress: Progress
) -> int:
    """Add every episode that an interrupted export has not written; return the number that it had written."""
    skip = {split: writer.resumed(split) for split in chosen.splits}
    resumed, total = sum(skip.values()), len(chosen.sources)
    left = [(split, source) for split, sources in chosen.splits.items() for source in sources[skip[split] :]]
    if resumed:
        progress(resumed, total)
    if not workers:
        workers = available_cores() if len(left) >= MANY_EPISODES else 1
    if workers > 1 and isinstance(writer, EncodingWriter):
        added = add_in_processes(writer, left, _firsts(chosen), config, workers)
    else:
        added = _add(writer, left, content)
    for done, _ in enumerate(added, start=resumed + 1):
        progress(done, total)
    return resumed


def _firsts(chosen: Chosen) -> Sequence[Source]:
    """Return the export's first bag, and the first one of each other robot."""
    first = chosen.sources[0]
    return first, *(source for source in firsts_of_robots(chosen.sources).values() if source.path != first.path)


def _add(writer: DatasetWriter, left: Sequence[tuple[str, Source]], content: Content) -> Iterator[None]:
    for split, source in left:
        writer.add(split, exported_episode(source, content))
        yield


def _identity(name: str, chosen: Chosen, content: Content, config: Selection) -> str:
    """Return a hash of everything that the exported bytes depend on."""
    found = hashlib.blake2b(f"{name} {to_json(config)} {digest(content.convention)}".encode(), digest_size=16)
    for split, sources in chosen.splits.items():
        for source in sources:
            result = source.result
            found.update(
                f"{split} {result.last_seq} {result.final_state_hash} {digest(source.info)}{_edits(source)}\n".encode()
            )
    return found.hexdigest()


def _edits(source: Source) -> str:
    """Return what an export changes of a bag; empty: nothing."""
    parts = (source.part, source.relabelled, [str(actor) for actor in source.actors])
    return f" {json.dumps(parts)}" if any(parts) else ""


def _exported_identity(path: Path) -> str:
    try:
        return str(read_json_object(path / EXPORT_FILE)["identity"])
    except (ConfigError, KeyError):
        return ""


def _report(exporter: Exporter, path: Path, chosen: Chosen, content: Content, resumed: int) -> ExportReport:
    contents = exporter.contents(path)
    return ExportReport(
        path=path,
        splits=contents.splits,
        steps=sum(-(-source.steps // content.every) for source in chosen.sources),
        left_out=chosen.left_out,
        dead_dimensions=contents.dead_dimensions,
        resumed=resumed,
        missing=chosen.missing,
        unexpected=chosen.unexpected,
        cells=chosen.cells,
        robots=content.robots,
        columns_left_out=content.left_out,
    )
