"""The studio: one page with the view in the middle, and panels for what was opened."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from roboxim_core.closing import Closing
from roboxim_core.errors import RoboximError
from roboxim_core.models.library import ModelLibrary
from roboxim_studio.acting.lab import Lab
from roboxim_studio.bench import Bench
from roboxim_studio.editing.document import from_info
from roboxim_studio.episode.film import Film, read_film
from roboxim_studio.look.scene_view import SceneView
from roboxim_studio.opening import Kind, Opened
from roboxim_studio.own_files import OwnFiles
from roboxim_studio.panels.compose import ComposePanel
from roboxim_studio.panels.dataset import DatasetPanel
from roboxim_studio.panels.drive import FOLDER, DrivePanel
from roboxim_studio.panels.editor import EditorPanel
from roboxim_studio.panels.episode import EpisodePanel
from roboxim_studio.panels.files import FilesPanel
from roboxim_studio.panels.live import LivePanel
from roboxim_studio.panels.what_if import WhatIfPanel
from roboxim_studio.serving.access import Access
from roboxim_studio.serving.site import Site
from roboxim_studio.sharing import share

if TYPE_CHECKING:
    from roboxim_runs.policies.specs import ChosenPolicy
    from roboxim_studio.acting.live import LiveGraph
    from roboxim_studio.first_view import FirstView

EPISODE, SCENE, DRIVE, GRAPH = "Episode", "Scene", "Drive", "Graph"
"""What the view shows: an episode, a scene being edited, an episode that a person drives, or a running graph."""


class Studio(Closing):
    """A running studio. A context manager; `url` is the address to open."""

    def __init__(
        self,
        *,
        port: int = 0,
        open_network: bool = False,
        folder: Path | None = None,
        policies: Sequence[ChosenPolicy] = (),
        graph: LiveGraph | None = None,
        site: Site | None = None,
        first: FirstView | None = None,
    ) -> None:
        """Start the server, without content.

        Args:
            port: Port to listen at; 0: any.
            open_network: Whether other machines may connect.
            folder: Folder that scenes and teleoperated episodes are written to; none: the working directory.
            policies: Policies that "what if" offers, besides the expert.
            graph: A running graph to show and edit; the studio leaves it when it closes.
            site: A server that was started before, so that a page loads while this is made; none: one is started.
            first: What the page of `site` shows already; none: nothing.

        Raises:
            RoboximError: When the port is taken.
        """
        self.library = ModelLibrary() if first is None else first.library
        self.bench, self.lab = Bench(), Lab(policies=policies)
        self._keys = Bench()  # a key must not wait for a simulation
        self.folder = folder or Path.cwd()
        """Folder that files are written to."""
        self._own_pages = OwnFiles()
        self.site = site or Site(Access(open_network=open_network), port)
        server = self.site.viser
        self.view = SceneView(server, self.library) if first is None else first.view
        self._first_film = None if first is None else first.film
        self._modes = server.gui.add_button_group(
            "View", (EPISODE, SCENE, DRIVE) if graph is None else (EPISODE, SCENE, DRIVE, GRAPH)
        )
        self._modes.on_click(lambda event: self.show(str(event.target.value)))
        self.mode = EPISODE
        """What the view shows."""
        self.files = FilesPanel(
            self.site, self.bench, self.folder, self.open_bag, self.open_beside,
            lambda: (self.episode.film, self.episode.tick),
        )  # fmt: skip
        self.dataset = DatasetPanel(self.site, self.view, self.library, self.bench, self.folder)
        self.episode = EpisodePanel(self.site, self.view)
        self.what_if = WhatIfPanel(self.site, self.episode, self.bench, self.lab, self.library)
        self.editor = EditorPanel(self.site, self.view, self.bench, self.lab, self.library, self.folder)
        self.compose = ComposePanel(self.site, self.view, self.bench, self.lab, self.editor, self.watch, self.folder)
        self.drive = DrivePanel(
            self.site, self.view, self.bench, self.lab, self.editor, self.compose, self.folder / FOLDER, self.watch,
            lambda: (self.episode.film, self.episode.tick),
        )  # fmt: skip
        self.compose.driven = lambda: self.drive.driving
        self.live = None if graph is None else LivePanel(self.site, self.view, self.library, graph, self.editor)
        """The panel of the running graph, if there is one."""
        self.view.on_objects_clicked(self._clicked)
        with self.what_if.folder:
            edit = server.gui.add_button("Edit this scene")
            html = server.gui.add_button("Write it as one HTML file")
        edit.on_click(lambda _: self.edit_episode())
        html.on_click(lambda _: self._share())
        self.show(EPISODE)
        self.site.received = self._received

    @property
    def url(self) -> str:
        """Address of the page, with its token."""
        return self.site.url

    def close(self) -> None:
        """End everything."""
        self.episode.close()
        self.dataset.close()
        self.files.close()
        self.drive.close()
        if self.live is not None:
            self.live.close()
        self._keys.close()
        self.bench.close(self._last)
        self.site.close()

    def _last(self) -> None:
        """Set a running episode apart, then free the simulator."""
        self.drive.leave()
        self.lab.close()

    # ---------------------------------------------------------------- opening

    def open(self, opened: Opened) -> None:
        """Show what was named on the command line; a mistake in it is shown in the page, and raised.

        Raises:
            RoboximError: When it cannot be shown.
        """
        try:
            if opened.kind == Kind.BAG and opened.path is not None:
                self.open_bag(opened.path)
            elif opened.kind == Kind.RUN and opened.path is not None:
                self.files.open(opened.path, opened.bags)
            elif opened.kind == Kind.DATASET and opened.path is not None:
                self.dataset.open(opened.path)
            elif opened.kind == Kind.NOTHING and self.live is not None:
                self.show(GRAPH)
            else:
                self.open_task(str(opened.path or ""))
        except RoboximError as error:
            self.site.send(alert=str(error))
            raise

    def open_bag(self, path: Path) -> Film:
        """Show a recorded episode.

        Raises:
            RoboximError: When it is not a complete bag, or its models are unknown.
        """
        film, self._first_film = self._first_film, None
        if film is None or film.path != path:
            film = read_film(path)
        self.watch(film)
        return film

    def open_beside(self, path: Path) -> None:
        """Show a recorded episode beside the one that is open.

        Raises:
            RoboximError: When it cannot be read.
        """
        if self.episode.film is None:
            self.open_bag(path)
        else:
            self.what_if.compare(read_film(path))

    def share(self) -> Path | None:
        """Write the episode that is shown as one HTML file; returns it, or None if that is not possible.

        The file is named as the run's list, or the panel "What if", names the episode.
        """
        film = self.episode.film
        if film is None:
            return None
        self.site.send(alert="")
        names = {entry.path: entry.name for entry in self.files.entries}
        name = film.title if film.path is None else names.get(film.path, film.title)
        file = self.folder / f"{re.sub(r'[^A-Za-z0-9_.-]+', '-', name)}.html"
        try:
            self._own_pages.require(file)
            share(film, self.library, file)
        except (RoboximError, OSError) as error:
            self.site.send(alert=str(error))
            return None
        self.site.send(hint=f"written: {file.name}")
        return file

    def watch(self, film: Film) -> None:
        """Show an episode.

        Raises:
            RoboximError: When its models are unknown.
        """
        self.show(EPISODE)
        self.episode.open(film)

    def open_task(self, task: str = "") -> Any:
        """Draw a task's first scene and edit it; returns the future draw.

        Args:
            task: Name in ``config/tasks``, or a file; empty: the default task.
        """
        self.show(SCENE)
        return self.compose.open(task)

    def edit_episode(self) -> None:
        """Edit the scene of the episode that is shown; why that is not possible is shown in the page."""
        film = self.episode.film
        if film is None:
            return
        try:
            document = from_info(film.info)
            self.show(SCENE)
            self.editor.open(document)
        except RoboximError as error:
            self.site.send(alert=str(error))

    # ---------------------------------------------------------------- modes

    def show(self, mode: str) -> None:
        """Give the view to a mode's panels."""
        before, self.mode = self.mode, mode
        editing = mode == SCENE
        self.editor.folder.visible = editing and self.editor.desk is not None
        self.compose.folder.visible = editing or mode == DRIVE
        self.drive.folder.visible = mode == DRIVE
        first = self.drive.folder if mode == DRIVE else self.editor.folder
        self.compose.folder.order = first.order + (0.5 if mode == DRIVE else -0.5)
        self.dataset.folder.visible = mode == EPISODE and self.dataset.dataset is not None
        self.files.folder.visible = mode == EPISODE and self.files.run is not None
        watching = mode == EPISODE and self.episode.film is not None
        self.episode.folder.visible = self.what_if.folder.visible = watching
        if self.live is not None:
            self.live.folder.visible = mode == GRAPH
        if before == mode:
            return
        if before == DRIVE:
            self.drive.pause()
            self.bench.do(self.drive.leave)
        elif before == SCENE:
            self.editor.hide()
        elif before == GRAPH and self.live is not None:
            self.live.hide()
        else:
            self.episode.hide()
            self.what_if.hide()
            self.dataset.hide()
        if mode == DRIVE:
            self.drive.prefer_edits()
        if mode == SCENE:
            self.editor.show()
            self.compose.show_again()
        elif mode == EPISODE:
            self.episode.show_again()
            if self.dataset.dataset is not None:
                self.dataset.show_again()
        elif mode == GRAPH and self.live is not None:
            self.live.show()

    def _share(self) -> None:
        self.share()

    def _clicked(self, entity: str) -> None:
        if self.mode == SCENE and self.editor.desk is not None:
            self.editor.select(entity)
        elif self.mode == GRAPH and self.live is not None:
            self.live.select(entity)

    def _received(self, page: int, message: Mapping[str, Any]) -> None:
        """Obey a page; called in the server's thread."""
        self.drive.receive(page, message)
        key = message.get("key")
        if isinstance(key, str):
            if self.mode == EPISODE:
                self._keys.do(lambda: self.episode.key(key))
            elif self.mode == DRIVE:
                self._keys.do(lambda: self.drive.key(key))
