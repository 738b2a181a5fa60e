"""Selection of a run's or a dataset's episodes: marks (leave out, flag), edits (trim, relabel), and their file."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from roboxim_core.errors import RoboximError
from roboxim_datasets.audit.values import Finding
from roboxim_datasets.where import Choice, Condition, Edit, Fact, require_known
from roboxim_studio.episode.choice import read_selection, save_selection, selection_file, selection_text
from roboxim_studio.own_files import OwnFiles
from roboxim_studio.panels import markup

MARKS = {"": "", "flag": "! ", "out": "x "}
"""Mark of an episode to the text before its name."""
TRIMS = ("Starts here", "Ends here", "Whole again")
"""How the open episode is trimmed at the tick that it shows."""
MAX_FINDINGS = 12
"""Findings of an audit that the panel lists."""
CONDITIONS_HINT = "As for --where, separated by ;   e.g. object=mug; target.color!=red; steps<60; drawn.light=dim"


@dataclass(frozen=True, kw_only=True)
class OpenEpisode:
    """The episode that the studio shows, for trimming it."""

    episode: str
    """Its name in a selection."""
    starts: int
    """First step that is left if it starts here."""
    ends: int
    """Last step that is left if it ends here."""
    last: int
    """Its last step."""


class Selection:
    """Marks and edits of one source, which is never touched."""

    def __init__(
        self, gui: Any, folder: Path, source: Path, *, opened: Callable[[], OpenEpisode | None],
        chosen: Callable[[], str], changed: Callable[[], None], command: str,
    ) -> None:  # fmt: skip
        """Build the buttons and the form in the current container.

        Args:
            gui: The page's GUI.
            folder: Folder to save into.
            source: The run or the dataset.
            opened: Returns the episode that is shown; None: none is.
            chosen: Returns the name of the episode that buttons mark.
            changed: Called after every change.
            command: What to type with the saved file, with ``{source}`` and ``{file}``.
        """
        self._folder, self._source, self._command = folder, source, command
        self._opened, self._changed = opened, changed
        self._lock, self._own = threading.RLock(), OwnFiles()
        self.ids: Mapping[str, str] = {}
        """Name of every episode in the panel to its name in a selection."""
        self.marks: dict[str, str] = {}
        """Name of an episode to ``flag`` or ``out``."""
        self.edits: dict[str, Edit] = {}
        """Episode to what the selection changes of it."""
        marks = gui.add_button_group("Mark", ("Leave out", "Flag", "Unmark"))
        self._message = gui.add_html("")
        self.folder = gui.add_folder("Selection, distributions", expand_by_default=False)
        """Holds the form; the panel adds its distributions."""
        with self.folder:
            trims = gui.add_button_group("Open episode", TRIMS)
            self._words = gui.add_text("New instruction", initial_value="")
            relabel = gui.add_button("Give it this instruction")
            self._name = gui.add_text("Save as", initial_value="my_selection", hint=f"Into {folder.name}")
            save = gui.add_button("Save the selection")
            load = gui.add_button("Load a saved selection")
            audit = gui.add_button("Audit all episodes")
            self._saved = gui.add_html("")
        marks.on_click(lambda event: self.mark(chosen(), str(event.target.value)))
        trims.on_click(lambda event: self.trim(str(event.target.value)))
        relabel.on_click(lambda _: self.relabel(str(self._words.value)))
        save.on_click(lambda _: self.save(str(self._name.value)) and None)
        load.on_click(lambda _: self.load(str(self._name.value)))
        audit.on_click(lambda _: threading.Thread(target=self.audit, name="audit", daemon=True).start())
        self._handles = (marks, self._message, self.folder)

    def remove(self) -> None:
        """Take it out of the panel."""
        for handle in self._handles:
            handle.remove()

    def mark_of(self, name: str) -> str:
        """Return the text before an episode's name."""
        return MARKS[self.marks.get(name, "")]

    def rows(self) -> list[tuple[str, object]]:
        """Return what is selected, for the panel's table."""
        found: list[tuple[str, object]] = []
        if self.marks:
            left_out = sum(mark == "out" for mark in self.marks.values())
            found.append(("marked", f"{left_out} left out, {len(self.marks) - left_out} flagged"))
        if self.edits:
            found.append(("edited", "; ".join(map(described, self.edits.values()))))
        return found

    def show_message(self, text: str, *, alert: bool = False) -> None:
        """Show a message."""
        self._message.content = markup.paragraph(text, "run-told", alert=alert)

    # ---------------------------------------------------------------- marks and edits

    def mark(self, name: str, what: str) -> None:
        """Leave an episode out, flag it, or take its mark away."""
        if name not in self.ids:
            return
        with self._lock:
            self.marks.pop(name, None)
            if what != "Unmark":
                self.marks[name] = "out" if what == "Leave out" else "flag"
            self._changed()

    def flag(self, episodes: Iterable[str]) -> None:
        """Flag episodes by their names in a selection; those with a mark keep it."""
        wanted = set(episodes)
        with self._lock:
            for name, episode in self.ids.items():
                if episode in wanted or name in wanted:
                    self.marks.setdefault(name, "flag")
            self._changed()

    def trim(self, what: str) -> None:
        """Trim the open episode at the tick that it shows: keep the steps from there on, up to there, or all."""
        shown = self._opened()
        if shown is None:
            return
        before = self.edits.get(shown.episode, Edit(episode=shown.episode))
        start, end = before.steps or (0, shown.last)
        if what == TRIMS[0]:
            start = shown.starts
        elif what == TRIMS[1]:
            end = shown.ends
        else:
            start, end = 0, shown.last
        if start > end:
            self.show_message(
                f"nothing would be left: it would begin at step {start} and end with step {end}", alert=True
            )
            return
        self._edit(replace(before, steps=None if (start, end) == (0, shown.last) else (start, end)))

    def relabel(self, words: str) -> None:
        """Give the open episode another instruction; empty: its own."""
        shown, words = self._opened(), " ".join(words.split())
        if shown is None:
            return
        try:
            Choice.parse([f"relabel {shown.episode} {words}"] if words else [])
        except RoboximError as error:
            self.show_message(str(error), alert=True)
            return
        self._edit(replace(self.edits.get(shown.episode, Edit(episode=shown.episode)), instruction=words))

    def _edit(self, edit: Edit) -> None:
        with self._lock:
            self.edits.pop(edit.episode, None)
            if edit.steps or edit.instruction:
                self.edits[edit.episode] = edit
            self._changed()
        self.show_message(f"{described(edit)}; 'Save the selection' keeps it, the source stays as it is")

    # ---------------------------------------------------------------- files

    def save(self, name: str) -> Path | None:
        """Save the selection; returns the file, or None if it is not possible, which the panel says."""
        out = [self.ids[one] for one, mark in self.marks.items() if mark == "out"]
        flagged = [self.ids[one] for one, mark in self.marks.items() if mark == "flag"]
        text = selection_text(out, flagged, self._source.name, len(self.ids), self.edits.values())
        try:
            file = save_selection(self._folder, name, text, self._own)
        except (RoboximError, OSError) as error:
            self._saved.content = markup.paragraph(str(error), "selection", alert=True)
            return None
        command = self._command.format(source=self._source.name, file=f"@{file.name}")
        self._saved.content = markup.paragraph(f"saved as {file.name}\n{command}", "selection")
        return file

    def load(self, name: str) -> None:
        """Take the marks and edits of a selection file that was saved before."""
        try:
            saved = read_selection(self._folder, name)
            self._own.add(selection_file(self._folder, name))
        except RoboximError as error:
            self.show_message(str(error), alert=True)
            return
        with self._lock:
            self.edits = dict(saved.edits)
            self.marks = {
                one: "out" if episode in saved.left_out else "flag"
                for one, episode in self.ids.items()
                if episode in saved.left_out | saved.flagged
            }
            self._changed()
        self.show_message(f"loaded {name}")

    def audit(self) -> tuple[tuple[str, Finding], ...]:
        """Audit the source, flag the episodes with faults, and list what was found; returns check and finding."""
        from roboxim_runs.datasets.audit import AuditConfig, audit_dataset

        self.show_message("auditing ...")
        try:
            checks = audit_dataset(self._source, None, AuditConfig(render=False, pictures=0)).result.checks
        except RoboximError as error:
            self.show_message(str(error), alert=True)
            return ()
        found = tuple((check.name, finding) for check in checks for finding in check.findings)
        self.flag(name for check in checks for finding in check.faults for name in finding.episodes)
        shown = [f"{check}: {', '.join(one.episodes) or 'all'}: {one.text}" for check, one in found[:MAX_FINDINGS]]
        more = [f"and {len(found) - MAX_FINDINGS} more"] if len(found) > MAX_FINDINGS else []
        self.show_message("\n".join([*shown, *more]) or f"{len(checks)} checks found nothing")
        return found


def described(edit: Edit) -> str:
    """Return an edit in words."""
    parts = [edit.episode]
    if edit.steps:
        parts.append(f"steps {edit.steps[0]} to {edit.steps[1]}")
    if edit.instruction:
        parts.append(f'"{edit.instruction}"')
    return ", ".join(parts) if len(parts) > 1 else f"{edit.episode} whole, with its own instruction"


def meeting(text: str, facts: Mapping[str, Mapping[str, Fact]]) -> frozenset[str]:
    """Return the episodes that meet conditions.

    Args:
        text: Conditions, separated by semicolons; empty: every episode meets them.
        facts: Episode to its facts.

    Raises:
        InvalidRequestError: On a text that is no condition, or a key or value that no episode has.
    """
    conditions = [Condition.parse(part) for part in text.split(";") if part.strip()]
    require_known(conditions, facts.values())
    return frozenset(name for name, known in facts.items() if all(one.holds(known) for one in conditions))
