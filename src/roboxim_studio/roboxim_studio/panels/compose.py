"""The panel that composes tasks, draws them, lets the expert solve them, and counts what refuses their draws."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from roboxim_core.config import digest, named_config
from roboxim_core.config_folders import config_names
from roboxim_core.episode import Draw
from roboxim_core.errors import ConfigError, RoboximError, one_of
from roboxim_core.kinematics import ArmKinematics
from roboxim_core.seeds import PURPOSES, SeedPath
from roboxim_runs.episodes.task_choice import task_text
from roboxim_studio.acting.lab import Lab
from roboxim_studio.acting.take import take
from roboxim_studio.acting.what_if import EXPERT
from roboxim_studio.bench import Bench
from roboxim_studio.editing.desk import Desk, file_to_save, start_of
from roboxim_studio.editing.document import as_yaml, from_draw
from roboxim_studio.episode.film import Film, ending
from roboxim_studio.look.scene_view import SceneView
from roboxim_studio.own_files import OwnFiles
from roboxim_studio.panels import markup
from roboxim_studio.panels.editor import EditorPanel
from roboxim_studio.panels.editor_forms import by_person
from roboxim_studio.panels.task_form import TaskForm
from roboxim_studio.serving.site import Site
from roboxim_tasks.components import ResetContext
from roboxim_tasks.sequences.steps import is_sequence

COUNTED = 20
"""Scenes that are drawn to count refusals."""


class ComposePanel:
    """Draws episodes of a task as ``generate`` would."""

    def __init__(
        self, site: Site, view: SceneView, bench: Bench, lab: Lab, editor: EditorPanel, watch: Callable[[Film], None],
        folder: Path,
    ) -> None:  # fmt: skip
        """Build the panel in the current container.

        Args:
            site: The page.
            view: The three-dimensional view.
            bench: Where episodes run.
            lab: What they run with.
            editor: Where drawn scenes are edited.
            watch: Called with an episode that the expert has played.
            folder: Folder to save tasks into.
        """
        self._site, self._gui, self._view = site, site.viser.gui, view
        self._bench, self._lab, self._editor, self._watch = bench, lab, editor, watch
        self._cancel, self._saves, self._own = threading.Event(), folder, OwnFiles()
        self.drawn: Draw | None = None
        """The newest draw."""
        self._drawn_seed = SeedPath(run_seed=0, purpose="demo", index=0)
        self._desk: Desk | None = None
        """Where the newest draw is edited; none: it cannot be edited."""
        self.driven: Callable[[], bool] = lambda: False
        """Returns whether a person drives an episode: the view and the simulator are then its own."""
        gui = self._gui
        self.folder = gui.add_folder("Task", visible=False)
        with self.folder:
            self._task: Any = gui.add_dropdown("Draw from", tuple(config_names("tasks")), initial_value="pick_cube")
            self._purpose = gui.add_dropdown("Purpose", PURPOSES, initial_value="demo")
            self._seed = gui.add_number("Seed", initial_value=0, min=0, step=1)
            self._index: Any = gui.add_number("Index", initial_value=0, min=0, step=1)
            draw = gui.add_button("Draw")
            another = gui.add_button("Draw another")
            solve = gui.add_button("Solve with the expert")
            stop = gui.add_button("Stop")
            count = gui.add_button("How often is it refused?")
            self._message = gui.add_html("")
            self.form = TaskForm(gui, editor.library, lambda why: self._show_message(why, alert=True))
            self._name = gui.add_text("Save task as", initial_value="my_task", hint=f"Into {folder.name}, as YAML")
            save = gui.add_button("Save the task")
        draw.on_click(lambda _: self.draw())
        another.on_click(lambda _: self.draw(another=True))
        solve.on_click(lambda _: self.solve())
        stop.on_click(lambda _: self._cancel.set())
        count.on_click(lambda _: self.count())
        save.on_click(lambda _: self._save())
        self._task.on_update(by_person(lambda _: self._choose()))

    def open(self, task: str = "") -> Any:
        """Show a task and its first scene; returns the future draw.

        Args:
            task: Name in ``config/tasks``, or a file; empty: the default task.
        """
        self.folder.visible = True
        if task and (name := Path(task).stem) in self._task.options and named_config("tasks", name) == Path(task):
            task = name
        if task and task not in self._task.options:
            self._task.options = (*self._task.options, task)
        if task:
            self._task.value = task
        self._choose()
        return self.draw()

    def _choose(self) -> None:
        """Compose the chosen task."""
        try:
            self.form.open(task_text(self.chosen))
        except RoboximError as error:
            self._show_message(str(error), alert=True)

    @property
    def text(self) -> str:
        """YAML of the task that is drawn: the composed one, or the chosen one if it cannot be composed.

        Raises:
            ConfigError: When the chosen one is not in the list.
        """
        chosen = self.chosen
        return self.form.made.text if self.form.made is not None else task_text(chosen)

    def save(self, name: str) -> Path | None:
        """Save the task; returns the file, or None if it is not possible, which the panel says."""
        try:
            file = file_to_save(self._saves, name)
            self._own.write(file, f"# Made with roboxim studio.\n{self.text}")
        except (RoboximError, OSError) as error:
            self._show_message(str(error), alert=True)
            return None
        named, purpose = f"--task {file.name} --seed {self.seed.run_seed}", self.seed.purpose
        lines = [f"roboxim generate {named}"] if purpose == "demo" else []
        lines.append(f"roboxim tasks sample {named} --purpose {purpose}")
        self._show_message("\n".join([f"saved as {file.name}; the same scenes:", *lines]))
        return file

    @property
    def chosen(self) -> str:
        """Name or file of the chosen task: one of the list, since a page may name no other file.

        Raises:
            ConfigError: When it is none of the list.
        """
        task = str(self._task.value)
        if task not in self._task.options:
            raise ConfigError(f"no task '{task}' in the list; {one_of(self._task.options, task)}")
        return task

    @property
    def seed(self) -> SeedPath:
        """Seed path of the chosen episode."""
        return SeedPath(run_seed=int(self._seed.value), purpose=str(self._purpose.value), index=int(self._index.value))

    def draw(self, *, another: bool = False) -> Any:
        """Draw the episode of the chosen seed and index; ``another``: of the next index. Returns the future draw."""
        if another:
            self._index.value = int(self._index.value) + 1
        seed = self.seed
        self._show_message(f"drawing index {seed.index} ...")
        return self._bench.do(lambda: self._draw(seed))

    def solve(self) -> Any:
        """Let the expert play the drawn task, or the edited scene; returns the future episode."""
        desk, drawn = self._editor.desk, self.drawn
        if drawn is not None and desk is self._desk and not (desk is not None and desk.history.edited):
            seed = self._drawn_seed
            found: Draw | str = drawn
        elif desk is not None:
            seed, found = self.seed, as_yaml(desk.document)
        else:
            return None
        self._cancel.clear()
        self._show_message("planning ...")
        return self._bench.do(lambda: self._solve(found, seed))

    def count(self) -> Any:
        """Count what refuses draws of the chosen task; returns the future counts by constraint."""
        seed = self.seed
        self._cancel.clear()
        return self._bench.do(lambda: self._count(seed))

    def _save(self) -> None:
        self.save(str(self._name.value))

    def _draw(self, seed: SeedPath) -> Draw | None:
        try:
            self._require_free()
            drawn = self._lab.draw(self.text, seed)
            edited = None if is_sequence(drawn.task.skill) else from_draw(drawn)
        except RoboximError as error:
            self._show_message(str(error), alert=True)
            return None
        reset = self._lab.graph.tasks.generator.last_reset
        refused = _causes(reset) if reset else Counter()
        self._show_message(
            f"{drawn.task.instruction}\nindex {seed.index}, scene {digest(drawn.scene)}, "
            f"{sum(refused.values())} draws refused{': ' + _listed(refused) if refused else ''}"
            + ("" if edited else "\nThe scene of a task of several steps cannot be edited.")
        )
        if edited is not None:
            self._editor.open(edited)
        else:
            self._editor.close()
        self.drawn, self._drawn_seed, self._desk = drawn, seed, self._editor.desk
        self.show_again()
        return drawn

    def show_again(self) -> None:
        """Show the start of the newest draw, if nothing is edited: then it is one that cannot be edited."""
        if self.drawn is not None and self._editor.desk is None:
            scene = self.drawn.scene
            self._view.load(scene)
            self._view.show(start_of(scene, ArmKinematics(self._editor.library.robot(scene.robot.model))))

    def _require_free(self) -> None:
        """Refuse to take the view and the simulator from an episode that a person drives; on the bench.

        Raises:
            ConfigError: When there is one.
        """
        if self.driven():
            raise ConfigError("an episode is being driven; end it, or throw it away, before another scene is shown")

    def _solve(self, found: Draw | str, seed: SeedPath) -> Film | None:
        """Play a draw, or the task of a YAML text; on the bench."""
        try:
            self._require_free()
        except RoboximError as error:
            self._show_message(str(error), alert=True)
            return None
        self._editor.hide()
        try:
            draw = self._lab.draw(found, seed) if isinstance(found, str) else found
            self._view.load(draw.scene)

            def show(state: Any, step: Any) -> None:
                self._view.show(state, {n: seen.rgb for n, seen in self._lab.graph.sim.images.items()})
                if state.seq % 5 == 0:
                    self._show_message(f"the expert acts: tick {state.seq}, {step.verdict.reason or 'solved'}")

            film = take(
                self._lab.graph, draw, self._lab.actor(EXPERT), seed, on_tick=show,
                cancelled=lambda: self._cancel.is_set() or self._bench.stopping.is_set(),
            )  # fmt: skip
        except RoboximError as error:
            self._show_message(str(error), alert=True)
            self._editor.show()
            self.show_again()
            return None
        self._show_message(f"the expert: {ending(film)} after {film.result.steps} actions")
        self._watch(film)
        return film

    def _count(self, seed: SeedPath) -> Counter[str]:
        counts: Counter[str] = Counter()
        draws = failed = 0
        try:
            text = self.text
        except RoboximError as error:
            self._show_message(str(error), alert=True)
            return counts
        for done, index in enumerate(range(COUNTED), start=1):
            if self._cancel.is_set() or self._bench.stopping.is_set():
                break
            try:
                self._lab.draw(text, SeedPath(run_seed=seed.run_seed, purpose=seed.purpose, index=index))
            except ConfigError as error:
                self._show_message(str(error), alert=True)
                return counts
            except RoboximError:
                failed += 1
            reset = self._lab.graph.tasks.generator.last_reset
            if reset is not None:
                counts.update(_causes(reset))
                draws += reset.draws
            refused = sum(counts.values())
            share = f"{100 * refused / draws:.0f} % of {draws} draws" if draws else "no draw"
            causes = _listed(counts) or "no constraint refused a draw"
            self._show_message(f"{done} of {COUNTED} scenes: {share} refused, {failed} without a scene\n{causes}")
        return counts

    def _show_message(self, text: str, *, alert: bool = False) -> None:
        self._message.content = markup.paragraph(text, "composed", alert=alert)


def _causes(reset: ResetContext) -> Counter[str]:
    """Return how often each constraint refused a draw; with the cause where one is known."""
    found: Counter[str] = Counter()
    for constraint, count in reset.rejections.items():
        known = reset.causes.get(constraint, Counter())
        found.update({f"{constraint} ({cause})": number for cause, number in known.items()})
        if left := count - known.total():
            found[constraint] += left
    return found


def _listed(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in Counter(counts).most_common())
