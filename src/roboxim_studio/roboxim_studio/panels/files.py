"""The panel of a run: its episodes, filtered; their distributions; which to leave out; new ones as they come."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from viser import uplot

from roboxim_core.errors import RoboximError
from roboxim_datasets.audit.values import Finding
from roboxim_datasets.where import Choice, Edit
from roboxim_eval.statistics.rates import success_rate
from roboxim_recorder.bag import BagReader
from roboxim_studio.bench import Bench
from roboxim_studio.episode.choice import read_selection, save_selection, selection_text
from roboxim_studio.episode.film import Film
from roboxim_studio.episode.listing import Entry, list_entries
from roboxim_studio.episode.statistics import Traits, traits
from roboxim_studio.opening import bags_of
from roboxim_studio.panels import markup
from roboxim_studio.panels.progress import Progress
from roboxim_studio.serving.site import Site

ANY = "any"
WATCH_S = 1.0
"""Period in which a run's folder is looked at for new episodes."""
TRIMS = ("Starts here", "Ends here", "Whole again")
"""How the open episode is trimmed at the tick that it shows."""
MOST_FINDINGS = 12
"""Findings of an audit that the panel lists."""
MARKS = {"": "", "flag": "! ", "out": "x "}
"""Mark of an episode to the text before its name."""


class FilesPanel:
    """Lists the episodes of one folder; only bags of that folder can be opened."""

    def __init__(
        self, site: Site, bench: Bench, folder: Path, open_bag: Callable[[Path], Film], beside: Callable[[Path], None],
        opened: Callable[[], tuple[Film | None, int]],
    ) -> None:  # fmt: skip
        """Build the panel in the current container; it stays hidden until a run is opened.

        Args:
            site: The page.
            bench: Where bags are read for statistics.
            folder: Folder to save selections into.
            open_bag: Shows an episode.
            beside: Shows an episode beside the one that is open.
            opened: Returns the episode that is open in the studio, and the tick that it shows.
        """
        self._opened = opened
        self._site, self._gui, self._bench = site, site.viser.gui, bench
        self._folder, self._open_bag, self._show_beside = folder, open_bag, beside
        self.folder = self._gui.add_folder("Run", visible=False)
        self.entries: tuple[Entry, ...] = ()
        """Every episode of the run."""
        self.marks: dict[str, str] = {}
        """Episode to ``flag`` or ``out``."""
        self.edits: dict[str, Edit] = {}
        """Episode to what the selection changes of it."""
        self.run: Path | None = None
        """The folder."""
        self.progress: Progress | None = None
        """What goes on in it."""
        self._lock = threading.RLock()
        self._fresh: list[Any] = []
        self._known: tuple[Path, ...] = ()
        self._closed = threading.Event()

    def open(self, folder: Path, bags: tuple[Path, ...]) -> None:
        """List the bags of a run and open the first one that can be read; follow the run while it goes on.

        Raises:
            RoboximError: When its results cannot be read.
        """
        with self._lock:
            following = self.run is not None
            self.run, self._known, self.marks, self.edits = folder, bags, {}, {}
            self.entries = list_entries(bags, folder)
            for handle in self._fresh:
                handle.remove()
            self._fresh = []
            with self.folder:
                self._build()
            self.folder.visible = True
        if not following:
            threading.Thread(target=self._follow, name="run", daemon=True).start()
        readable = [entry for entry in self.entries if entry.outcome != "unreadable"]
        if readable:
            self._open_bag(readable[0].path)

    def close(self) -> None:
        """Stop following."""
        self._closed.set()

    def _build(self) -> None:
        gui = self._gui
        assert self.run is not None
        self._facts = gui.add_html("")
        self.progress = Progress(gui, self.run)
        self._skill: Any = gui.add_dropdown("Skill", (ANY,), initial_value=ANY)
        self._ending: Any = gui.add_dropdown("Outcome", (ANY,), initial_value=ANY)
        self._words = gui.add_text("Instruction has", initial_value="")
        self._choice: Any = gui.add_dropdown("Episode", self._names(self.entries), initial_value=None)
        acts = gui.add_button_group("Then", ("Open", "Beside"))
        marks = gui.add_button_group("Mark", ("Leave out", "Flag", "Unmark"))
        self._told = gui.add_html("")
        more = gui.add_folder("Selection, distributions", expand_by_default=False)
        with more:
            trims = gui.add_button_group("Open episode", TRIMS)
            self._new_words = gui.add_text("New instruction", initial_value="")
            relabel = gui.add_button("Give it this instruction")
            self._name = gui.add_text("Save as", initial_value="my_selection")
            save = gui.add_button("Save the selection")
            load = gui.add_button("Load a saved selection")
            audit = gui.add_button("Audit all episodes")
            measure = gui.add_button("Measure all episodes")
            self._measured = gui.add_html("")
            self._plots = gui.add_folder("Distributions", visible=False)
        for one in (self._skill, self._ending, self._words):
            one.on_update(lambda _: self._list())
        self._choice.on_update(lambda event: self.open_named(str(event.target.value)) if event.client else None)
        acts.on_click(lambda event: self.open_named(self._chosen(), beside=event.target.value == "Beside"))
        marks.on_click(lambda event: self.mark(self._chosen(), str(event.target.value)))
        trims.on_click(lambda event: self.trim(str(event.target.value)))
        relabel.on_click(lambda _: self.relabel(str(self._new_words.value)))
        load.on_click(lambda _: self.load(str(self._name.value)))
        audit.on_click(lambda _: threading.Thread(target=self.audit, name="audit", daemon=True).start())
        save.on_click(lambda _: self._save())
        measure.on_click(lambda _: self._measure())
        self._fresh = [
            self._facts, self.progress, self._skill, self._ending, self._words, self._choice, acts, marks, self._told,
            more,
        ]  # fmt: skip
        self._list()

    # ---------------------------------------------------------------- listing

    def shown(self) -> tuple[Entry, ...]:
        """Return the episodes that pass the filters."""
        skill, ending, words = self._skill.value, self._ending.value, str(self._words.value).lower()
        return tuple(
            entry
            for entry in self.entries
            if skill in (ANY, entry.skill) and ending in (ANY, entry.ending) and words in entry.instruction.lower()
        )

    def _names(self, entries: tuple[Entry, ...]) -> tuple[str, ...]:
        return tuple(
            f"{MARKS[self.marks.get(entry.name, '')]}{entry.name} | {entry.ending} | {entry.instruction}"
            for entry in entries
        ) or ("none",)

    def _list(self) -> None:
        with self._lock:
            for handle, options in (
                (self._skill, {entry.skill for entry in self.entries if entry.skill}),
                (self._ending, {entry.ending for entry in self.entries}),
            ):
                wanted = (ANY, *sorted(options))
                if tuple(handle.options) != wanted:
                    handle.options = wanted
            names = self._names(self.shown())
            if tuple(self._choice.options) != names:
                self._choice.options = names
            self._facts.content = markup.facts(self._rows(), "run-facts")

    def _rows(self) -> list[tuple[str, object]]:
        assert self.run is not None
        counts = Counter(entry.outcome for entry in self.entries)
        judged = counts["success"] + counts["failure"] + counts["error"]
        rows: list[tuple[str, object]] = [("folder", self.run.name), ("episodes", len(self.entries))]
        if judged:
            rate = success_rate(counts["success"], judged)
            share = 100 * rate.successes / judged
            rows.append(
                ("success", f"{share:.0f} % of {judged}, 95 %: {100 * rate.low:.0f} to {100 * rate.high:.0f} %")
            )
        reasons = Counter(entry.reason for entry in self.entries if entry.reason and entry.outcome != "unreadable")
        rows += [(f"not: {reason}", count) for reason, count in reasons.most_common(6)]
        if counts["unreadable"]:
            rows.append(("unreadable", counts["unreadable"]))
        if self.marks:
            left_out = sum(mark == "out" for mark in self.marks.values())
            rows.append(("marked", f"{left_out} left out, {len(self.marks) - left_out} flagged"))
        if self.edits:
            rows.append(("edited", "; ".join(map(_described, self.edits.values()))))
        return rows

    def _follow(self) -> None:
        """Show how a running run goes on, while a page looks; add the episodes that it finishes."""
        while not self._closed.wait(WATCH_S):
            with self._lock:
                run, known = self.run, self._known
                if run is None:
                    continue
                if self.progress is not None and self._site.pages and self.folder.visible:
                    self.progress.follow()
                bags = bags_of(run)
                if bags == known:
                    continue
                there = {entry.path: entry for entry in self.entries}
                try:
                    new = {entry.path: entry for entry in list_entries([bag for bag in bags if bag not in there], run)}
                except RoboximError as error:
                    self._say(str(error), alert=True)
                    continue
                self._known = bags
                self.entries = tuple((there | new)[bag] for bag in bags)
                self._list()
                if new:
                    self._say(f"new: {', '.join(entry.name for entry in new.values())}")

    # ---------------------------------------------------------------- acting on one

    def _chosen(self) -> str:
        return str(self._choice.value)

    def _entry(self, name: str) -> Entry | None:
        wanted = name.removeprefix(MARKS["flag"]).removeprefix(MARKS["out"]).partition(" | ")[0]
        return next((entry for entry in self.entries if entry.name == wanted), None)

    def open_named(self, name: str, *, beside: bool = False) -> None:
        """Open an episode of the list, or show it beside the one that is open."""
        entry = self._entry(name)
        if entry is None:
            return
        try:
            if beside:
                self._show_beside(entry.path)
            else:
                self._open_bag(entry.path)
            self._say("")
        except RoboximError as error:
            self._say(str(error), alert=True)

    def mark(self, name: str, what: str) -> None:
        """Leave an episode out of the selection, flag it, or take its mark away."""
        entry = self._entry(name)
        if entry is None:
            return
        with self._lock:
            self.marks.pop(entry.name, None)
            if what != "Unmark":
                self.marks[entry.name] = "out" if what == "Leave out" else "flag"
            place = self.shown().index(entry) if entry in self.shown() else 0
            self._list()
            self._choice.value = self._names(self.shown())[place]

    def trim(self, what: str) -> None:
        """Trim the open episode at the tick that it shows: keep it from there on, up to there, or whole again."""
        film, tick = self._opened()
        if film is None:
            return
        name, last = film.info.episode_id, film.result.steps - 1
        before = self.edits.get(name, Edit(episode=name))
        start, end = before.steps or (0, last)
        if what == TRIMS[0]:
            start = min(tick, last)
        elif what == TRIMS[1]:
            end = min(max(tick - 1, 0), last)
        else:
            start, end = 0, last
        if start > end:
            self._say(f"nothing would be left: it would begin at tick {start} and end at {end + 1}", alert=True)
            return
        self._edit(replace(before, steps=None if (start, end) == (0, last) else (start, end)))

    def relabel(self, words: str) -> None:
        """Give the open episode another instruction; empty: its own."""
        film, _ = self._opened()
        if film is None:
            return
        name, words = film.info.episode_id, " ".join(words.split())
        try:
            Choice.parse([f"relabel {name} {words}"] if words else [])
        except RoboximError as error:
            self._say(str(error), alert=True)
            return
        self._edit(replace(self.edits.get(name, Edit(episode=name)), instruction=words))

    def _edit(self, edit: Edit) -> None:
        with self._lock:
            self.edits.pop(edit.episode, None)
            if edit.steps or edit.instruction:
                self.edits[edit.episode] = edit
            self._list()
        self._say(f"{_described(edit)}; 'Save the selection' keeps it, the bag stays as it is")

    def load(self, name: str) -> None:
        """Take the marks and edits of a selection file that was saved before."""
        try:
            saved = read_selection(self._folder, name)
        except RoboximError as error:
            self._say(str(error), alert=True)
            return
        with self._lock:
            self.edits = dict(saved.edits)
            self.marks = {
                entry.name: "out" if entry.episode in saved.left_out else "flag"
                for entry in self.entries
                if entry.episode in saved.left_out | saved.flagged
            }
            self._list()
        self._say(f"loaded {name}")

    def audit(self) -> tuple[tuple[str, Finding], ...]:
        """Audit the run's bags, flag the episodes with faults, and list what was found; returns check and finding."""
        from roboxim_runs.datasets.audit import AuditConfig, audit_dataset

        assert self.run is not None
        self._say("auditing ...")
        try:
            checks = audit_dataset(self.run, None, AuditConfig(render=False, pictures=0)).result.checks
        except RoboximError as error:
            self._say(str(error), alert=True)
            return ()
        found = tuple((check.name, finding) for check in checks for finding in check.findings)
        faulty = {name for check in checks for finding in check.faults for name in finding.episodes}
        with self._lock:
            for entry in self.entries:
                if entry.episode in faulty:
                    self.marks.setdefault(entry.name, "flag")
            self._list()
        shown = [f"{check}: {', '.join(one.episodes) or 'all'}: {one.text}" for check, one in found[:MOST_FINDINGS]]
        more = [f"and {len(found) - MOST_FINDINGS} more"] if len(found) > MOST_FINDINGS else []
        self._say("\n".join([*shown, *more]) or f"{len(checks)} checks found nothing")
        return found

    def save(self, name: str) -> Path | None:
        """Save the selection; returns the file, or None if it is not possible, which the panel says."""
        assert self.run is not None
        ids = {entry.name: entry.episode or entry.name for entry in self.entries}
        out = [ids[name] for name, mark in self.marks.items() if mark == "out"]
        flagged = [ids[name] for name, mark in self.marks.items() if mark == "flag"]
        text = selection_text(out, flagged, self.run.name, len(self.entries), self.edits.values())
        try:
            file = save_selection(self._folder, name, text)
        except (RoboximError, OSError) as error:
            self._measured.content = markup.paragraph(str(error), "selection", alert=True)
            return None
        self._measured.content = markup.paragraph(
            f"saved as {file.name}\nroboxim export lerobot {self.run.name} --where @{file.name} --out ...", "selection"
        )
        return file

    def _save(self) -> None:
        self.save(str(self._name.value))

    # ---------------------------------------------------------------- all together

    def measure(self) -> dict[str, Traits]:
        """Read every listed episode and show distributions; returns the numbers by episode."""
        found: dict[str, Traits] = {}
        entries = [entry for entry in self.shown() if entry.outcome != "unreadable"]
        for number, entry in enumerate(entries, start=1):
            if self._closed.is_set():
                break
            try:
                reader = BagReader(entry.path)
                states = [tick.state for tick in reader.ticks(cameras=())]
            except RoboximError as error:
                self._say(str(error), alert=True)
                continue
            found[entry.name] = traits(states, reader.info.scene.tick_ns / 1e9)
            if number % 10 == 0:
                self._measured.content = markup.paragraph(f"{number} of {len(entries)} read", "selection")
        self._show_traits(found)
        return found

    def _measure(self) -> None:
        threading.Thread(target=self.measure, name="measure", daemon=True).start()

    def _show_traits(self, found: dict[str, Traits]) -> None:
        if not found:
            return
        ranked = sorted(found.items(), key=lambda item: -item[1].jerk_m_s3)[:8]
        self._measured.content = markup.facts(
            [("jerkiest", "rms of the tool's jerk"), *((n, f"{t.jerk_m_s3:.1f} m/s3") for n, t in ranked)], "selection"
        )
        with self._lock, self._plots:
            for handle in tuple(self._plots._children.values()):
                handle.remove()
            lengths, edges = np.histogram([one.steps for one in found.values()], bins=min(20, len(found) + 1))
            self._gui.add_uplot(
                (edges[:-1].astype(float), lengths.astype(float)),
                (uplot.Series(label="ticks"), uplot.Series(label="episodes", stroke="#1c7ed6", width=2)),
                title="lengths", height=170,
            )  # fmt: skip
            places = np.array([one.start_m["target"] for one in found.values() if "target" in one.start_m])
            if len(places):
                order = np.argsort(places[:, 1])
                line = uplot.Series(
                    label="x [m]", stroke="#e8590c", width=0, points=uplot.Series_Points(show=True, size=6)
                )
                self._gui.add_uplot(
                    (places[order, 1], places[order, 0]),
                    (uplot.Series(label="y [m]"), line),
                    title="start of the target", height=220, scales={"x": uplot.Scale(time=False)},
                )  # fmt: skip
        self._plots.visible = True

    def _say(self, text: str, *, alert: bool = False) -> None:
        self._told.content = markup.paragraph(text, "run-told", alert=alert)


def _described(edit: Edit) -> str:
    """Return an edit in words, by ticks."""
    parts = [edit.episode]
    if edit.steps:
        parts.append(f"ticks {edit.steps[0]} to {edit.steps[1] + 1}")
    if edit.instruction:
        parts.append(f'"{edit.instruction}"')
    return ", ".join(parts) if len(parts) > 1 else f"{edit.episode} whole, with its own instruction"
