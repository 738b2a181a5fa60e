"""A scene and one of its states in the page.

The scene's bodies are sent once; a state moves them. A scene that differs in a few bodies, as while editing, sends only
those again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import viser

from roboxim_core.kinematics import Arms
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import ScenePoses, render_world
from roboxim_core.poses import Pose
from roboxim_core.specs import CameraSpec, LookSpec, SceneSpec, TableSpec
from roboxim_core.state import StateRecord
from roboxim_core.vision.renderer import RenderBody
from roboxim_studio.look.glb import body_glb

FORCE_M_PER_N = 0.02
"""Length of a contact's arrow [m/N]."""
LONGEST_ARROW_M = 0.25
FRUSTUM_M = 0.1
"""Depth of a camera's frustum in the page [m]."""
STATIC = ("table", "floor", "wall", "pedestal")


def wxyz(pose: Pose) -> tuple[float, float, float, float]:
    """Return a pose's rotation in the order of the page's library."""
    x, y, z, w = pose.quat_xyzw
    return w, x, y, z


class SceneView:
    """The three-dimensional part of the page. Call it from one thread at a time."""

    def __init__(
        self, server: viser.ViserServer, library: ModelLibrary, root: str = "/scene", bare: bool = False
    ) -> None:
        """Draw into a server's scene.

        Args:
            server: The server.
            library: Robots and objects.
            root: Name of the root node, so that two views can be side by side.
            bare: Whether to leave out what the other view shows: room, lights and directions.
        """
        self._bare = bare
        self._server, self._library, self._root = server, library, root
        self.scene: SceneSpec | None = None
        """The scene that is shown."""
        self._bodies: dict[str, tuple[RenderBody, Any]] = {}
        self._cameras: dict[str, tuple[CameraSpec, Any]] = {}
        self._lights: list[Any] = []
        self._look: LookSpec | None = None
        self._arrows: Any = None
        self._compass: list[Any] = []
        self._compass_of: tuple[Pose, TableSpec] | None = None
        self._poses: ScenePoses | None = None
        self._arms = Arms(library)
        self._frame = server.scene.add_frame(root, show_axes=False)
        self._objects_clicked: Callable[[str], None] | None = None

    def on_objects_clicked(self, call: Callable[[str], None]) -> None:
        """Call a function with an entity's name when its body is clicked; without it clicks move the view only."""
        self._objects_clicked = call
        for body, handle in self._bodies.values():
            self._listen(body, handle)

    def load(self, scene: SceneSpec, offset_y_m: float = 0.0, without: Collection[str] = ()) -> None:
        """Show a scene; bodies that it shares with the one before stay.

        Args:
            scene: The scene.
            offset_y_m: Shift of the whole view, to put a second one beside the first [m].
            without: Bodies of the room to leave out, e.g. ``table``.

        Raises:
            ConfigError: When a model, a texture or a camera's parent is unknown; the scene before then remains.
        """
        world = render_world(scene, self._library)
        self._poses = ScenePoses(scene, self._library, self._arms[scene.robot.model])
        self.scene = scene
        self._frame.position = (0.0, offset_y_m, 0.0)
        with self._server.atomic():
            out = {*without, *(("floor", "wall") if self._bare else ())}
            wanted = {body.key: body for body in world.bodies if body.parts and body.key not in out}
            for key in [key for key in self._bodies if key not in wanted]:
                self._bodies.pop(key)[1].remove()
            for key, body in wanted.items():
                self._show_body(key, body)
            self._show_cameras(scene.cameras)
            if scene.look != self._look and not self._bare:
                self._show_lights(scene.look)
            if not self._bare and self._compass_of != (scene.robot.pose, scene.table):
                self._show_compass(scene)

    def show(self, state: StateRecord, images: Mapping[str, npt.NDArray[np.uint8]] | None = None) -> None:
        """Show a state of the loaded scene.

        Args:
            state: The state.
            images: Camera to picture, uint8, shape (height, width, 3); cameras left out keep their last one.
        """
        assert self._poses is not None
        with self._server.atomic():
            for key, pose in self._poses.body_poses(state).items():
                if key in self._bodies:
                    self._place(self._bodies[key][1], pose)
            for name, pose in self._poses.camera_poses(state.robot).items():
                self._place(self._cameras[name][1], pose)
            for name, image in (images or {}).items():
                if name in self._cameras:
                    self._cameras[name][1].image = image
            self._show_contacts(state)

    def camera_pose(self, scene: SceneSpec, state: StateRecord, camera: CameraSpec) -> Pose:
        """Return the pose of a camera's optical frame in the world."""
        poses = ScenePoses(scene, self._library, self._arms[scene.robot.model])
        return poses.camera_poses(state.robot, (camera,))[camera.name]

    def place(self, key: str, pose: Pose) -> None:
        """Move one body, e.g. while it is dragged."""
        if key in self._bodies:
            self._place(self._bodies[key][1], pose)

    def clear(self) -> None:
        """Show nothing."""
        for _, handle in (*self._bodies.values(), *self._cameras.values()):
            handle.remove()
        self._bodies, self._cameras = {}, {}
        if self._arrows is not None:
            self._arrows.remove()
            self._arrows = None

    def hide_cameras(self, hidden: bool) -> None:
        """Show or hide the cameras' frusta."""
        for _, handle in self._cameras.values():
            handle.visible = not hidden

    @staticmethod
    def _place(handle: Any, pose: Pose) -> None:
        handle.position, handle.wxyz = pose.position, wxyz(pose)

    def _show_body(self, key: str, body: RenderBody) -> None:
        known = self._bodies.get(key)
        if known is not None:
            if known[0].parts == body.parts:  # parts compare by identity, and models are kept
                return
            known[1].remove()
        handle = self._server.scene.add_glb(
            f"{self._root}/bodies/{key.replace('/', '.')}", body_glb(body),
            cast_shadow=body.entity not in STATIC[1:3], receive_shadow=True,
        )  # fmt: skip
        self._listen(body, handle)
        self._bodies[key] = (body, handle)

    def _listen(self, body: RenderBody, handle: Any) -> None:
        clicked = self._objects_clicked
        if body.entity not in (*STATIC, "robot") and clicked is not None:
            handle.on_click(partial(_forward, clicked, body.entity))

    def _show_cameras(self, cameras: tuple[CameraSpec, ...]) -> None:
        wanted = {camera.name: camera for camera in cameras}
        for name in [name for name in self._cameras if self._cameras[name][0] != wanted.get(name)]:
            self._cameras.pop(name)[1].remove()
        for name, camera in wanted.items():
            if name in self._cameras:
                continue
            fy = camera.matrix[1]
            handle = self._server.scene.add_camera_frustum(
                f"{self._root}/cameras/{name}", fov=2 * math.atan(camera.height / 2 / fy),
                aspect=camera.width / camera.height, scale=FRUSTUM_M, thickness=0.002, color=(40, 90, 200),
                cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
            self._place(handle, camera.pose)
            self._cameras[name] = (camera, handle)

    def _show_lights(self, look: LookSpec) -> None:
        scene = self._server.scene
        for handle in self._lights:
            handle.remove()
        scene.configure_default_lights(False)
        scene.configure_environment_map(None, environment_intensity=0.0)
        ambient = np.array(look.ambient)
        strongest = float(ambient.max()) or 1.0
        self._lights = [
            scene.add_light_ambient(
                f"{self._root}/lights/ambient",
                color=tuple(np.rint(255 * ambient / strongest).astype(int).tolist()),
                intensity=strongest * math.pi * 0.8,
            )  # fmt: skip
        ]
        for number, light in enumerate(look.lights):
            red, green, blue = (round(255 * min(max(part, 0.0), 1.0)) for part in light.color)
            color = (red, green, blue)
            name = f"{self._root}/lights/{number}"
            if light.kind == "sun":
                way = np.array(light.direction) / np.linalg.norm(light.direction)
                self._lights.append(
                    scene.add_light_directional(
                        name,
                        color=color,
                        intensity=light.intensity,
                        position=tuple(-4.0 * way),
                        cast_shadow=light.shadow and number == 0,
                    )  # fmt: skip
                )
            else:
                reach = float(np.linalg.norm(light.position)) ** 2
                self._lights.append(
                    scene.add_light_point(
                        name,
                        color=color,
                        intensity=light.intensity * reach,
                        position=light.position,
                        decay=2.0,
                        cast_shadow=light.shadow and number == 0,
                    )  # fmt: skip
                )
        self._look = look

    def _show_contacts(self, state: StateRecord) -> None:
        """Draw the force on every object that something presses, at the object's origin."""
        points = []
        origins = {entity.name: np.array(entity.pose.position) for entity in state.entities}
        for contact in state.contacts:
            force = np.array(contact.force_on_b)
            for body, sign in ((contact.body_b, 1.0), (contact.body_a, -1.0)):
                if body in origins and contact.force_last > 0:
                    arrow = sign * force * FORCE_M_PER_N
                    length = float(np.linalg.norm(arrow))
                    if length > 1e-4:
                        points.append((origins[body], origins[body] + arrow * min(1.0, LONGEST_ARROW_M / length)))
        if self._arrows is not None:
            self._arrows.remove()
            self._arrows = None
        if points:
            self._arrows = self._server.scene.add_arrows(
                f"{self._root}/contacts", np.array(points, np.float32), colors=(230, 60, 40), shaft_radius=0.003,
                head_radius=0.008, head_length=0.02,
            )  # fmt: skip

    def _show_compass(self, scene: SceneSpec) -> None:
        """Write left, right, front and behind, as instructions mean them, beside the table."""
        for label in self._compass:
            label.remove()
        self._compass, self._compass_of = [], (scene.robot.pose, scene.table)
        base = scene.robot.pose
        half_x, half_y = scene.table.size[0] / 2 + 0.08, scene.table.size[1] / 2 + 0.08
        middle = base.inverse().apply(scene.table.center)
        for text, x, y in (
            ("left", 0.0, half_y), ("right", 0.0, -half_y), ("behind", half_x, 0.0), ("in front of", -half_x, 0.0),
        ):  # fmt: skip
            at = base.apply((middle[0] + x, middle[1] + y, 0.02))
            label = self._server.scene.add_label(f"{self._root}/compass/{text.replace(' ', '_')}", text)
            label.position = tuple(at)
            self._compass.append(label)


def _forward(clicked: Callable[[str], None], entity: str, _: object) -> None:
    """Call a function with the entity that was clicked; the page's event has no more to tell."""
    clicked(entity)
