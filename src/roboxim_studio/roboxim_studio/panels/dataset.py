"""The panel of a dataset of RLDS, LeRobot or HDF5: an episode's pictures, actions and observations, step by step.

A dataset has no states, so there is no view in 3D; an episode that was exported from a bag names it.
"""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from roboxim_core.errors import RoboximError
from roboxim_datasets.dataset import Dataset
from roboxim_datasets.episode import Episode
from roboxim_datasets.formats import open_dataset
from roboxim_studio.episode.film import Pictures
from roboxim_studio.panels import markup
from roboxim_studio.panels.plots import COLOURS, Plot
from roboxim_studio.serving.site import Site

MOST_LISTED = 500
"""Episodes that the list names; others are opened by number."""
LARGEST_PX = 256
"""Longer side of the pictures [px]; larger ones are scaled down."""


class DatasetPanel:
    """Shows one episode of a dataset."""

    def __init__(self, site: Site) -> None:
        """Build the panel in the current container; it stays hidden until a dataset is opened."""
        self._site, self._gui = site, site.viser.gui
        self.folder = self._gui.add_folder("Dataset", visible=False)
        self.dataset: Dataset | None = None
        """The dataset."""
        self.episode: Episode | None = None
        """Its episode that is shown."""
        self._pictures = Pictures()
        self._fresh: list[Any] = []
        self._own: list[Any] = []
        self._images: dict[str, Any] = {}
        self._lock = threading.RLock()

    def open(self, path: Path) -> None:
        """Open a dataset at its first episode.

        Raises:
            RoboximError: When it cannot be read.
        """
        self.dataset = open_dataset(path)
        gui = self._gui
        splits = ", ".join(f"{name} {count}" for name, count in self.dataset.splits.items())
        with self.folder:
            facts = gui.add_html(
                markup.facts(
                    [("folder", path.name), ("episodes", f"{len(self.dataset)} ({splits})")], "dataset-facts"
                )
            )  # fmt: skip
            number = gui.add_number("Episode", initial_value=0, min=0, max=max(0, len(self.dataset) - 1), step=1)
        number.on_update(lambda event: self.show(int(event.target.value)) if event.client else None)
        self._fresh = [facts, number]
        self.folder.visible = True
        self.show(0)

    def show(self, index: int) -> None:
        """Show an episode by its number; one that cannot be read is named."""
        assert self.dataset is not None
        try:
            episode = self.dataset.episode(index)
            rows = [step for step in episode.steps(cameras=())]
        except RoboximError as error:
            self._site.tell(alert=str(error))
            return
        with self._lock:
            self.episode, self._pictures = episode, Pictures()
            for handle in self._own:
                handle.remove()
            self._own, self._images = [], {}
            with self.folder:
                self._build(episode, rows)
        threading.Thread(target=self._fill, args=(episode, self._pictures), name="pictures", daemon=True).start()

    def _build(self, episode: Episode, rows: list[Any]) -> None:
        gui = self._gui
        outcome = {True: "success", False: "failure", None: "not said"}[episode.success]
        facts = gui.add_html(
            markup.facts(
                [
                    ("episode", episode.episode_id or "no id"), ("instruction", episode.instruction),
                    ("outcome", outcome), ("steps", len(episode)), ("robot", episode.robot or "not said"),
                    ("bag", str(episode.metadata.get("file_path", "not said"))),
                ],
                "dataset-episode",
            )
        )  # fmt: skip
        slider: Any = gui.add_slider("Step", min=0, max=max(1, len(episode) - 1), step=1, initial_value=0)
        slider.on_update(lambda event: self.step(int(event.target.value)) if event.client else None)
        self._folder = gui.add_folder("Pictures")
        curves = gui.add_folder("Plots")
        with curves:
            for plot in _plots(episode, rows):
                gui.add_uplot(plot.data(), plot.series(), title=plot.title, height=170)
        self._own = [facts, slider, self._folder, curves]

    def step(self, number: int) -> None:
        """Show the pictures of a step that have come."""
        with self._lock:
            for name, image in self._pictures.at(number).items():
                if name in self._images:
                    self._images[name].image = image
                else:
                    with self._folder:
                        self._images[name] = self._gui.add_image(image, label=name, jpeg_quality=85)

    def _fill(self, episode: Episode, pictures: Pictures) -> None:
        try:
            for step in episode.steps(cameras=tuple(episode.cameras)):
                pictures.add(step.index, {name: _scaled(image) for name, image in step.images.items()})
                if step.index == 0 and self._pictures is pictures:
                    self.step(0)
        except RoboximError as error:
            self._site.tell(alert=str(error))
        finally:
            pictures.complete.set()


def _scaled(image: Any) -> Any:
    factor = LARGEST_PX / max(image.shape[:2])
    if factor >= 1.0:
        return image
    return cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)


def _plots(episode: Episode, rows: list[Any]) -> list[Plot]:
    """Return the curves of the action and of every observed vector with at most as many parts as there are colours."""
    found = []
    actions = np.array([row.action for row in rows], dtype=float)
    vectors = {"action": (tuple(str(n) for n in range(actions.shape[1])), actions)} if actions.ndim == 2 else {}
    for name, parts in episode.vectors.items():
        vectors[name] = (tuple(parts), np.array([row.proprio[name] for row in rows], dtype=float))
    for name, (parts, values) in vectors.items():
        for first in range(0, values.shape[1], len(COLOURS)):
            some = slice(first, first + len(COLOURS))
            found.append(Plot(title=name, names=parts[some], values=tuple(values[:, some].T)))
    return found
