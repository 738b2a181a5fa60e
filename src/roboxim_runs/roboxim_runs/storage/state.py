"""States of the runs in folders: running, finished, stopped or failed, with progress and speed.

The states are read from the folders alone. So they are available for any executor, for a run on another machine that
shares the file system, and for a run whose machine is gone.
"""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from roboxim_core.episode.records import NOT_PLAYED
from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.results_log import RESULTS_FILE, RUN_FILE
from roboxim_runs.pace import Pace
from roboxim_runs.storage.event_log import ENDED, EVENTS_FILE, STARTED
from roboxim_runs.storage.folder import RunFolder, folders_with, wanted_indices
from roboxim_runs.storage.occupied import command_of

DEEPEST = 4
"""Levels below a folder at which runs are looked for."""
QUIET_S = 900.0
"""Time without an event after which a run on another machine counts as dead [s]."""
TAIL_BYTES = 1 << 18
"""Number of bytes at the end of a run's events that are read."""
UNPLAYED = tuple(f'"reason":"{reason}"'.encode() for reason in sorted(NOT_PLAYED))
"""Text in the lines of episodes that do not count as results."""
EPISODE = re.compile(rb'"episode_id":"[^"]*-')
"""Text in a line that names its episode, without the attempt; a repaired episode has several lines."""


@dataclass(frozen=True, kw_only=True)
class RunState:
    """State of a run."""

    folder: str
    """Its folder."""
    kind: str
    """Command that made it."""
    state: str
    """``running``, ``finished``, ``stopped``, ``failed``, or ``lost``: it ended without an end event."""
    message: str
    """Why it failed."""
    done: int
    """Episodes with a result."""
    total: int
    """Requested number of episodes; of a shard, its share. 0: unknown."""
    shard: str
    """``I/N``; empty: the whole run."""
    executor: str
    """Executor of its episodes: ``local``, ``inline``, ``ray``; empty: unknown."""
    host: str
    """Machine on which the command was last started."""
    per_second: float | None
    """Recent rate [episodes/s]; none: unknown, or the run is not running."""
    left_s: float | None
    """Estimated time left [s]."""
    quiet_s: float | None
    """Time since the last event [s]."""


def find_runs(folders: Sequence[Path]) -> list[RunState]:
    """Return the states of the runs in folders and below.

    Raises:
        ConfigError: When a folder does not exist or has no run.
    """
    found = []
    for folder in folders:
        runs = [run_state(path) for path in folders_with(RUN_FILE, folder, DEEPEST)]
        if not runs:
            raise ConfigError(f"{folder} has no run" if folder.is_dir() else f"no such folder: {folder}")
        found += runs
    return found


def run_state(folder: Path, now_s: float | None = None) -> RunState:
    """Return the state of one run.

    Args:
        folder: The run's folder.
        now_s: Present time, seconds since 1970; none: the clock's.

    Raises:
        ConfigError: When its configuration is not readable.
    """
    now_s = time.time() if now_s is None else now_s
    run = RunFolder(folder)
    config = run.config()
    done = _results_in(folder / RESULTS_FILE)
    total = len(wanted_indices(config))
    events = list(_last_events(folder / EVENTS_FILE))
    started: dict[str, Any] = next((event for event in reversed(events) if event["event"] == STARTED), {})
    last = events[-1] if events else {}
    quiet_s = now_s - _time(last) if last else None
    state, message = _state(run, last, quiet_s, finished=0 < total <= done)
    rate = None
    if state == "running":
        pace = Pace()
        for event in events:
            if event["event"] == STARTED:
                pace = Pace()
            elif event["event"] == "stage_progress":
                pace.add(_time(event), int(event["done"]))
        rate = pace.per_second(now_s)
    return RunState(
        folder=str(folder), kind=command_of(config), state=state, message=message, done=done, total=total,
        shard=str(config.get("shard", "")), executor=str(started.get("executor", "")),
        host=str(started.get("host", "")), per_second=rate,
        left_s=max(0, total - done) / rate if rate and total else None, quiet_s=quiet_s,
    )  # fmt: skip


def _state(run: RunFolder, last: dict[str, Any], quiet_s: float | None, *, finished: bool) -> tuple[str, str]:
    if run.in_use:
        return "running", ""
    if last.get("event") == ENDED:
        return str(last["state"]), str(last.get("message", ""))
    if finished:
        return "finished", ""
    alive_elsewhere = quiet_s is not None and quiet_s < QUIET_S and not _is_here(run.path)
    return ("running" if alive_elsewhere else "lost" if quiet_s is not None else "stopped"), ""


def _is_here(folder: Path) -> bool:
    """Return whether the folder is on a disk of this machine, where the lock alone shows whether the run is active."""
    kinds = {}
    try:
        for line in Path("/proc/mounts").read_text().splitlines():
            _, place, kind, *_ = line.split()
            kinds[place] = kind
    except OSError:
        return True
    parents = [str(path) for path in (folder, *folder.parents)]
    kind = next((kinds[path] for path in parents if path in kinds), "")
    return not kind.startswith(("nfs", "cifs", "smb", "lustre", "beegfs", "ceph", "gpfs", "glusterfs", "fuse", "9p"))


def _results_in(path: Path) -> int:
    """Return the number of episodes whose last line is a result; lines are not parsed, which takes long for many."""
    played: dict[bytes, bool] = {}
    try:
        with open(path, "rb") as file:
            for number, line in enumerate(file):
                if line.endswith(b"\n"):
                    found = EPISODE.search(line)
                    played[found[0] if found else b"%d" % number] = not any(reason in line for reason in UNPLAYED)
    except OSError:
        return 0
    return sum(played.values())


def _last_events(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the events at the end of a file; a torn line is left out."""
    try:
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            file.seek(max(0, size - TAIL_BYTES))
            lines = file.read().split(b"\n")
    except OSError:
        return
    for line in lines[1 if size > TAIL_BYTES else 0 :]:
        try:
            event = json.loads(line)
        except ValueError:
            continue
        if isinstance(event, dict) and "event" in event and "time" in event:
            yield event


def _time(event: dict[str, Any]) -> float:
    """Return when an event happened, seconds since 1970."""
    return datetime.fromisoformat(event["time"]).timestamp()
