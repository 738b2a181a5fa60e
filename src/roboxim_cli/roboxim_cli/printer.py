"""Prints the events of a run: bars on a terminal, periodic lines in a log."""

from __future__ import annotations

import os
from types import TracebackType

import click

from roboxim_cli.progress import Bars, NotebookBars, ProgressLine, in_notebook
from roboxim_runs.episodes.run import failures
from roboxim_runs.evaluation.results import rate_line
from roboxim_runs.events import (
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
from roboxim_runs.storage.event_log import VARIABLE, EventLog


class EventPrinter:
    """Prints each event it is called with; stages side by side have a bar each. A context manager: bars end with it."""

    def __init__(self) -> None:
        """Make the printer. The events also go to the file that ``$ROBOXIM_EVENTS`` names, if it is set."""
        file = os.environ.get(VARIABLE)
        self._log = EventLog(file) if file else None
        self._bars = NotebookBars() if in_notebook() else Bars()
        self._lines: dict[str, ProgressLine] = {}

    def __call__(self, event: Event) -> None:
        """Print an event."""
        if self._log is not None:
            self._log(event)
        match event:
            case StageStarted():
                self._end(event.name)
                bar = ProgressLine(event.title, event.total, event.done, unit=event.unit, bars=self._bars)
                self._lines[event.name] = bar.__enter__()
            case StageProgress():
                if event.name in self._lines:
                    self._lines[event.name].update(event.done, event.note, total=event.total)
            case StageFinished():
                self._end(event.name)
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

    def _end(self, name: str) -> None:
        """End the line of a stage, if it has one."""
        if line := self._lines.pop(name, None):
            line.__exit__(None, None, None)

    def _print(self, text: str) -> None:
        """Print a line, above the bars if some are shown."""
        if self._lines:
            next(iter(self._lines.values())).say(text)
        else:
            click.echo(text)

    def __enter__(self) -> EventPrinter:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the last state of the bars on the screen."""
        for line in self._lines.values():
            line.__exit__(kind, error, trace)
        self._lines.clear()
