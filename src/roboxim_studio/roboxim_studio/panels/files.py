"""The panel that lists a run's episodes and opens them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from roboxim_core.errors import RoboximError
from roboxim_studio.episode.film import Film
from roboxim_studio.episode.listing import Entry, list_entries
from roboxim_studio.panels import markup
from roboxim_studio.serving.site import Site

ANY = "any"


class FilesPanel:
    """Lists episodes, filtered; only bags of the folder that was opened can be named."""

    def __init__(self, site: Site, open_bag: Callable[[Path], Film]) -> None:
        """Build the panel in the current container; it stays hidden until a run is opened."""
        self._site, self._gui, self._open_bag = site, site.viser.gui, open_bag
        self.folder = self._gui.add_folder("Run", visible=False)
        self.entries: tuple[Entry, ...] = ()
        """Every episode of the run."""
        self._fresh: list[Any] = []

    def open(self, folder: Path, bags: tuple[Path, ...]) -> None:
        """List the bags of a run and open the first one.

        Raises:
            RoboximError: When the first one cannot be opened.
        """
        self.entries = list_entries(bags)
        for handle in self._fresh:
            handle.remove()
        gui = self._gui
        with self.folder:
            counts = Counter(entry.outcome for entry in self.entries)
            rows = [("folder", folder.name), ("episodes", len(self.entries)), *sorted(counts.items())]
            self._filters = {
                name: gui.add_dropdown(name.capitalize(), (ANY, *options), initial_value=ANY)
                for name, options in (
                    ("skill", sorted({entry.skill for entry in self.entries})),
                    ("outcome", sorted({entry.ending for entry in self.entries})),
                )
            }
            self._choice = gui.add_dropdown("Open", self._names(), initial_value=self._names()[0])
            self._told = gui.add_html("")
            facts = gui.add_html(markup.facts(rows, "run-facts"))
        for one in self._filters.values():
            one.on_update(lambda _: self._filter())
        self._choice.on_update(lambda event: self._open(str(event.target.value)) if event.client else None)
        self._fresh = [*self._filters.values(), self._choice, self._told, facts]
        self.folder.visible = True
        self._open_bag(self.entries[0].path)

    def _chosen(self) -> tuple[Entry, ...]:
        skill, ending = self._filters["skill"].value, self._filters["outcome"].value
        return tuple(entry for entry in self.entries if skill in (ANY, entry.skill) and ending in (ANY, entry.ending))

    def _names(self) -> tuple[str, ...]:
        chosen = self._chosen() if self._fresh else self.entries
        return tuple(f"{entry.name} | {entry.ending} | {entry.instruction}" for entry in chosen) or ("none",)

    def _filter(self) -> None:
        self._choice.options = self._names()

    def _open(self, name: str) -> None:
        wanted = name.partition(" | ")[0]
        found = [entry for entry in self.entries if entry.name == wanted]
        if not found:
            return
        try:
            self._open_bag(found[0].path)
            self._told.content = ""
        except RoboximError as error:
            self._told.content = markup.paragraph(str(error), "run-error", alert=True)
