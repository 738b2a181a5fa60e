"""Progress display: bars on a terminal, periodic lines in a log."""

from __future__ import annotations

import sys
import time
from types import TracebackType

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from roboxim_bringup.pace import Pace, duration_text

LINE_PERIOD_S = 10.0


class ProgressLine:
    """A bar with a note beside it. A context manager; safe to call from several threads."""

    def __init__(self, title: str, total: int, done: int = 0, *, unit: str = "") -> None:
        """Prepare the bar.

        Args:
            title: Title of the work, a few words.
            total: Total number of units.
            done: Number of units done before this start.
            unit: Unit of the count, e.g. ``ticks``; empty: as the title names.
        """
        self._title, self._total, self._done = title, total, done
        self._unit = f" {unit}" if unit else ""
        self._note = ""
        self._shown: tuple[int, str] | None = None
        self._started = self._last = time.monotonic()
        self._pace = Pace()
        self._bar: Progress | None = None
        if sys.stdout.isatty():
            self._bar = Progress(
                TextColumn("[bold]{task.description}"), BarColumn(), MofNCompleteColumn(),
                TextColumn(unit), TimeElapsedColumn(), TextColumn("{task.fields[pace]}"),
                TextColumn("{task.fields[note]}"),
                console=Console(file=sys.stdout),
            )  # fmt: skip

    def __enter__(self) -> ProgressLine:
        """Show the bar."""
        if self._bar is not None:
            self._bar.start()
            self._task = self._bar.add_task(self._title, total=self._total, completed=self._done, note="", pace="")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the bar and keep its last state on the screen."""
        if self._bar is not None:
            self._bar.stop()
        elif error is None and self._shown != (self._done, self._note):
            self._line()

    def update(self, done: int, note: str = "", *, total: int | None = None) -> None:
        """Show the progress.

        Args:
            done: Number of units done.
            note: A short note.
            total: Total number of units, if it was unknown before.
        """
        self._done, self._note = done, note
        self._total = self._total if total is None else total
        self._pace.add(time.monotonic(), done)
        if self._bar is not None:
            self._bar.update(self._task, completed=done, total=self._total, note=note, pace=self._pace_text())
        elif time.monotonic() - self._last > LINE_PERIOD_S:
            self._line()

    def say(self, text: str) -> None:
        """Print a line that stays on the screen."""
        if self._bar is not None:
            self._bar.console.print(text, markup=False, highlight=False)
        else:
            click.echo(text)

    def _line(self) -> None:
        self._last, self._shown = time.monotonic(), (self._done, self._note)
        parts = (duration_text(self._last - self._started), self._pace_text(), self._note)
        click.echo(f"{self._title}: {self._done} of {self._total}{self._unit} after {'; '.join(filter(None, parts))}")

    def _pace_text(self) -> str:
        """Return the rate and the time left, in words; empty while unknown."""
        return self._pace.text(time.monotonic(), self._total - self._done)
