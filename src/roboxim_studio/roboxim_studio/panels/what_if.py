"""The panel that continues an episode from a tick, and shows the other episode beside the first."""

from __future__ import annotations

import threading
from typing import Any

from roboxim_core.errors import RoboximError
from roboxim_core.models.library import ModelLibrary
from roboxim_studio.acting.lab import Lab
from roboxim_studio.acting.what_if import ACTORS, RECORDED, Question, first_difference, simulate
from roboxim_studio.bench import Bench
from roboxim_studio.episode.film import Film, ending
from roboxim_studio.look.scene_view import SceneView
from roboxim_studio.panels import markup
from roboxim_studio.panels.episode import EpisodePanel
from roboxim_studio.serving.site import Site

NOTHING = "nothing"
BESIDE_M = 1.7
"""Distance of the second view from the first [m]."""


class WhatIfPanel:
    """Asks what would have happened, and compares two episodes."""

    def __init__(self, site: Site, episode: EpisodePanel, bench: Bench, lab: Lab, library: ModelLibrary) -> None:
        """Build the panel in the current container; it stays hidden until an episode is opened."""
        self._site, self._gui, self._episode, self._bench, self._lab = site, site.viser.gui, episode, bench, lab
        self._beside = SceneView(site.viser, library, root="/beside", bare=True)
        self._cancel = threading.Event()
        self.other: Film | None = None
        """The episode that is shown beside; None: none is."""
        self.answer: Film | None = None
        """The newest answer: the other episode."""
        gui = self._gui
        self.folder = gui.add_folder("What if", expand_by_default=False, visible=False)
        with self.folder:
            self._actor = gui.add_dropdown("Then acts", (*ACTORS, *lab.policies), initial_value=ACTORS[1])
            self._moved: Any = gui.add_dropdown("Move", (NOTHING,), initial_value=NOTHING)
            self._by = gui.add_vector2("by x, y [m]", initial_value=(0.05, 0.0), step=0.005)
            self._without: Any = gui.add_dropdown("Without", (NOTHING,), initial_value=NOTHING)
            start = gui.add_button("Try from this tick")
            stop = gui.add_button("Stop")
            swap = gui.add_button("Open the other episode")
            self._message = gui.add_html("")
        start.on_click(lambda _: self.start())
        stop.on_click(lambda _: self._cancel.set())
        swap.on_click(lambda _: self._swap())
        episode.on_opened.append(self._opened)
        episode.on_shown.append(self._shown)

    def start(self) -> Any:
        """Ask from the tick that is shown, with what the panel says; returns the future answer."""
        film = self._episode.film
        if film is None:
            return None
        chosen = str(self._actor.value)
        moved, without = str(self._moved.value), str(self._without.value)
        x, y = self._by.value
        question = Question(
            tick=self._episode.tick, actor=chosen, moved="" if moved == NOTHING else moved,
            by_m=(float(x), float(y)), without="" if without == NOTHING else without,
        )  # fmt: skip
        self._cancel.clear()
        self._show_message("simulating ...")
        return self._bench.do(lambda: self._simulate(film, question))

    def compare(self, film: Film) -> None:
        """Show an episode beside the one that is open."""
        first = self._episode.film
        assert first is not None
        self.other = film
        self._beside.load(film.info.scene, offset_y_m=-BESIDE_M)
        differs = first_difference(first, film)
        where = "no tick differs" if differs is None else f"the first tick that differs is {differs}"
        if differs == min(len(first), len(film)):
            where = f"no tick differs until one of them ends, after tick {differs - 1}"
        self._show_message(
            f"beside: {film.title}\nit ends with {ending(film)} after {film.result.steps} actions; {where}"
        )
        self._shown(first, self._episode.tick)

    def hide(self) -> None:
        """Take the other episode out of the view."""
        self._beside.clear()
        self.other = None

    def _simulate(self, film: Film, question: Question) -> Film | None:
        try:
            actor = None if question.actor == RECORDED else self._lab.actor(question.actor)
            self.answer = simulate(
                self._lab.graph, film, question, actor, on_tick=lambda state, _: self._progress(state.seq),
                cancelled=lambda: self._cancel.is_set() or self._bench.stopping.is_set(),
            )  # fmt: skip
        except RoboximError as error:
            self._show_message(str(error), alert=True)
            return None
        if self._episode.film is film:
            self.compare(self.answer)
        return self.answer

    def _progress(self, seq: int) -> None:
        if seq % 5 == 0:
            self._show_message(f"simulating: tick {seq}")

    def _show_message(self, text: str, *, alert: bool = False) -> None:
        self._message.content = markup.paragraph(text, "what-if", alert=alert)

    def _opened(self, film: Film) -> None:
        names = tuple(entity.name for entity in film.info.scene.entities)
        self._moved.options = (NOTHING, *names)
        roles = {thing.entity for role, thing in film.info.task.objects.items() if role.startswith("distractor")}
        self._without.options = (NOTHING, *sorted(roles))
        self._beside.clear()
        self.other, self.answer = None, None
        self._show_message("")
        self.folder.visible = True

    def _shown(self, film: Film, seq: int) -> None:
        if self.other is not None:
            last = len(self.other) - 1
            self._beside.show(self.other.states[min(seq, last)], self.other.pictures.at(min(seq, last)))

    def _swap(self) -> None:
        """Open the other episode, with the first one beside it."""
        other, first = self.other, self._episode.film
        if other is None or first is None:
            return
        tick = self._episode.tick
        self._episode.open(other)
        self.compare(first)
        self._episode.show(tick)
