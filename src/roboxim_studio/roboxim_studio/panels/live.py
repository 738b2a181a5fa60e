"""The panel of a running graph: its scene, robot and cameras as they are now; edits between its episodes."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from roboxim_core.config_folders import config_names
from roboxim_core.errors import RoboximError
from roboxim_core.kinematics import Arms
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_core.seeds import PURPOSES, SeedPath
from roboxim_runs.episodes.task_choice import task_text
from roboxim_studio.acting.live import LiveGraph, Seen
from roboxim_studio.bench import Bench
from roboxim_studio.look.ghost import Ghost
from roboxim_studio.look.scene_view import SceneView, wxyz
from roboxim_studio.panels import markup
from roboxim_studio.panels.editor import NOTHING, EditorPanel, pose_of
from roboxim_studio.panels.editor_forms import by_person
from roboxim_studio.panels.pictures import show_pictures
from roboxim_studio.serving.site import Site

PERIOD_S = 0.05
"""Shortest time between two states that are drawn [s]."""
LOOK_S, IDLE_S = 1.0, 0.2
"""Longest time between two looks at whether the graph lives, and at whether a page looks [s]."""
GHOST = "What the planner sees"
GHOST_HINT = "Its collision shapes, and the arm at the end of the newest path; the path itself is the yellow line."
HINT = "Click an object, then drag it; between the graph's episodes only"


class LivePanel:
    """Shows one running graph."""

    def __init__(
        self, site: Site, view: SceneView, library: ModelLibrary, graph: LiveGraph, editor: EditorPanel
    ) -> None:
        """Build the panel in the current container.

        Args:
            site: The page.
            view: The three-dimensional view.
            library: Robots and objects.
            graph: The graph; the panel closes it.
            editor: Gives the edited scene.
        """
        self._site, self._view, self._library, self._editor = site, view, library, editor
        self.graph = graph
        """The graph."""
        self.seen: Seen | None = None
        """What is shown."""
        self.selected = NOTHING
        """The object that the gizmo moves."""
        self.ghost = Ghost(site.viser, library, "/live/planner")
        """What the graph's planner sees, and its newest path."""
        self._arms = Arms(library)
        self._ghost_of: tuple[object, ...] = ()
        self._calls = Bench()  # a slow service must not delay what is drawn
        self._lock = threading.RLock()
        self._active = threading.Event()
        self._closed = threading.Event()
        self._dragging = False
        self._gizmo: Any = None
        self._images: dict[str, Any] = {}
        gui = self._gui = site.viser.gui
        self.folder = gui.add_folder("Running graph", visible=False)
        with self.folder:
            self._facts = gui.add_html("")
            self._message = gui.add_html("")
            self._choice: Any = gui.add_dropdown("Selected", (NOTHING,), initial_value=NOTHING)
            self._place: Any = gui.add_vector3("x, y, z [m]", initial_value=(0.0, 0.0, 0.0), step=0.001, visible=False)
            self._model = gui.add_dropdown("Model", library.object_ids, initial_value="cube")
            acts = gui.add_button_group("Object", ("Add", "Delete"))
            scenes = gui.add_button_group("Scene", ("Reset", "Load the edited one"))
            tasks = gui.add_folder("A task's scene", expand_by_default=False)
            with tasks:
                self._task: Any = gui.add_dropdown("Task", tuple(config_names("tasks")), initial_value="pick_cube")
                self._purpose: Any = gui.add_dropdown("Purpose", PURPOSES, initial_value="demo")
                self._seed = gui.add_number("Seed", initial_value=0, min=0, step=1)
                self._index = gui.add_number("Index", initial_value=0, min=0, step=1)
                draw = gui.add_button("Draw and load")
            self.sees: Any = gui.add_checkbox(GHOST, initial_value=False, hint=GHOST_HINT)
            """Whether the planner's shapes are shown."""
            self._pictures = gui.add_folder("Cameras")
        self._choice.on_update(by_person(lambda name: self.select(str(name))))
        self._place.on_update(by_person(lambda place: self._typed(tuple(map(float, place)))))
        acts.on_click(lambda event: self.add() if event.target.value == "Add" else self.delete())
        scenes.on_click(lambda event: self.reset() if event.target.value == "Reset" else self.load_edited())
        draw.on_click(lambda _: self.draw())
        self._thread = threading.Thread(target=self._follow, name="live", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Leave the graph."""
        self._closed.set()
        self.graph.arrived.set()
        self._thread.join(timeout=60)
        self._calls.close(self.graph.close)

    # ---------------------------------------------------------------- looking

    def show(self) -> None:
        """Take the view."""
        with self._lock:
            self.seen = None
        self._active.set()
        self._site.send(hint=HINT, alert="")

    def hide(self) -> None:
        """Leave the view to another panel, and unsubscribe."""
        self._active.clear()
        with self._lock:
            self._remove_gizmo()
            self.ghost.clear()
            self._ghost_of = ()

    def _follow(self) -> None:
        """Draw what has come, at most once a period, while a page looks."""
        listening = False
        while not self._closed.is_set():
            if not self._active.is_set() or not self._site.pages:
                if listening:
                    self.graph.rest()
                    listening = False
                self._closed.wait(IDLE_S)
                continue
            try:
                if not listening:
                    self.graph.listen()
                    listening = True
                self.graph.arrived.wait(LOOK_S)
                self.graph.arrived.clear()
                self._draw_newest()
            except RoboximError as error:  # a model that is unknown here; the next scene may be known
                self._show_message(str(error), alert=True)
            self._closed.wait(PERIOD_S)

    def _draw_newest(self) -> None:
        if not self.graph.alive:
            self._show_message(f"the run '{self.graph.run.id}' has ended", alert=True)
            return
        seen = self.graph.seen()
        with self._lock:
            if seen is None or not self._active.is_set():
                return
            before, self.seen = self.seen, seen
            if before is None or before.scene != seen.scene:
                self._view.load(seen.scene)
                self._list(seen)
            self._view.show(seen.state, seen.images)
            self._follow_selected(seen)
            self._show_ghost(seen)
        self._facts.content = markup.facts(self._rows(seen), "live-facts")
        show_pictures(self._gui, self._pictures, self._images, seen.images)

    def _show_ghost(self, seen: Seen) -> None:
        """Show the newest path and, if wanted, what the planner sees; only what has changed is sent again."""
        scene, wanted = seen.scene, bool(self.sees.value)
        if wanted:
            self.ghost.show_scene(scene, seen.state)
        now = (seen.path, scene.robot, wanted)
        if now == self._ghost_of:
            return
        self._ghost_of, model = now, scene.robot.model
        if not wanted:
            self.ghost.hide_scene()
        self.ghost.show_joint_path(scene, self._arms[model], seen.path)
        if wanted and seen.path:
            opening = min(1.0, max(0.0, seen.state.robot.gripper_opening))
            self.ghost.show_arm(scene.robot.pose, model, seen.path[-1], opening)

    def _rows(self, seen: Seen) -> list[tuple[str, object]]:
        state, others = seen.state, self.graph.others
        rows: list[tuple[str, object]] = [
            ("run", f"{self.graph.run.id} (domain {self.graph.run.domain})"),
            ("newest episode", state.episode_id or "none"),
            ("tick", f"{state.seq}, {state.stamp_ns / 1e9:.2f} s{', disturbed' if state.disturbed else ''}"),
            ("state hash", state.state_hash),
        ]
        if others:
            rows.append(("other runs", ", ".join(f"{run.id} ({run.kind})" for run in others)))
        return rows

    def _list(self, seen: Seen) -> None:
        names = (NOTHING, *(entity.name for entity in seen.scene.entities))
        self._choice.options = names
        for name in [name for name in self._images if name not in {camera.name for camera in seen.scene.cameras}]:
            self._images.pop(name).remove()
        self.select(self.selected if self.selected in names else NOTHING)

    # ---------------------------------------------------------------- editing

    def select(self, name: str) -> None:
        """Put the gizmo on an object."""
        with self._lock:
            self._remove_gizmo()
            pose = self._pose(name)
            self.selected = NOTHING if pose is None else name
            if self._choice.value != self.selected:
                self._choice.value = self.selected
            self._place.visible = pose is not None
            if pose is None:
                return
            self._place.value = pose.position
            self._gizmo = self._site.viser.scene.add_transform_controls(
                "/live/gizmo", scale=0.16, position=pose.position, wxyz=wxyz(pose), depth_test=False
            )
            self._gizmo.on_update(self._dragged)

    def move(self, name: str, pose: Pose) -> Any:
        """Put an object somewhere; returns the future end."""
        return self._do(lambda: self.graph.move(name, pose))

    def add(self) -> Any:
        """Add an object of the chosen model above the table; returns the future name."""
        model = str(self._model.value)

        def spawn() -> str:
            found = self._library.object(model)
            top = self.seen.scene.table.center[2] if self.seen else 0.0
            return self.graph.spawn(model, Pose(position=(0.5, 0.0, top + found.rest_height)))

        return self._do(spawn)

    def delete(self) -> Any:
        """Remove the selected object; returns the future end."""
        name = self.selected
        if name == NOTHING:
            self._show_message("select an object first", alert=True)
            return None
        return self._do(lambda: self.graph.delete(name))

    def reset(self) -> Any:
        """Rebuild the scene as it was loaded; returns the future end."""
        return self._do(self.graph.reset)

    def load_edited(self) -> Any:
        """Load the scene of the editor; returns the future end."""
        desk = self._editor.desk
        if desk is None:
            self._show_message("no scene is being edited; draw one in 'Scene'", alert=True)
            return None
        scene = desk.scene
        return self._do(lambda: self.graph.load(scene))

    def draw(self) -> Any:
        """Let the graph draw a task's scene, and load it; returns the future end."""
        name = str(self._task.value)
        if name not in self._task.options:  # a page can name no other file
            return None

        def load() -> None:
            run_seed, purpose, index = int(self._seed.value), str(self._purpose.value), int(self._index.value)
            seed = SeedPath(run_seed=run_seed, purpose=purpose, index=index)
            task, scene = self.graph.draw(task_text(name), seed)
            self.graph.load(scene)
            self._show_message(task.instruction)

        return self._do(load)

    def _do(self, act: Callable[[], Any]) -> Any:
        """Call services one after another; an error is shown, and raised in the future."""

        def called() -> Any:
            self._show_message("")
            try:
                return act()
            except RoboximError as error:
                self._show_message(str(error), alert=True)
                raise

        return self._calls.do(called)

    def _typed(self, place: tuple[float, ...]) -> None:
        pose = self._pose(self.selected)
        if pose is not None:
            x, y, z = place
            self.move(self.selected, Pose(position=(x, y, z), quat_xyzw=pose.quat_xyzw))

    async def _dragged(self, event: Any) -> None:
        """Follow the gizmo; the service is called at the end of the drag."""
        pose, name = pose_of(event.target), self.selected
        self._dragging = event.phase != "end"
        if self._dragging:
            self._view.place(name, pose)
        else:
            self.move(name, pose)

    def _follow_selected(self, seen: Seen) -> None:
        """Keep the gizmo at its object."""
        pose = self._pose(self.selected)
        if self._gizmo is not None and pose is not None and not self._dragging:
            self._gizmo.position, self._gizmo.wxyz = pose.position, wxyz(pose)

    def _pose(self, name: str) -> Pose | None:
        entities = self.seen.state.entities if self.seen is not None else ()
        return next((entity.pose for entity in entities if entity.name == name), None)

    def _remove_gizmo(self) -> None:
        if self._gizmo is not None:
            self._gizmo.remove()
            self._gizmo = None
        self._dragging = False

    def _show_message(self, text: str, *, alert: bool = False) -> None:
        self._message.content = markup.paragraph(text, "live", alert=alert)
