"""Progress display: bars on a terminal, periodic lines in a log."""

from __future__ import annotations

import html
import importlib
import sys
import threading
import time
from types import TracebackType
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Column

from roboxim_runs.pace import Pace, duration_text

LINE_PERIOD_S = 10.0


class Bars:
    """Bars of a terminal, one below the other. They stay in place while text is printed above them."""

    def __init__(self, console: Console | None = None) -> None:
        """Show nothing yet.

        Args:
            console: The terminal; none: stdout's.
        """
        self._console = console
        self._shown: Progress | None = None

    def add(self, title: str, total: int, done: int, unit: str) -> TaskID:
        """Show another bar; return its id."""
        if self._shown is None:
            self._shown = Progress(
                TextColumn("[bold]{task.description}"), BarColumn(), MofNCompleteColumn(),
                TextColumn("{task.fields[unit]}"), TimeElapsedColumn(), TextColumn("{task.fields[pace]}"),
                TextColumn("{task.fields[note]}", markup=False, table_column=Column(no_wrap=True, overflow="ellipsis")),
                console=self._console or Console(file=sys.stdout),
            )  # fmt: skip
            self._shown.start()
        return self._shown.add_task(title, total=total, completed=done, unit=unit, note="", pace="")

    def update(self, bar: TaskID, done: int, total: int, note: str, pace: str) -> None:
        """Show a bar's progress."""
        if self._shown is not None:
            self._shown.update(bar, completed=done, total=total, note=note, pace=pace)

    def end(self, bar: TaskID) -> None:
        """Keep a bar's last state on the screen, above the active bars."""
        if self._shown is None:
            return
        if len(self._shown.tasks) == 1:
            self._shown.stop()
            self._shown = None
            return
        self._shown.console.print(self._shown.make_tasks_table([task for task in self._shown.tasks if task.id == bar]))
        self._shown.remove_task(bar)

    def say(self, text: str) -> None:
        """Print a line above the bars."""
        if self._shown is not None:
            self._shown.console.print(text, markup=False, highlight=False)


class NotebookBars:
    """Bars in the output of a notebook's cell: one display that is drawn again."""

    def __init__(self) -> None:
        """Show nothing yet."""
        self._rows: dict[int, str] = {}
        self._titles: dict[int, tuple[str, str]] = {}
        self._handle: Any = None

    def add(self, title: str, total: int, done: int, unit: str) -> TaskID:
        """Show another bar; return its id."""
        bar = TaskID(len(self._rows))
        self._rows[bar] = ""
        self._titles[bar] = (title, unit)
        self.update(bar, done, total, "starting", "")
        return bar

    def update(self, bar: TaskID, done: int, total: int, note: str, pace: str) -> None:
        """Show a bar's progress."""
        shown_by = importlib.import_module("IPython.display")
        title, unit = self._titles[bar]
        texts = (title, f"{done} of {total} {unit}".rstrip(), pace, note)
        words = "; ".join(html.escape(text) for text in texts if text)
        self._rows[bar] = f'<div><progress value="{done}" max="{max(total, 1)}"></progress> {words}</div>'
        shown = shown_by.HTML("".join(self._rows.values()))
        if self._handle is None:
            self._handle = shown_by.display(shown, display_id=True)
        else:
            self._handle.update(shown)

    def end(self, bar: TaskID) -> None:
        """Keep a bar's last state."""

    def say(self, text: str) -> None:
        """Print a line below the bars."""
        print(text)  # noqa: T201  (a notebook's cell shows what is printed)


def in_notebook() -> bool:
    """Tell whether this process is the kernel of a notebook."""
    return "ipykernel" in sys.modules and "IPython" in sys.modules


class ProgressLine:
    """A bar with a note beside it. A context manager; safe to call from several threads."""

    def __init__(
        self, title: str, total: int, done: int = 0, *, unit: str = "", bars: Bars | NotebookBars | None = None
    ) -> None:
        """Prepare the bar.

        Args:
            title: Title of the work, a few words.
            total: Total number of units.
            done: Number of units done before this start.
            unit: Unit of the count, e.g. ``ticks``; empty: as the title names.
            bars: Where a terminal shows it; none: a place of its own.
        """
        self._title, self._total, self._done = title, total, done
        self._unit = f" {unit}" if unit else ""
        self._note = ""
        self._shown: tuple[int, str] | None = None
        self._late: threading.Timer | None = None
        self._started = self._last = time.monotonic()
        self._pace = Pace()
        shows = sys.stdout.isatty() or isinstance(bars, NotebookBars)
        self._bars = (bars or Bars()) if shows else None

    def __enter__(self) -> ProgressLine:
        """Show the bar."""
        if self._bars is not None:
            self._bar = self._bars.add(self._title, self._total, self._done, self._unit.strip())
        else:
            at = f", {self._done} are done" if self._done else ""
            many = f": {self._total}{self._unit}" if self._total > 1 else ""  # 1 while it is unknown
            click.echo(f"{self._title}{many}{at}; starting")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the bar and keep its last state on the screen."""
        if self._late is not None:
            self._late.cancel()
        if self._bars is not None:
            self._bars.end(self._bar)
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
        if self._bars is not None:
            self._bars.update(self._bar, done, self._total, note, self._pace_text())
        elif time.monotonic() - self._last > LINE_PERIOD_S:
            self._line()
        elif self._late is None:  # a long step without calls may follow
            self._late = threading.Timer(LINE_PERIOD_S, self._line_if_new)
            self._late.daemon = True
            self._late.start()

    def say(self, text: str) -> None:
        """Print a line that stays on the screen."""
        if self._bars is not None:
            self._bars.say(text)
        else:
            click.echo(text)

    def _line_if_new(self) -> None:
        self._late = None
        if self._shown != (self._done, self._note):
            self._line()

    def _line(self) -> None:
        self._last, self._shown = time.monotonic(), (self._done, self._note)
        parts = (duration_text(self._last - self._started), self._pace_text(), self._note)
        click.echo(f"{self._title}: {self._done} of {self._total}{self._unit} after {'; '.join(filter(None, parts))}")

    def _pace_text(self) -> str:
        """Return the rate and the time left, in words; empty while unknown."""
        return self._pace.text(time.monotonic(), self._total - self._done)
