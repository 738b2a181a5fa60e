"""The panel that edits a scene: gizmo, objects, cameras, lights, room, roles; checks and YAML in step."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import RoboximError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_core.specs import CameraSpec
from roboxim_studio.acting.lab import Lab
from roboxim_studio.bench import Bench
from roboxim_studio.editing import document as edits
from roboxim_studio.editing.desk import Desk, file_to_save
from roboxim_studio.look.ghost import Ghost
from roboxim_studio.look.scene_view import SceneView, wxyz
from roboxim_studio.panels import markup
from roboxim_studio.panels.editor_forms import CamerasForm, ObjectForm, RolesForm, RoomForm
from roboxim_studio.serving.site import Site
from roboxim_studio.sharing import share_scene
from roboxim_tasks.fixed_scene import FixedTask

HINT = "Click an object to select it; drag its arrows and its ring"
NOTHING = "nothing"
CAMERA = "camera "
HAND = "start of the hand"
NO_PATH = np.empty((0, 3))


class EditorPanel:
    """Edits one task with a given scene."""

    def __init__(
        self, site: Site, view: SceneView, bench: Bench, lab: Lab, library: ModelLibrary, folder: Path
    ) -> None:
        """Build the panel in the current container; it stays hidden until a document is opened.

        Args:
            site: The page.
            view: The three-dimensional view.
            bench: Where checks run.
            lab: What they run with.
            library: Robots and objects.
            folder: Folder to save into.
        """
        self._site, self._view, self._gui, self._bench, self._lab = site, view, site.viser.gui, bench, lab
        self.library, self._folder = library, folder
        self.desk: Desk | None = None
        """The document with its checks."""
        self.selected = NOTHING
        """The entity, ``camera <name>`` or ``start of the hand`` that the gizmo moves."""
        self._gizmo: Any = None
        self.ghost = Ghost(site.viser, library, "/edit/planner")
        """What the planner sees, and the way of the tool in the expert's plan."""
        self._labels: list[Any] = []
        self._fresh: list[Any] = []
        self._lock = threading.RLock()
        self._images: dict[str, Any] = {}
        self.folder = self._gui.add_folder("Scene", visible=False)
        self.active = False
        """Whether the view shows the document."""

    # ---------------------------------------------------------------- opening

    def open(self, document: FixedTask) -> None:
        """Edit a document.

        Raises:
            RoboximError: When its models are unknown.
        """
        with self._lock:
            self._view.load(document.fixed.scene)
            self.desk = Desk(document, self.library, self._bench, self._lab)
            self.desk.on_change.append(self._changed)
            self.desk.on_checks.append(self._checked)
            self.desk.on_pictures.append(self._pictures)
            self.desk.on_plan.append(self._planned)
            for handle in self._fresh:
                handle.remove()
            self._fresh, self._images = [], {}
            with self.folder:
                self._build()
            self.folder.visible = self.active = True
            self.select(NOTHING)
            self._site.send(hint=HINT, alert="")
            self.desk.refresh()

    def close(self) -> None:
        """Edit nothing: the scene that the view is to show cannot be edited."""
        with self._lock:
            self.hide()
            self.desk = None
            for handle in self._fresh:
                handle.remove()
            self._fresh, self._images = [], {}
            self.folder.visible = False

    def hide(self) -> None:
        """Leave the view to another panel; the document stays."""
        self.active = False
        self.ghost.clear()
        self.select(NOTHING)
        for label in self._labels:
            label.remove()
        self._labels = []

    def show(self) -> None:
        """Take the view again."""
        if self.desk is not None:
            self.active = True
            self._view.load(self.desk.scene)
            self._checked()
            self._site.send(hint=HINT, alert="")
            self.desk.refresh()

    def _build(self) -> None:
        gui = self._gui
        assert self.desk is not None
        self._facts = gui.add_html("")
        self._findings = gui.add_html(markup.paragraph("checking ...", "findings"))
        steps = gui.add_button_group("Steps", ("Undo", "Redo", "Delete"))
        steps.on_click(lambda event: self._step(str(event.target.value)))
        self._choice: Any = gui.add_dropdown("Selected", self._names(), initial_value=NOTHING)
        self._choice.on_update(lambda event: self.select(str(event.target.value)) if event.client else None)
        shown: list[Any] = [self._facts, self._findings, steps, self._choice]
        self._object = ObjectForm(gui, self)
        self._roles = RolesForm(gui, self)
        self._cameras = CamerasForm(gui, self)
        self._room = RoomForm(gui, self)
        shown += [form.folder for form in (self._object, self._roles, self._cameras, self._room)]
        self._sees: Any = gui.add_checkbox("What the planner sees", initial_value=False, hint="Its collision shapes.")
        self._sees.on_update(lambda _: self._show_ghost())
        shown.append(self._sees)
        self._name = gui.add_text("Save as", initial_value="my_scene", hint=f"Into {self._folder.name}, as YAML")
        save = gui.add_button("Save")
        save.on_click(lambda _: self._save())
        html = gui.add_button("Write it as one HTML file")
        html.on_click(lambda _: self._share())
        shown.append(html)
        self._saved = gui.add_html("")
        yaml_folder = gui.add_folder("YAML", expand_by_default=False)
        with yaml_folder:
            self._yaml = gui.add_html("")
        self._fresh += [*shown, self._name, save, self._saved, yaml_folder]
        self._write()

    def _names(self) -> tuple[str, ...]:
        assert self.desk is not None
        scene = self.desk.scene
        entities = (entity.name for entity in scene.entities)
        return (NOTHING, *entities, *(f"{CAMERA}{camera.name}" for camera in scene.cameras), HAND)

    # ---------------------------------------------------------------- edits

    def edit(self, change: Callable[[FixedTask], FixedTask]) -> None:
        """Make an edit; one that is not possible is named, and nothing changes."""
        assert self.desk is not None
        self._site.send(alert="")
        if problem := self.desk.edit(change):
            self._site.send(alert=problem)

    def save(self, name: str) -> Path | None:
        """Save the document; returns the file, or None if it is not possible, which the panel says."""
        assert self.desk is not None
        try:
            file = self.desk.save(self._folder, name)
        except (RoboximError, OSError) as error:
            self._saved.content = markup.paragraph(str(error), "saved", alert=True)
            return None
        checks, warning = self.desk.checks, ""
        if checks.of != self.desk.document or checks.unfinished:
            warning = "\nit is still being checked; the panel will say whether generate and evaluate take it"
        elif not checks.valid:
            warning = "\nnot every constraint holds: generate and evaluate will refuse it"
        self._saved.content = markup.paragraph(
            f"saved as {file.name}, scene {edits.scene_hash(self.desk.document)}\n"
            f"roboxim generate --task {file.name}{warning}",
            "saved",
        )
        return file

    def share(self, name: str) -> Path | None:
        """Write the scene as one HTML file; returns it, or None if it is not possible, which the panel says."""
        assert self.desk is not None
        try:
            file = file_to_save(self._folder, name).with_suffix(".html")
            self.desk.own_files.require(file)
            share_scene(self.desk.document, self.desk.state(), self.library, file)
        except (RoboximError, OSError) as error:
            self._saved.content = markup.paragraph(str(error), "saved", alert=True)
            return None
        self._saved.content = markup.paragraph(f"written: {file.name}", "saved")
        return file

    def _share(self) -> None:
        self.share(str(self._name.value))

    def _save(self) -> None:
        self.save(str(self._name.value))

    def _step(self, what: str) -> None:
        assert self.desk is not None
        if what == "Undo":
            self.desk.undo()
        elif what == "Redo":
            self.desk.redo()
        elif self.selected.startswith(CAMERA):
            name = self.selected.removeprefix(CAMERA)
            self.select(NOTHING)
            self.edit(lambda document: edits.without_camera(document, name))
        elif self.selected not in (NOTHING, HAND):
            name = self.selected
            self.edit(lambda document: edits.removed(document, name))

    # ---------------------------------------------------------------- the gizmo

    def select(self, name: str) -> None:
        """Put the gizmo on an entity, a camera, or the start of the hand."""
        with self._lock:
            if self._gizmo is not None:
                self._gizmo.remove()
                self._gizmo = None
            if self.desk is None:
                return
            known = self._names()
            self.selected = name if name in known else NOTHING
            if self._choice.value != self.selected:
                self._choice.value = self.selected
            self._object.show(self.selected)
            pose = self._pose(self.selected)
            if pose is None or not self.active:
                return
            flat = self.selected in {entity.name for entity in self.desk.scene.entities}
            self._gizmo = self._site.viser.scene.add_transform_controls(
                "/edit/gizmo", scale=0.16, active_axes=(True, True, not flat), position=pose.position, wxyz=wxyz(pose),
                depth_test=False,
            )  # fmt: skip
            self._gizmo.on_update(self._dragged)

    async def _dragged(self, event: Any) -> None:
        """Follow the gizmo; the edit is made at the end of the drag. In the server's loop, so that order is kept."""
        pose = pose_of(event.target)
        name = self.selected
        if event.phase == "end":
            threading.Thread(target=self.drop, args=(name, pose), daemon=True).start()
        elif name != HAND and not name.startswith(CAMERA):
            self._view.place(name, pose)

    def drop(self, name: str, pose: Pose) -> None:
        """Put an entity, a camera or the hand where it was dragged to."""
        assert self.desk is not None
        if name == HAND:
            self._place_hand(pose)
        elif name.startswith(CAMERA):
            camera = self._camera(name.removeprefix(CAMERA))
            if camera is not None:
                parent = self._parent(camera)
                self.edit(lambda document: edits.with_camera(document, replace(camera, pose=parent.inverse() @ pose)))
        else:
            self.edit(lambda document: edits.moved(document, name, pose))

    def _place_hand(self, pose_tcp: Pose) -> None:
        """Let the robot start with its tool at a pose, if it can be there."""
        assert self.desk is not None
        robot, arm = self.desk.scene.robot, self.desk.arm()
        start = np.array(self.desk.state().robot.joint_positions)
        found = arm.ik_near(robot.pose.inverse() @ pose_tcp, start)
        if not found.converged or not arm.within_limits(found.joints, 0.0):
            self._site.send(alert="start_reachable: the arm cannot start with its tool there")
            self.select(HAND)
            return
        joints = tuple(float(value) for value in found.joints)
        self.edit(lambda document: edits.with_robot(document, replace(robot, joint_positions=joints)))

    def _pose(self, name: str) -> Pose | None:
        assert self.desk is not None
        scene = self.desk.scene
        if name == HAND:
            return self.desk.state().robot.pose_tcp_measured
        if name.startswith(CAMERA):
            camera = self._camera(name.removeprefix(CAMERA))
            return None if camera is None else self._parent(camera) @ camera.pose
        return next((entity.pose for entity in scene.entities if entity.name == name), None)

    def _camera(self, name: str) -> CameraSpec | None:
        assert self.desk is not None
        return next((camera for camera in self.desk.scene.cameras if camera.name == name), None)

    def _parent(self, camera: CameraSpec) -> Pose:
        """Return where in the world a camera's parent is."""
        assert self.desk is not None
        if camera.parent == "world":
            return Pose()
        whole = self._view.camera_pose(self.desk.scene, self.desk.state(), camera)
        return whole @ camera.pose.inverse()

    # ---------------------------------------------------------------- keeping in step

    def _changed(self) -> None:
        with self._lock:
            if self.desk is None:
                return
            self.ghost.show_path(NO_PATH)
            if self.active:
                try:
                    self._view.load(self.desk.scene)
                    self._view.show(self.desk.state())
                    self._show_ghost()
                except RoboximError as error:
                    self._site.send(alert=str(error))
                    return
            names = self._names()
            if tuple(self._choice.options) != names:
                self._choice.options = names
            self.select(self.selected)
            for form in (self._roles, self._cameras, self._room):
                form.follow()
            self._write()

    def _write(self) -> None:
        assert self.desk is not None
        document = self.desk.document
        self._facts.content = markup.facts(
            [
                ("instruction", document.fixed.instruction), ("skill", document.skill),
                ("scene hash", edits.scene_hash(document)),
            ],
            "scene-facts",
        )  # fmt: skip
        self._yaml.content = markup.pre(edits.as_yaml(document), "yaml")

    def _checked(self) -> None:
        with self._lock:
            if self.desk is None:
                return
            checks = self.desk.checks
            bad = bool(checks.findings or checks.error)
            self._findings.content = markup.paragraph(checks.text, "findings", alert=bad)
            for label in self._labels:
                label.remove()
            self._labels = []
            if not self.active:
                return
            places = {entity.name: entity.pose.position for entity in self.desk.scene.entities}
            for number, finding in enumerate(checks.findings):
                if finding.entity in places:
                    x, y, z = places[finding.entity]
                    label = self._site.viser.scene.add_label(f"/edit/finding_{number}", finding.constraint)
                    label.position = (x, y, z + 0.08 + 0.03 * number)
                    self._labels.append(label)

    def _planned(self, path: npt.NDArray[np.float64]) -> None:
        """Show the way of the tool in the expert's plan."""
        with self._lock:
            self.ghost.show_path(path if self.active else NO_PATH)

    def _show_ghost(self) -> None:
        """Show the planner's shapes, if that is wanted."""
        if self.desk is None or not self.active or not self._sees.value:
            self.ghost.hide_scene()
        else:
            self.ghost.show_scene(self.desk.scene, self.desk.state())

    def _pictures(self, images: Mapping[str, npt.NDArray[np.uint8]]) -> None:
        with self._lock:
            if self.desk is None or not self.active:
                return
            self._view.show(self.desk.state(), images)
            self._cameras.show(images)


def pose_of(handle: Any) -> Pose:
    """Return the pose of a gizmo."""
    w, x, y, z = (float(value) for value in handle.wxyz)
    px, py, pz = (float(value) for value in handle.position)
    norm = float(np.linalg.norm((w, x, y, z))) or 1.0
    return Pose(position=(px, py, pz), quat_xyzw=(x / norm, y / norm, z / norm, w / norm))
