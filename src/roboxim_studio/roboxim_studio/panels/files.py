"""The panel of a run: its episodes, with filters, distributions and marks; new episodes appear as they finish."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from viser import uplot

from roboxim_core.errors import RoboximError
from roboxim_datasets.where import Fact
from roboxim_eval.statistics.rates import success_rate
from roboxim_recorder.bag import BagReader
from roboxim_recorder.export.where import facts_of
from roboxim_studio.bench import Bench
from roboxim_studio.episode.film import Film
from roboxim_studio.episode.listing import Entry, list_entries
from roboxim_studio.episode.statistics import Traits, traits
from roboxim_studio.opening import bags_of
from roboxim_studio.panels import markup
from roboxim_studio.panels.editor_forms import by_person
from roboxim_studio.panels.progress import Progress
from roboxim_studio.panels.selection import CONDITIONS_HINT, MARKS, Listed, OpenEpisode, Selection, meeting
from roboxim_studio.serving.site import Site

ANY = "any"
WATCH_S = 2.0
"""Period in which a run's folder is looked at for new episodes."""


UNREADABLE = "unreadable"
Stamp = tuple[tuple[str, int, int], ...]
"""Name, size and time of change of each file of a bag."""


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
        self.selection: Selection | None = None
        """What is marked and edited."""
        self._facts_of: dict[Path, dict[str, Fact]] = {}
        self._meeting: frozenset[str] | None = None
        self.run: Path | None = None
        """The folder."""
        self.progress: Progress | None = None
        """Its current activity."""
        self._lock = threading.RLock()
        self._fresh: list[Any] = []
        self._known: tuple[Path, ...] = ()
        self._unreadable: dict[Path, Stamp] = {}
        self._closed = threading.Event()

    def open(self, folder: Path, bags: tuple[Path, ...]) -> None:
        """List the bags of a run and open the first one that can be read; follow the run until it ends.

        Raises:
            RoboximError: When its results cannot be read.
        """
        with self._lock:
            following = self.run is not None
            self.run, self._known, self._meeting = folder, bags, None
            self.entries = self._read(bags, folder)
            for handle in self._fresh:
                handle.remove()
            self._fresh = []
            with self.folder:
                self._build()
            self.folder.visible = True
        if not following:
            threading.Thread(target=self._follow, name="run", daemon=True).start()
        readable = [entry for entry in self.entries if entry.outcome != UNREADABLE]
        if readable:
            self._open_bag(readable[0].path)

    def close(self) -> None:
        """Stop following."""
        self._closed.set()

    def _build(self) -> None:
        gui, bench = self._gui, self._bench
        assert self.run is not None
        self._facts = gui.add_html("")
        self.progress = Progress(gui, self.run)
        self._skill: Any = gui.add_dropdown("Skill", (ANY,), initial_value=ANY)
        self._ending: Any = gui.add_dropdown("Outcome", (ANY,), initial_value=ANY)
        self._words = gui.add_text("Instruction has", initial_value="")
        self._conditions = gui.add_text("Conditions", initial_value="", hint=CONDITIONS_HINT)
        self._choice: Any = gui.add_dropdown("Episode", ("none",), initial_value="none")
        acts = gui.add_button_group("Then", ("Open", "Beside"))
        self.selection = Selection(
            gui, self._folder, self.run, opened=self._open_episode,
            chosen=lambda: entry.name if (entry := self._entry(self._chosen())) else "", changed=self._list,
            command="roboxim export lerobot {source} --where {file} --out ...",
        )  # fmt: skip
        with self.selection.folder:
            measure = gui.add_button("Measure all episodes")
            self._measured = gui.add_html("")
            self._plots = gui.add_folder("Distributions", visible=False)
        for one in (self._skill, self._ending, self._words):
            one.on_update(lambda _: self._list())
        self._choice.on_update(lambda event: self.open_named(str(event.target.value)) if event.client else None)
        acts.on_click(lambda event: self.open_named(self._chosen(), beside=event.target.value == "Beside"))
        measure.on_click(lambda _: self._measure())
        self._conditions.on_update(by_person(lambda text: bench.do(lambda: self.filter(str(text)), newest_of="filter")))
        self._fresh = [
            self._facts, self.progress, self._skill, self._ending, self._words, self._conditions, self._choice, acts,
            self.selection,
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
            if self._meeting is None or entry.name in self._meeting
        )

    def filter(self, text: str) -> None:
        """List the episodes that meet conditions, as ``--where`` takes them; empty: all. Reads each bag once."""
        assert self.selection is not None
        if not text.strip():
            found, text = None, ""
        else:
            facts: dict[str, dict[str, Fact]] = {}
            for number, entry in enumerate(self.entries):
                if number % 20 == 0:
                    self._show_message(f"{number} of {len(self.entries)} episodes read")
                if entry.outcome != UNREADABLE:
                    facts[entry.name] = self._read_facts(entry)
            try:
                found = meeting(text, facts)
            except RoboximError as error:
                self._show_message(str(error), alert=True)
                return
            text = f"{len(found)} of {len(self.entries)} episodes meet the conditions"
        with self._lock:
            self._meeting = found
            self._list()
        self._show_message(text)

    def _read_facts(self, entry: Entry) -> dict[str, Fact]:
        if entry.path not in self._facts_of:
            try:
                reader = BagReader(entry.path)
                self._facts_of[entry.path] = facts_of(reader.info, reader.result)
            except RoboximError:
                return {"episode": (entry.episode,)}  # listed anyway: opening it shows the error
        return self._facts_of[entry.path]

    def _open_episode(self) -> OpenEpisode | None:
        film, tick = self._opened()
        entry = next((one for one in self.entries if film is not None and one.path == film.path), None)
        if film is None or entry is None:
            return None
        last = film.result.steps - 1
        ends = min(max(tick - 1, 0), last)
        return OpenEpisode(name=entry.name, starts=min(tick, last), ends=ends, last=last)

    def _names(self, entries: tuple[Entry, ...]) -> tuple[str, ...]:
        assert self.selection is not None
        mark_of = self.selection.mark_of
        return tuple(
            f"{mark_of(entry.name)}{entry.name} | {entry.ending} | {entry.instruction}" for entry in entries
        ) or ("none",)

    def _list(self) -> None:
        with self._lock:
            assert self.selection is not None
            assert self.run is not None
            self.selection.listed = {
                entry.name: Listed(source=self.run / entry.policy, episode=entry.episode or entry.path.name)
                for entry in self.entries
            }
            for handle, options in (
                (self._skill, {entry.skill for entry in self.entries if entry.skill}),
                (self._ending, {entry.ending for entry in self.entries}),
            ):
                wanted = (ANY, *sorted(options))
                if tuple(handle.options) != wanted:
                    handle.options = wanted
            names = self._names(self.shown())
            if tuple(self._choice.options) != names:
                before = self._plain(str(self._choice.value))
                self._choice.options = names
                self._choice.value = next((name for name in names if self._plain(name) == before), names[0])
            self._facts.content = markup.facts(self._rows(), "run-facts")

    def _rows(self) -> list[tuple[str, object]]:
        assert self.run is not None
        rows: list[tuple[str, object]] = [("folder", self.run.name), ("episodes", len(self.entries))]
        policies = sorted({entry.policy for entry in self.entries})
        several = len(policies) > 1
        for policy in policies:
            counts = Counter(entry.outcome for entry in self.entries if entry.policy == policy)
            judged = counts["success"] + counts["failure"] + counts["error"]
            if judged:
                rate = success_rate(counts["success"], judged)
                share, whole = 100 * rate.successes / judged, f"{100 * rate.low:.0f} to {100 * rate.high:.0f} %"
                of = f"success of {policy}" if several else "success"
                rows.append((of, f"{share:.0f} % of {judged}, 95 %: {whole}"))
        unreadable = [entry for entry in self.entries if entry.outcome == UNREADABLE]
        reasons = Counter(
            (entry.policy, entry.reason) for entry in self.entries if entry.reason and entry not in unreadable
        )
        for (policy, reason), count in reasons.most_common(6 * len(policies)):
            rows.append((f"not, {policy}: {reason}" if several else f"not: {reason}", count))
        if unreadable:
            rows.append(("unreadable", len(unreadable)))
        assert self.selection is not None
        rows += self.selection.rows()
        return rows

    def _follow(self) -> None:
        """Look at the folder now and then."""
        while not self._closed.wait(WATCH_S):
            self.look()

    def look(self) -> None:
        """Show the progress of a run while a page is open; add the episodes that it has finished.

        A bag that could not be read is read again when it has changed: it was being copied.
        """
        with self._lock:
            run, known = self.run, self._known
            if run is None:
                return
            if self.progress is not None and self._site.pages and self.folder.visible:
                self.progress.follow()
            there = {entry.path: entry for entry in self.entries if not self._changed(entry)}
            try:
                bags = bags_of(run)
                if bags == known and len(there) == len(self.entries):
                    return
                new = {entry.path: entry for entry in self._read([bag for bag in bags if bag not in there], run)}
            except (RoboximError, OSError) as error:  # the folder may be moved, or written at this moment
                self._show_message(str(error), alert=True)
                return
            self._known = bags
            self.entries = tuple((there | new)[bag] for bag in bags)
            self._list()
            if new:
                self._show_message(f"new: {', '.join(entry.name for entry in new.values())}")

    def _read(self, bags: Sequence[Path], run: Path) -> tuple[Entry, ...]:
        stamps = {bag: _stamp(bag) for bag in bags}
        entries = list_entries(bags, run)
        self._unreadable |= {one.path: stamps[one.path] for one in entries if one.outcome == UNREADABLE}
        return entries

    def _changed(self, entry: Entry) -> bool:
        """Return whether a bag that could not be read has changed since."""
        return entry.outcome == UNREADABLE and _stamp(entry.path) != self._unreadable.get(entry.path)

    # ---------------------------------------------------------------- acting on one

    def _chosen(self) -> str:
        return str(self._choice.value)

    def _entry(self, name: str) -> Entry | None:
        return next((entry for entry in self.entries if entry.name == self._plain(name)), None)

    @staticmethod
    def _plain(name: str) -> str:
        """Return an episode's name without its mark and what follows."""
        return name.removeprefix(MARKS["flag"]).removeprefix(MARKS["out"]).partition(" | ")[0]

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
            self._show_message("")
        except RoboximError as error:
            self._show_message(str(error), alert=True)

    # ---------------------------------------------------------------- all together

    def measure(self) -> dict[str, Traits]:
        """Read every listed episode and show distributions; returns the numbers by episode."""
        found: dict[str, Traits] = {}
        entries = [entry for entry in self.shown() if entry.outcome != UNREADABLE]
        for number, entry in enumerate(entries, start=1):
            if self._closed.is_set():
                break
            try:
                reader = BagReader(entry.path)
                states = [tick.state for tick in reader.ticks(cameras=())]
            except RoboximError as error:
                self._show_message(str(error), alert=True)
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

    def _show_message(self, text: str, *, alert: bool = False) -> None:
        assert self.selection is not None
        self.selection.show_message(text, alert=alert)


def _stamp(bag: Path) -> Stamp:
    """Return the state of a bag's files; a folder that is moved at this moment has none."""
    try:
        return tuple((file.name, (about := file.stat()).st_size, about.st_mtime_ns) for file in sorted(bag.iterdir()))
    except OSError:
        return ()
