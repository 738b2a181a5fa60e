"""Prints the events of a run: bars on a terminal, periodic lines in a log."""

from __future__ import annotations

import os
from contextlib import ExitStack
from types import TracebackType

import click

from roboxim_bringup.progress import ProgressLine
from roboxim_bringup.runs.episodes import failures
from roboxim_bringup.runs.evaluation_results import rate_line
from roboxim_bringup.runs.event_log import VARIABLE, EventLog
from roboxim_bringup.runs.events import (
    Event,
    Interrupted,
    Notice,
    PictureWritten,
    PolicyMeasured,
    PolicyResumed,
    StageFinished,
    StageProgress,
    StageStarted,
)


class EventPrinter:
    """Prints each event it is called with. A context manager, so that a bar ends with the run."""

    def __init__(self) -> None:
        """Make the printer. The events also go to the file that ``$ROBOXIM_EVENTS`` names, if it is set."""
        self._stack = ExitStack()
        file = os.environ.get(VARIABLE)
        self._log = EventLog(file) if file else None
        self._bar: ProgressLine | None = None

    def __call__(self, event: Event) -> None:
        """Print an event."""
        if self._log is not None:
            self._log(event)
        match event:
            case StageStarted():
                bar = ProgressLine(event.title, event.total, event.done, unit=event.unit)
                self._bar = self._stack.enter_context(bar)
            case StageProgress():
                if self._bar is not None:
                    self._bar.update(event.done, event.note, total=event.total)
            case StageFinished():
                self._stack.close()
                self._bar = None
            case Notice():
                self._print(event.text)
            case PictureWritten():
                self._print(f"a picture: {event.path}")
            case PolicyResumed():
                rest = "nothing is run" if event.there == event.episodes else "the others follow"
                self._print(
                    f"{event.policy}: {event.there} of {event.episodes} episodes were done already, from "
                    f"{event.since}; {rest}"
                )
            case PolicyMeasured():
                self._print(f"{event.policy}: {rate_line(event.results)}")
                for line in failures(event.results):
                    self._print(f"  {line}")
            case Interrupted():
                click.echo(event.text, err=True)

    def _print(self, text: str) -> None:
        """Print a line, above the bar if one is shown."""
        if self._bar is not None:
            self._bar.say(text)
        else:
            click.echo(text)

    def __enter__(self) -> EventPrinter:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the bar's last state on the screen."""
        self._stack.__exit__(kind, error, trace)
