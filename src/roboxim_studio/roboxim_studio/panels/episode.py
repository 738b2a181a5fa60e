"""The panel that scrubs an episode: pictures, conditions, plots, jumps, judging again."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from roboxim_core.errors import RoboximError
from roboxim_studio.background import program_ends, run_beside
from roboxim_studio.episode.film import Film, ending, marks
from roboxim_studio.episode.judgement import Judgement, judge, thresholds, with_thresholds
from roboxim_studio.look.scene_view import SceneView
from roboxim_studio.panels import markup
from roboxim_studio.panels.pictures import show_pictures
from roboxim_studio.panels.plots import plots_of
from roboxim_studio.serving.site import Site

SPEEDS = ("0.25x", "0.5x", "1x", "2x", "4x")
HINT = "Space: play or pause   , and . : one tick back or on"
REDRAW_S = 0.1
"""Period at which newly arrived pictures are shown."""


class EpisodePanel:
    """Shows one episode at a time."""

    def __init__(self, site: Site, view: SceneView) -> None:
        """Build the panel in the current container.

        Args:
            site: The page.
            view: The three-dimensional view.
        """
        self._site, self._view, self._gui = site, view, site.viser.gui
        self._lock = threading.RLock()
        self._playing = threading.Event()
        self._closed = threading.Event()
        self._hidden = False
        self.on_shown: list[Callable[[Film, int], None]] = []
        """Called with the episode and the tick that is shown now."""
        self.on_opened: list[Callable[[Film], None]] = []
        """Called with an episode that was opened."""
        self.film: Film | None = None
        """The episode."""
        self.judgement: Judgement | None = None
        """Its judgement, by the recorded thresholds or by others."""
        self.tick = 0
        """The tick that is shown."""
        self._shown_pictures: tuple[int, frozenset[str]] = (-1, frozenset())
        self.folder = self._gui.add_folder("Episode", visible=False)
        self._fresh: list[Any] = []
        run_beside(self._play, "player")

    # ---------------------------------------------------------------- opening

    def open(self, film: Film) -> None:
        """Show an episode from its first tick.

        Raises:
            RoboximError: When its scene or task is not known here, e.g. because a plug-in is missing.
        """
        judgement = judge(film.info.task, film.states)
        with self._lock:
            self._playing.clear()
            self._hidden = False
            self.folder.visible = True
            self._view.load(film.info.scene)
            self.film = None  # nothing is shown until every input of the new episode is there
            for handle in self._fresh:
                handle.remove()
            self._fresh = []
            with self.folder:
                self._build(film, judgement)
            self.film, self.judgement, self.tick = film, judgement, 0
            for listener in self.on_opened:
                listener(film)
            self.show(0)
        self._site.send(hint=HINT, alert="")

    def _build(self, film: Film, judgement: Judgement) -> None:
        gui, info = self._gui, film.info
        add = self._fresh.append
        add(
            gui.add_html(
                markup.facts(
                    [
                        ("instruction", info.task.instruction), ("skill", info.task.skill), ("actor", info.actor),
                        ("outcome", ending(film)), ("steps", film.result.steps),
                    ],
                    "episode-facts",
                )
            )
        )  # fmt: skip
        last = len(film) - 1
        self._slider: Any = gui.add_slider("Tick", min=0, max=max(last, 1), step=1, initial_value=0)
        self._slider.on_update(lambda event: self.show(int(event.target.value)) if event.client else None)
        buttons = gui.add_button_group("Go", ("First", "Back", "Play", "On", "Last"))
        buttons.on_click(lambda event: self._go(str(event.target.value)))
        self._speed = gui.add_dropdown("Speed", SPEEDS, initial_value="1x")
        for handle in (self._slider, buttons, self._speed):
            add(handle)
        jumps = _jumps(film, judgement)
        self._jump = gui.add_dropdown("Jump to", jumps, initial_value=jumps[0])
        self._jump.on_update(lambda event: self._jump_to(str(event.target.value)) if event.client else None)
        add(self._jump)
        self._state = gui.add_html("")
        add(self._state)
        self._lamps = gui.add_html("")
        add(self._lamps)
        self._images: dict[str, Any] = {}
        self._pictures = gui.add_folder("Cameras")
        add(self._pictures)
        self._build_judging(film)
        add(self._build_plots(film))

    def _build_judging(self, film: Film) -> None:
        folder = self._gui.add_folder("Judge again", expand_by_default=False)
        self._fresh.append(folder)
        with folder:
            self._numbers = {
                name: self._gui.add_number(name, initial_value=value, step=0.001)
                for name, value in thresholds(film.info.task).items()
            }
            button = self._gui.add_button("Judge with these thresholds")
            self._judged = self._gui.add_html("")
        button.on_click(lambda _: self.judge_again({name: float(item.value) for name, item in self._numbers.items()}))

    def _build_plots(self, film: Film) -> Any:
        folder = self._gui.add_folder("Plots", expand_by_default=False)
        with folder:
            for plot in plots_of(film):
                self._gui.add_uplot(plot.data(), plot.series(), title=plot.title, height=170)
        return folder

    # ---------------------------------------------------------------- scrubbing

    def show(self, seq: int) -> None:
        """Show a tick; one beyond the ends is the nearest."""
        with self._lock:
            film, judgement = self.film, self.judgement
            if film is None or judgement is None or self._hidden:
                return
            self.tick = seq = min(max(seq, 0), len(film) - 1)
            state, verdict = film.states[seq], judgement.verdicts[seq]
            images = film.pictures.at(seq)
            self._shown_pictures = (seq, frozenset(images))
            self._view.show(state, images)
            if int(self._slider.value) != seq:
                self._slider.value = seq
            outcome = "solved" if verdict.success else f"failed: {verdict.reason}" if verdict.failed else verdict.reason
            self._state.content = markup.facts(
                [
                    ("tick", f"{seq} of {len(film) - 1}, {state.stamp_ns / 1e9:.2f} s"), ("phase", _phase(film, seq)),
                    ("verdict", outcome), ("state hash", state.state_hash),
                    ("contacts", _contacts(state) or "none"),
                ],
                "tick-facts",
            )  # fmt: skip
            self._lamps.content = markup.lamps(judgement.lamps(seq))
            show_pictures(self._gui, self._pictures, self._images, images)
            for listener in self.on_shown:
                listener(film, seq)

    def judge_again(self, values: dict[str, float]) -> None:
        """Judge with other thresholds, and show what that changes; wrong values are named, and nothing changes."""
        with self._lock:
            film, before = self.film, self.judgement
            if film is None or before is None:
                return
            changed = {n: v for n, v in values.items() if v != thresholds(film.info.task)[n]}
            try:
                self.judgement = judge(with_thresholds(film.info.task, changed), film.states)
            except RoboximError as error:
                self._judged.content = markup.paragraph(str(error), "judged-again", alert=True)
                return
            recorded = film.verdicts
            last, was = self.judgement.verdicts[-1], recorded[-1]
            other = sum(new.success != old.success for new, old in zip(self.judgement.verdicts, recorded, strict=True))
            end = "success" if last.success else f"failure, {last.reason}"
            outcome = "success" if was.success else f"failure, {was.reason}"
            self._judged.content = markup.paragraph(
                f"with these thresholds: {end}\nrecorded: {outcome}\n"
                f"{other} of {len(recorded)} ticks are judged differently",
                "judged-again",
            )
            self._jump.options = _jumps(film, self.judgement)
            self.show(self.tick)

    def close(self) -> None:
        """End the player."""
        self._closed.set()
        self._playing.set()

    def hide(self) -> None:
        """Stop playing, because another panel uses the view."""
        self._playing.clear()
        self._hidden = True

    def show_again(self) -> None:
        """Take the view again."""
        with self._lock:
            self._hidden = False
            if self.film is not None:
                self._view.load(self.film.info.scene)
                self.show(self.tick)
                self._site.send(hint=HINT, alert="")

    # ---------------------------------------------------------------- keys and buttons

    def key(self, code: str) -> None:
        """Obey a key of the page."""
        action = {"Space": "Play", "Comma": "Back", "Period": "On"}.get(code)
        if action:
            self._go(action)

    def _go(self, where: str) -> None:
        if self.film is None:
            return
        if where == "Play":
            if self._playing.is_set():
                self._playing.clear()
            else:
                if self.tick == len(self.film) - 1:
                    self.show(0)
                self._playing.set()
            return
        self._playing.clear()
        last = len(self.film) - 1
        self.show({"First": 0, "Back": self.tick - 1, "On": self.tick + 1, "Last": last}[where])

    def _jump_to(self, entry: str) -> None:
        self._playing.clear()
        self.show(int(entry.partition(":")[0]))

    def _play(self) -> None:
        """Advance while playing; while not, show pictures that have come meanwhile."""
        due = time.monotonic()
        while not (self._closed.is_set() or program_ends()):
            film = self.film
            if film is None or not self._playing.is_set():
                self._playing.wait(REDRAW_S)
                if not self._closed.is_set():
                    self._late_pictures()
                due = time.monotonic()
                continue
            due += film.info.scene.tick_ns / 1e9 / float(self._speed.value.rstrip("x"))
            self._closed.wait(max(0.0, due - time.monotonic()))
            if self._playing.is_set() and self.film is film:
                self.show(self.tick + 1)
                if self.tick == len(film) - 1:
                    self._playing.clear()

    def _late_pictures(self) -> None:
        with self._lock:
            film = self.film
            if film is None or film.pictures.complete.is_set() and self._shown_pictures[0] == self.tick and (
                self._shown_pictures[1] or not film.pictures.data
            ):  # fmt: skip
                return
            if film.pictures.at(self.tick).keys() - self._shown_pictures[1]:
                self.show(self.tick)


def _jumps(film: Film, judgement: Judgement) -> tuple[str, ...]:
    return tuple(dict.fromkeys(f"{mark.seq}: {mark.name}" for mark in marks(film, judgement.verdicts)))


def _phase(film: Film, seq: int) -> str:
    """Return the phase of a tick, and who acted to reach it if several did."""
    phase = film.steps[seq].phase
    return f"{phase}, by {film.acted[seq - 1]}" if 0 < seq <= len(film.acted) else phase


def _contacts(state: Any) -> str:
    """Return the contacts of a tick, strongest first."""
    found: dict[tuple[str, str], float] = {}
    for contact in state.contacts:
        pair = (contact.body_a, contact.body_b)
        found[pair] = found.get(pair, 0.0) + contact.force_last
    ranked = sorted(found.items(), key=lambda item: -item[1])
    return ", ".join(f"{a} - {b} {force:.1f} N" for (a, b), force in ranked if force > 0)
