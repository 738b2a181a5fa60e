"""The first picture of a page: the first state of a bag, shown before most of the studio is imported."""

from __future__ import annotations

from dataclasses import dataclass

from roboxim_core.errors import RoboximError
from roboxim_core.models.library import ModelLibrary
from roboxim_studio.episode.film import Film, read_film
from roboxim_studio.look.scene_view import SceneView
from roboxim_studio.opening import Kind, Opened
from roboxim_studio.serving.site import Site


@dataclass(frozen=True, kw_only=True)
class FirstView:
    """What a page shows while the studio is imported."""

    library: ModelLibrary
    """Robots and objects."""
    view: SceneView
    """The view."""
    film: Film | None
    """The episode that it shows; none: nothing was opened that can be shown at once."""


def first_view(site: Site, opened: Opened) -> FirstView:
    """Show the first state of a bag, or of a run's first bag; anything else, and an error, is left to the studio.

    Args:
        site: The page's server.
        opened: What was named on the command line.
    """
    library = ModelLibrary()
    view = SceneView(site.viser, library)
    bag = {Kind.BAG: opened.path, Kind.RUN: next(iter(opened.bags), None)}.get(opened.kind)
    film = None
    if bag is not None:
        try:
            film = read_film(bag)
            view.load(film.info.scene)
            view.show(film.states[0])
        except RoboximError:
            film = None  # the studio reads it again, and shows the error in the page
    return FirstView(library=library, view=view, film=film)
