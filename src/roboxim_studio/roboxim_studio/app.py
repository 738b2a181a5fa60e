"""The studio: one page with the view in the middle, and panels for what was opened."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from roboxim_core.errors import RoboximError
from roboxim_core.models.library import ModelLibrary
from roboxim_studio.acting.lab import Lab
from roboxim_studio.bench import Bench
from roboxim_studio.episode.film import Film, read_film
from roboxim_studio.look.scene_view import SceneView
from roboxim_studio.opening import Kind, Opened
from roboxim_studio.panels.episode import EpisodePanel
from roboxim_studio.panels.files import FilesPanel
from roboxim_studio.panels.what_if import WhatIfPanel
from roboxim_studio.serving.access import Access
from roboxim_studio.serving.site import Site


class Studio:
    """A running studio. A context manager; `serve` opens the address that `url` names."""

    def __init__(self, *, port: int = 0, open_network: bool = False) -> None:
        """Start the server, without content.

        Args:
            port: Port to listen at; 0: any.
            open_network: Whether other machines may connect.

        Raises:
            RoboximError: When the port is taken.
        """
        self.library = ModelLibrary()
        self.bench, self.lab = Bench(), Lab()
        self.site = Site(Access(open_network=open_network), port, received=self._received)
        self.site.viser.scene.set_up_direction("+z")
        self.site.viser.initial_camera.position = (1.55, -0.9, 0.95)
        self.site.viser.initial_camera.look_at = (0.45, 0.0, 0.1)
        self.view = SceneView(self.site.viser, self.library)
        self.files = FilesPanel(self.site, self.open_bag)
        self.episode = EpisodePanel(self.site, self.view)
        self.what_if = WhatIfPanel(self.site, self.episode, self.bench, self.lab, self.library)

    @property
    def url(self) -> str:
        """Address of the page, with its token."""
        return self.site.url

    def __enter__(self) -> Studio:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def close(self) -> None:
        """End everything."""
        self.episode.close()
        self.bench.close(self.lab.close)
        self.site.close()

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
        except RoboximError as error:
            self.site.tell(alert=str(error))
            raise

    def open_bag(self, path: Path) -> Film:
        """Show a recorded episode.

        Raises:
            RoboximError: When it is no whole bag, or its models are unknown.
        """
        film = read_film(path)
        self.episode.open(film)
        return film

    def _received(self, page: int, message: Mapping[str, Any]) -> None:
        """Obey a page; called in the server's thread."""
        key = message.get("key")
        if isinstance(key, str):
            self.bench.do(lambda: self.episode.key(key))
