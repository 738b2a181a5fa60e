"""Selection of a run's or a dataset's episodes: marks (leave out, flag), edits (trim, relabel), and their file."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from shlex import quote
from typing import Any

from roboxim_core.errors import RoboximError
from roboxim_datasets.audit.values import Finding
from roboxim_datasets.where import Choice, Condition, Edit, Fact, require_known
from roboxim_studio.episode.choice import ENDING, read_selection, selection_file, selection_text
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

    name: str
    """Its name in the panel."""
    starts: int
    """First step that is left if it starts here."""
    ends: int
    """Last step that is left if it ends here."""
    last: int
    """Its last step."""


@dataclass(frozen=True, kw_only=True)
class Listed:
    """Where an episode of the panel is."""

    source: Path
    """The run or the dataset; in an evaluation the run of its policy."""
    episode: str
    """Its name in a selection of that source."""


class Selection:
    """Marks and edits of the episodes of one source, or of each run of an evaluation; no source is ever touched."""

    def __init__(
        self, gui: Any, folder: Path, source: Path, *, opened: Callable[[], OpenEpisode | None],
        chosen: Callable[[], str], changed: Callable[[], None], command: str,
    ) -> None:  # fmt: skip
        """Build the buttons and the form in the current container.

        Args:
            gui: The page's GUI.
            folder: Folder to save into.
            source: The run, the evaluation or the dataset.
            opened: Returns the episode that is shown; None: none of the panel's is.
            chosen: Returns the name of the episode that buttons mark.
            changed: Called after every change.
            command: What to type with a saved file, with ``{source}`` and ``{file}``.
        """
        self._folder, self._source, self._command = folder, source, command
        self._opened, self._changed = opened, changed
        self._lock, self._own = threading.RLock(), OwnFiles()
        self.listed: Mapping[str, Listed] = {}
        """Name of every episode in the panel to where it is."""
        self.marks: dict[str, str] = {}
        """Name of an episode to ``flag`` or ``out``."""
        self.edits: dict[str, Edit] = {}
        """Name of an episode to what the selection changes of it."""
        self._kept: dict[Path, tuple[str, ...]] = {}
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
            found.append(("edited", "; ".join(described(name, edit) for name, edit in self.edits.items())))
        if more := [line for lines in self._kept.values() for line in lines if not line.startswith("#")]:
            found.append(("also in the file", "; ".join(more)))
        return found

    @property
    def sources(self) -> tuple[Path, ...]:
        """The runs or the dataset that the listed episodes are of."""
        return tuple(dict.fromkeys(one.source for one in self.listed.values())) or (self._source,)

    def show_message(self, text: str, *, alert: bool = False) -> None:
        """Show a message."""
        self._message.content = markup.paragraph(text, "run-told", alert=alert)

    # ---------------------------------------------------------------- marks and edits

    def mark(self, name: str, what: str) -> None:
        """Leave an episode out, flag it, or take its mark away."""
        if name not in self.listed:
            return
        with self._lock:
            self.marks.pop(name, None)
            if what != "Unmark":
                self.marks[name] = "out" if what == "Leave out" else "flag"
            self._changed()

    def flag(self, source: Path, episodes: Iterable[str]) -> None:
        """Flag episodes of a source by their names in a selection; those with a mark keep it."""
        wanted = set(episodes)
        with self._lock:
            for name, one in self.listed.items():
                if one.source == source and (one.episode in wanted or name in wanted):
                    self.marks.setdefault(name, "flag")
            self._changed()

    def trim(self, what: str) -> None:
        """Trim the open episode at the tick that it shows: keep the steps from there on, up to there, or all."""
        shown = self._open_episode()
        if shown is None:
            return
        before = self._edit_of(shown.name)
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
        self._edit(shown.name, replace(before, steps=None if (start, end) == (0, shown.last) else (start, end)))

    def relabel(self, words: str) -> None:
        """Give the open episode another instruction; empty: its own."""
        shown, words = self._open_episode(), " ".join(words.split())
        if shown is None:
            return
        before = self._edit_of(shown.name)
        try:
            Choice.parse(Edit(episode=before.episode, instruction=words).texts)
        except RoboximError as error:
            self.show_message(str(error), alert=True)
            return
        self._edit(shown.name, replace(before, instruction=words))

    def _open_episode(self) -> OpenEpisode | None:
        """Return the episode that is shown, if it can be edited here; else say why not."""
        shown = self._opened()
        if shown is None or shown.name not in self.listed:
            self.show_message("the episode that is shown is none of this list; open one of the list first", alert=True)
            return None
        return shown

    def _edit_of(self, name: str) -> Edit:
        return self.edits.get(name, Edit(episode=self.listed[name].episode))

    def _edit(self, name: str, edit: Edit) -> None:
        with self._lock:
            self.edits.pop(name, None)
            if edit.steps or edit.instruction:
                self.edits[name] = edit
            self._changed()
        self.show_message(f"{described(name, edit)}; 'Save the selection' keeps it, the source stays as it is")

    # ---------------------------------------------------------------- files

    def save(self, name: str) -> tuple[Path, ...]:
        """Save the selection, a file for each source; returns them: none if it is not possible, which is shown."""
        try:
            files = {source: self._file(name, source) for source in self.sources}
            for file in files.values():
                self._own.require(file)
            for source, file in files.items():
                self._own.write(file, self._text(source))
        except (RoboximError, OSError) as error:
            self._saved.content = markup.paragraph(str(error), "selection", alert=True)
            return ()
        lines = [f"saved as {', '.join(file.name for file in files.values())}"]
        for source, file in files.items():
            lines.append(self._command.format(source=quote(str(source)), file=quote(f"@{file.name}")))
        self._saved.content = markup.paragraph("\n".join(lines), "selection")
        return tuple(files.values())

    def _file(self, name: str, source: Path) -> Path:
        """Return the file of a source's selection; those of an evaluation's runs end in the policy's name."""
        stem = name.removesuffix(ENDING)
        return selection_file(self._folder, stem if source == self._source or not stem else f"{stem}-{source.name}")

    def _text(self, source: Path) -> str:
        own = {name: one.episode for name, one in self.listed.items() if one.source == source}
        marked = {mark: [own[name] for name in own if self.marks.get(name) == mark] for mark in ("out", "flag")}
        edits = [self.edits[name] for name in own if name in self.edits]
        kept = self._kept.get(source, ())
        return selection_text(marked["out"], marked["flag"], source.name, len(own), edits, kept)

    def load(self, name: str) -> None:
        """Take the marks and edits of a selection that was saved before; other lines of it stay as they are."""
        marks: dict[str, str] = {}
        edits: dict[str, Edit] = {}
        kept: dict[Path, tuple[str, ...]] = {}
        try:
            files = {source: self._file(name, source) for source in self.sources}
            for source, file in {s: f for s, f in files.items() if f.exists()}.items() or files.items():
                names = {one.episode: each for each, one in self.listed.items() if one.source == source}
                saved = read_selection(file, names.keys())
                marks |= {names[one]: "flag" for one in saved.flagged} | {names[one]: "out" for one in saved.left_out}
                edits |= {names[one]: edit for one, edit in saved.edits.items()}
                kept[source] = saved.kept
                self._own.add(file)
        except RoboximError as error:
            self.show_message(str(error), alert=True)
            return
        with self._lock:
            self.marks, self.edits, self._kept = marks, edits, kept
            self._changed()
        self.show_message(f"loaded {name}")

    def audit(self) -> tuple[tuple[str, Finding], ...]:
        """Audit the sources, flag the episodes with faults, and list what was found; returns check and finding."""
        from roboxim_runs.datasets.audit import AuditConfig, audit_dataset

        self.show_message("auditing ...")
        found: list[tuple[str, Finding]] = []
        number, sources = 0, self.sources
        try:
            for source in sources:
                checks = audit_dataset(source, None, AuditConfig(render=False, pictures=0)).result.checks
                of = f"{source.name}: " if len(sources) > 1 else ""
                found += [(of + check.name, finding) for check in checks for finding in check.findings]
                self.flag(source, (name for check in checks for fault in check.faults for name in fault.episodes))
                number += len(checks)
        except RoboximError as error:
            self.show_message(str(error), alert=True)
            return ()
        shown = [f"{check}: {', '.join(one.episodes) or 'all'}: {one.text}" for check, one in found[:MAX_FINDINGS]]
        more = [f"and {len(found) - MAX_FINDINGS} more"] if len(found) > MAX_FINDINGS else []
        self.show_message("\n".join([*shown, *more]) or f"{number} checks found nothing")
        return tuple(found)


def described(name: str, edit: Edit) -> str:
    """Return an edit of an episode in words."""
    parts = [name]
    if edit.steps:
        parts.append(f"steps {edit.steps[0]} to {edit.steps[1]}")
    if edit.instruction:
        parts.append(f'"{edit.instruction}"')
    return ", ".join(parts) if len(parts) > 1 else f"{name} whole, with its own instruction"


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
