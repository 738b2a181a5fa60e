"""Forms of the editor: the selected object, roles and instruction, cameras, light and room."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_core.specs import CameraSpec, MaterialSpec, Scalar
from roboxim_core.vision.textures import ROOM_TEXTURES
from roboxim_studio.editing import document as edits
from roboxim_studio.editing.desk import Desk
from roboxim_studio.panels.pictures import show_pictures
from roboxim_tasks.fixed_scene import FixedTask
from roboxim_tasks.skills import SKILLS

DEFAULT = "default"
ROOM_M = 0.14
"""Distance of a new object from the others [m]."""
NEW_CAMERA = CameraSpec(
    name="camera", pose=Pose(position=(1.1, 0.0, 0.6), quat_xyzw=(-0.6279630, -0.6279630, 0.3250576, 0.3250576))
)
"""A camera in front of the table that looks at its middle."""


class Editor(Protocol):
    """What forms need of the editor."""

    library: ModelLibrary
    desk: Desk | None

    def edit(self, change: Callable[[FixedTask], FixedTask]) -> None:
        """Make an edit."""
        ...

    def select(self, name: str) -> None:
        """Select by name."""
        ...


def by_person(act: Callable[[Any], object]) -> Callable[[Any], None]:
    """Return a callback for values that a person sets; those that the studio sets itself change nothing.

    A page may send a value that the list of an input does not have, e.g. the name of a file: it changes nothing either.
    """

    def called(event: Any) -> None:
        value = event.target.value
        if event.client is not None and value in getattr(event.target, "options", (value,)):
            act(value)

    return called


class ObjectForm:
    """Adds objects; moves, turns, colours and scales the selected one."""

    def __init__(self, gui: Any, editor: Editor) -> None:
        """Build the form in the current container."""
        self._gui, self._editor = gui, editor
        self._fresh: list[Any] = []
        self.folder = gui.add_folder("Objects")
        with self.folder:
            self._model = gui.add_dropdown("Model", editor.library.object_ids, initial_value="cube")
            add = gui.add_button("Add")
        add.on_click(lambda _: self.add(str(self._model.value)))

    def add(self, model: str) -> None:
        """Add an object where there is room, and select it."""
        desk = self._editor.desk
        assert desk is not None
        taken = {entity.name for entity in desk.scene.entities}
        place = free_place([entity.pose.position[:2] for entity in desk.scene.entities])
        self._editor.edit(lambda document: edits.added(document, model, self._editor.library, place))
        new = [entity.name for entity in desk.scene.entities if entity.name not in taken]
        if new:
            self._editor.select(new[0])

    def show(self, name: str) -> None:
        """Show the numbers and the modifiers of an entity; nothing for others."""
        desk = self._editor.desk
        assert desk is not None
        for handle in self._fresh:
            handle.remove()
        self._fresh = []
        entity = next((one for one in desk.scene.entities if one.name == name), None)
        if entity is None:
            return
        yaw = math.degrees(math.atan2(*_yaw(entity.pose)))
        with self.folder:
            place = self._gui.add_vector3("x, y, z [m]", initial_value=entity.pose.position, step=0.001)
            turn = self._gui.add_number("yaw [deg]", initial_value=round(yaw, 3), step=1.0)
            self._fresh = [place, turn]
            for kind, model in self._editor.library.object_modifiers(entity.model).items():
                self._fresh.append(self._modifier(name, kind, model, entity.modifiers.get(kind)))
        place.on_update(by_person(lambda value: self._move(name, position=tuple(map(float, value)))))
        turn.on_update(by_person(lambda value: self._move(name, yaw_deg=float(value))))

    def _modifier(self, name: str, kind: str, model: Any, value: Scalar | None) -> Any:
        library = self._editor.library

        def change(new: Scalar | None) -> None:
            self._editor.edit(lambda document: edits.modified(document, name, kind, new, library))

        if isinstance(model.default, float | int) and not isinstance(model.default, bool):
            now = float(model.default if value is None else value)
            handle = self._gui.add_number(kind, initial_value=now, min=model.lower, max=model.upper, step=0.01)
            handle.on_update(by_person(lambda new: change(float(new))))
            return handle
        words = (DEFAULT, *model.words(kind))
        handle = self._gui.add_dropdown(kind, words, initial_value=DEFAULT if value is None else str(value))
        handle.on_update(by_person(lambda new: change(None if new == DEFAULT else str(new))))
        return handle

    def _move(self, name: str, *, position: tuple[float, ...] | None = None, yaw_deg: float | None = None) -> None:
        def change(document: FixedTask) -> FixedTask:
            pose = document.fixed.scene.entity(name).pose
            if position is not None:
                x, y, z = position
                pose = Pose(position=(x, y, z), quat_xyzw=pose.quat_xyzw)
            if yaw_deg is not None:
                turn = math.radians(yaw_deg) - math.atan2(*_yaw(pose))
                about = Pose(quat_xyzw=(0.0, 0.0, math.sin(turn / 2), math.cos(turn / 2)))
                turned = about @ Pose(quat_xyzw=pose.quat_xyzw)
                pose = Pose(position=pose.position, quat_xyzw=turned.quat_xyzw)
            return edits.moved(document, name, pose)

        self._editor.edit(change)


def free_place(taken: Sequence[Sequence[float]]) -> tuple[float, float]:
    """Return the place nearest to the workspace's middle that is `ROOM_M` from all others, else the farthest one.

    Args:
        taken: Places of the objects, x and y [m].
    """
    places = [(x / 100, y / 100) for x in range(36, 66, 4) for y in range(-28, 32, 4)]
    places.sort(key=lambda place: math.dist(place, (0.5, 0.0)))
    rooms = [min((math.dist(place, other) for other in taken), default=math.inf) for place in places]
    wide = next((place for place, room in zip(places, rooms, strict=True) if room >= ROOM_M), None)
    return wide or places[rooms.index(max(rooms))]


def _yaw(pose: Pose) -> tuple[float, float]:
    """Return sine and cosine of a pose's rotation about the vertical."""
    axis = pose.apply((1.0, 0.0, 0.0)) - np.array(pose.position)
    return float(axis[1]), float(axis[0])


class RolesForm:
    """Who is the task's target, and what the instruction says."""

    def __init__(self, gui: Any, editor: Editor) -> None:
        """Build the form in the current container."""
        self._gui, self._editor = gui, editor
        assert editor.desk is not None
        document = editor.desk.document
        self.folder = gui.add_folder("Task", expand_by_default=False)
        names = tuple(entity.name for entity in document.fixed.scene.entities)
        with self.folder:
            self._instruction = gui.add_text("Instruction", initial_value=document.fixed.instruction)
            self._roles = {
                role: gui.add_dropdown(role, names, initial_value=document.fixed.roles[role])
                for role in SKILLS[document.skill].roles
                if role in document.fixed.roles
            }
        self._instruction.on_update(
            by_person(lambda text: editor.edit(lambda document: edits.with_instruction(document, str(text))))
        )
        for role, handle in self._roles.items():
            handle.on_update(by_person(self._giving(role)))

    def _giving(self, role: str) -> Callable[[Any], None]:
        return lambda name: self._editor.edit(lambda document: edits.with_role(document, role, str(name)))

    def follow(self) -> None:
        """Show what the document says."""
        assert self._editor.desk is not None
        fixed = self._editor.desk.document.fixed
        names = tuple(entity.name for entity in fixed.scene.entities)
        if self._instruction.value != fixed.instruction:
            self._instruction.value = fixed.instruction
        for role, handle in self._roles.items():
            if tuple(handle.options) != names:
                handle.options = names
            if handle.value != fixed.roles[role]:
                handle.value = fixed.roles[role]


class CamerasForm:
    """Adds cameras, sets their field of view, and shows what they see."""

    def __init__(self, gui: Any, editor: Editor) -> None:
        """Build the form in the current container."""
        self._gui, self._editor = gui, editor
        self.folder = gui.add_folder("Cameras")
        self._fresh: dict[str, Any] = {}
        self._images: dict[str, Any] = {}
        with self.folder:
            add = gui.add_button("Add a camera")
        add.on_click(lambda _: self.add())
        self.follow()

    def add(self) -> None:
        """Add a camera in front of the table, and select it."""
        desk = self._editor.desk
        assert desk is not None
        names = {camera.name for camera in desk.scene.cameras}
        name = next(f"camera_{n}" for n in range(1, len(names) + 2) if f"camera_{n}" not in names)
        self._editor.edit(lambda document: edits.with_camera(document, replace(NEW_CAMERA, name=name)))
        self._editor.select(f"camera {name}")

    def follow(self) -> None:
        """Show what the document says."""
        desk = self._editor.desk
        assert desk is not None
        cameras = {camera.name: camera for camera in desk.scene.cameras}
        for name in [name for name in self._fresh if name not in cameras]:
            self._fresh.pop(name).remove()
            if name in self._images:
                self._images.pop(name).remove()
        for name, camera in cameras.items():
            degrees = round(math.degrees(2 * math.atan(camera.height / 2 / camera.matrix[1])), 3)
            if name in self._fresh:
                if self._fresh[name].value != degrees:
                    self._fresh[name].value = degrees
                continue
            with self.folder:
                handle = self._gui.add_number(f"{name}: field of view [deg]", degrees, min=5.0, max=150.0, step=1.0)
            handle.on_update(by_person(self._widening(name)))
            self._fresh[name] = handle

    def _widening(self, name: str) -> Callable[[Any], None]:
        def widen(degrees: Any) -> None:
            def change(document: FixedTask) -> FixedTask:
                camera = next(one for one in document.fixed.scene.cameras if one.name == name)
                return edits.with_camera(
                    document, replace(camera, fov_y_rad=math.radians(float(degrees)), intrinsics=())
                )

            self._editor.edit(change)

        return widen

    def show(self, images: Mapping[str, npt.NDArray[np.uint8]]) -> None:
        """Show pictures."""
        known = {name: image for name, image in images.items() if name in self._fresh}
        show_pictures(self._gui, self.folder, self._images, known)


class RoomForm:
    """Lights, and the materials of table, floor and wall."""

    def __init__(self, gui: Any, editor: Editor) -> None:
        """Build the form in the current container."""
        self._gui, self._editor = gui, editor
        self.folder = gui.add_folder("Light and room", expand_by_default=False)
        assert editor.desk is not None
        look = editor.desk.scene.look
        self._set: list[tuple[Any, Callable[[Any], Any]]] = []
        with self.folder:
            for number in range(len(look.lights)):
                self._light(number)
            for surface in ("table", "floor", "wall"):
                self._surface(surface)

    def _bind(self, handle: Any, read: Callable[[Any], Any], change: Callable[[Any, Any], Any]) -> None:
        """Let a handle show a part of the look, and change it.

        Args:
            handle: The input.
            read: Returns its value of a look.
            change: Returns a look with another value.
        """
        self._set.append((handle, read))
        handle.on_update(
            by_person(
                lambda value: self._editor.edit(
                    lambda document: edits.with_look(document, change(document.fixed.scene.look, value))
                )
            )
        )

    def _light(self, number: int) -> None:
        assert self._editor.desk is not None
        light = self._editor.desk.scene.look.lights[number]

        def with_light(look: Any, **changed: Any) -> Any:
            lights = tuple(replace(one, **changed) if n == number else one for n, one in enumerate(look.lights))
            return replace(look, lights=lights)

        title = f"{light.kind} {number + 1}"
        intensity = self._gui.add_slider(f"{title}: intensity", 0.0, 8.0, 0.05, min(8.0, light.intensity))
        self._bind(
            intensity, lambda look: look.lights[number].intensity, lambda look, v: with_light(look, intensity=float(v))
        )
        colour = self._gui.add_rgb(f"{title}: colour", _bytes(light.color))
        self._bind(
            colour, lambda look: _bytes(look.lights[number].color), lambda look, v: with_light(look, color=_unit(v))
        )
        field = "direction" if light.kind == "sun" else "position"
        where = self._gui.add_vector3(f"{title}: {field}", getattr(light, field), step=0.05)
        self._bind(
            where,
            lambda look: getattr(look.lights[number], field),
            lambda look, v: with_light(look, **{field: tuple(map(float, v))}),
        )

    def _surface(self, name: str) -> None:
        assert self._editor.desk is not None
        material: MaterialSpec = getattr(self._editor.desk.scene.look, name)

        def with_material(look: Any, **changed: Any) -> Any:
            return replace(look, **{name: replace(getattr(look, name), **changed)})

        options = tuple(dict.fromkeys(("none", material.texture or "none", *ROOM_TEXTURES)))
        texture = self._gui.add_dropdown(f"{name}: texture", options, initial_value=material.texture or "none")
        self._bind(
            texture,
            lambda look: getattr(look, name).texture or "none",
            lambda look, v: with_material(look, texture="" if v == "none" else str(v)),
        )
        colour = self._gui.add_rgb(f"{name}: colour", _bytes(material.color))
        self._bind(
            colour, lambda look: _bytes(getattr(look, name).color), lambda look, v: with_material(look, color=_unit(v))
        )

    def follow(self) -> None:
        """Show what the document says."""
        assert self._editor.desk is not None
        look = self._editor.desk.scene.look
        for handle, read in self._set:
            value = read(look)
            if handle.value != value:
                handle.value = value


def _bytes(colour: tuple[float, float, float]) -> tuple[int, int, int]:
    red, green, blue = (round(255 * min(max(part, 0.0), 1.0)) for part in colour)
    return red, green, blue


def _unit(colour: tuple[int, int, int]) -> tuple[float, float, float]:
    red, green, blue = (round(part / 255, 4) for part in colour)
    return red, green, blue
