"""An episode in 3D within a notebook: the page of `roboxim_studio.sharing`, in a frame of its own."""

from __future__ import annotations

import html
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from roboxim_core.errors import ConfigError, counted
from roboxim_core.whole_files import write_whole

HEIGHT_PX = 560
"""Height of the view in a notebook [px]."""


@dataclass(frozen=True, kw_only=True)
class View:
    """An episode that plays in a notebook; it sends no requests. `save` writes it as one HTML file."""

    title: str
    """The episode."""
    page: str
    """The whole page, HTML."""
    height: int = HEIGHT_PX
    """Height in a notebook [px]."""

    def save(self, file: Path | str) -> Path:
        """Write the page; return the file.

        Raises:
            OSError: When it cannot be written.
        """
        path = Path(file)
        write_whole(path, self.page)
        return path

    def __repr__(self) -> str:
        """Say what it shows: a page of megabytes is no text for a person."""
        return f"View of {self.title}; the last line of a notebook's cell shows it, save('episode.html') writes it"

    def _repr_html_(self) -> str:
        # without allow-same-origin the page's scripts cannot reach the notebook
        page = html.escape(self.page, quote=True)
        return (
            f'<iframe sandbox="allow-scripts" title="{html.escape(self.title, quote=True)}" loading="lazy" '
            f'style="width:100%;height:{self.height}px;border:0" srcdoc="{page}"></iframe>'
        )


def view(what: Any, episode: int = 0, *, height: int = HEIGHT_PX) -> View:
    """Return a recorded episode in 3D, which a notebook shows: robot, objects, cameras, verdict, with a seek bar.

    Args:
        what: A bag, the folder of a run, or an episode of a result (``evaluation.episodes[0]``).
        episode: Number of the episode in a run, in the order of the bags' names.
        height: Height in the notebook [px].

    Raises:
        ConfigError: When there is no such episode, or it has no bag.
        RecorderError: When the bag is damaged.
    """
    from roboxim_core.models.library import ModelLibrary
    from roboxim_studio.episode.film import read_film
    from roboxim_studio.opening import recognise
    from roboxim_studio.sharing import episode_html

    if hasattr(what, "bag") and not isinstance(what, str | Path):
        if what.bag is None:
            raise ConfigError("the episode has no bag, so there is nothing to view; record it (keep='all')")
        what = what.bag
    opened = recognise(str(what))
    bags = (opened.path,) if opened.path is not None and not opened.bags else opened.bags
    if opened.kind not in ("bag", "run") or not 0 <= episode < len(bags):
        count = f"{counted(len(bags), 'episode')}, from 0" if opened.kind == "run" else f"a {opened.kind}"
        raise ConfigError(f"{what}: no episode {episode} to view: it is {count}; name a bag, or a run's folder")
    bag = bags[episode]
    assert bag is not None
    film = read_film(bag, in_background=False)
    return View(title=film.title, page=episode_html(film, ModelLibrary()), height=height)
