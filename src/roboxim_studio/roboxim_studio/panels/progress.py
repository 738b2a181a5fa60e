"""A run in progress: its state, each worker's activity, and the newest picture of each episode that is being recorded.

All is read from the run's folder, so the run is not affected.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from roboxim_core.errors import RoboximError
from roboxim_core.plain_data.results_log import RUN_FILE
from roboxim_runs.pace import duration_text, rate_text
from roboxim_runs.storage.folder import EPISODE_MARK, folders_with
from roboxim_runs.storage.state import RunState, run_state
from roboxim_studio.episode.unfinished import Growing, Picture, Unfinished
from roboxim_studio.panels import markup

LOG_BYTES = 1 << 16
"""Number of bytes at the end of a worker's log that are read."""
MAX_PICTURES = 8
_MARK = re.compile(re.escape(EPISODE_MARK).replace(re.escape("{}"), r"(\d+)"))


class Progress:
    """A part of the run's panel."""

    def __init__(self, gui: Any, run: Path) -> None:
        """Build it in the current container.

        Args:
            gui: The page's GUI.
            run: Folder of a run, or of an evaluation with a run for each policy.
        """
        self._gui, self._run, self._growing = gui, run, Growing()
        self._images: dict[str, tuple[Any, Picture]] = {}
        self.states: tuple[RunState, ...] = ()
        """State of each run in the folder."""
        self.episodes: tuple[Unfinished, ...] = ()
        """Episodes that are being recorded."""
        self._facts = gui.add_html("")
        self.folder = gui.add_folder("Being recorded", visible=False)
        """Holds the pictures."""

    def remove(self) -> None:
        """Take it out of the panel."""
        self._facts.remove()
        self.folder.remove()

    def follow(self) -> None:
        """Show the present state; a run that cannot be read is named."""
        runs = list(folders_with(RUN_FILE, self._run, 1))
        try:
            self.states = tuple(run_state(run) for run in runs)
        except RoboximError as error:
            self._facts.content = markup.paragraph(str(error), "run-progress", alert=True)
            return
        going = [run for run, state in zip(runs, self.states, strict=True) if state.state == "running"]
        self.episodes = self._growing.look(going)
        rows = [row for run, state in zip(runs, self.states, strict=True) for row in self._rows(run, state)]
        rows += [("recording", f"{one.name}, {one.ticks} ticks") for one in self.episodes]
        self._facts.content = markup.facts(rows, "run-progress") if rows else ""
        self._show(self.episodes[:MAX_PICTURES])

    def _rows(self, run: Path, state: RunState) -> list[tuple[str, object]]:
        name = "run" if run == self._run else run.name
        parts = [state.state, f"{state.done} of {state.total or '?'} episodes"]
        if state.per_second:
            parts.append(rate_text(state.per_second))
        if state.left_s is not None:
            parts.append(f"{duration_text(state.left_s)} left")
        rows: list[tuple[str, object]] = [(name, ", ".join(parts))]
        if state.message:
            rows.append(("why", state.message))
        if state.state == "running":
            rows += [(log.stem.replace("-", " "), doing(log)) for log in sorted((run / "logs").glob("worker-*.log"))]
        return rows

    def _show(self, episodes: Sequence[Unfinished]) -> None:
        shown = {one.name: picture for one in episodes if (picture := one.picture()) is not None}
        for name in [name for name in self._images if name not in shown]:
            self._images.pop(name)[0].remove()
        for name, picture in shown.items():
            if name not in self._images:
                with self.folder:
                    self._images[name] = self._gui.add_image(picture, label=name, jpeg_quality=80), picture
            elif picture is not self._images[name][1]:
                handle = self._images[name][0]
                handle.image = picture
                self._images[name] = handle, picture
        self.folder.visible = bool(shown)


def doing(log: Path) -> str:
    """Return what a worker does, by its log."""
    try:
        with open(log, "rb") as file:
            file.seek(max(0, log.stat().st_size - LOG_BYTES))
            text = file.read().decode(errors="replace")
    except OSError:
        return "its log cannot be read"
    marks = _MARK.findall(text)
    return f"episode {marks[-1]}" if marks else "starting"
