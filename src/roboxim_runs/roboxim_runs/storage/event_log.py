"""Events of a run as JSON lines, for programs: a file that grows during the run.

A line is a JSON object with ``time`` (UTC, ISO 8601), ``event`` (the class's name in snake_case) and the event's
fields. Each run of episodes has its own file, ``<out>/events.jsonl``; ``roboxim --events FILE COMMAND`` writes the
events of any command. A line is written with one call in append mode, so that several processes may write into one
file.
"""

from __future__ import annotations

import dataclasses
import json
import os
import re
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from roboxim_core.errors import ErrorCode, RoboximError
from roboxim_runs.events import EpisodeFinished, Event, OnEvent, PolicyMeasured
from roboxim_runs.executors.protocol import CancelledError

EVENTS_FILE = "events.jsonl"
VARIABLE = "ROBOXIM_EVENTS"
"""Environment variable with the file that commands write their events into."""
STARTED, ENDED = "run_started", "run_ended"
OF_RESULT = ("episode_id", "index", "attempt", "outcome", "reason", "steps", "bag", "wall_s", "final_state_hash")
"""Fields of a result that its event repeats; the results' file has all fields."""


class EventLog:
    """A file of events; an `OnEvent`."""

    def __init__(self, path: Path | str) -> None:
        """Store the file's path; its folder must exist when the first event arrives."""
        self.path = Path(path)

    def __call__(self, event: Event) -> None:
        """Append an event."""
        self.write(_snake(type(event).__name__), _fields(event))

    def write(self, name: str, fields: Mapping[str, Any]) -> None:
        """Append a line.

        Args:
            name: Name of the event.
            fields: Plain data.

        Raises:
            RoboximError: ``DISK`` when it cannot be written.
        """
        line = json.dumps({"time": datetime.now(UTC).isoformat(timespec="milliseconds"), "event": name, **fields})
        try:
            with open(self.path, "ab", buffering=0) as file:
                file.write(f"{line}\n".encode())
        except OSError as error:
            raise RoboximError(f"cannot write {self.path}: {error.strerror or error}", ErrorCode.DISK) from error


@contextmanager
def logged(path: Path, on_event: OnEvent, **facts: Any) -> Iterator[OnEvent]:
    """Log the events of a block that runs episodes, its start and its end.

    Args:
        path: The file.
        on_event: Receives the events too.
        **facts: Facts about the run, plain data, for the line of its start.

    Yields:
        What receives the block's events.
    """
    log = EventLog(path)
    log.write(STARTED, {"host": socket.gethostname(), "pid": os.getpid(), **facts})

    def both(event: Event) -> None:
        log(event)
        on_event(event)

    try:
        yield both
    except (KeyboardInterrupt, SystemExit, GeneratorExit, CancelledError):
        log.write(ENDED, {"state": "stopped", "message": ""})
        raise
    except BaseException as error:
        log.write(ENDED, {"state": "failed", "message": str(error) or type(error).__name__})
        raise
    log.write(ENDED, {"state": "finished", "message": ""})


def _fields(event: Event) -> dict[str, Any]:
    """Return an event's fields as plain data, results shortened."""
    match event:
        case EpisodeFinished():
            return {"folder": str(event.folder), **{name: getattr(event.result, name) for name in OF_RESULT}}
        case PolicyMeasured():
            outcomes = [result.outcome for result in event.results]
            return {"policy": event.policy, "episodes": len(outcomes), "successes": outcomes.count("success")}
    return {
        field.name: str(value) if isinstance(value := getattr(event, field.name), Path) else value
        for field in dataclasses.fields(event)
    }


def _snake(name: str) -> str:
    return re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()
