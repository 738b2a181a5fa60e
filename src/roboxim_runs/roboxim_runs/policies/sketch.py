"""Line sketches of a camera's view: table, robot, gripper, left and right.

Comparing the picture sent to a policy with the sketch of its training's view shows at once whether the picture is
mirrored or rotated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial.transform import Rotation

from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import ScenePoses
from roboxim_core.poses import Pose
from roboxim_core.rotation.representations import Floats
from roboxim_core.specs import CameraSpec, SceneSpec
from roboxim_core.state import StateRecord
from roboxim_core.vision.cameras import project

NEAREST_M = 0.03
"""Distance from the camera below which nothing is drawn [m]."""
AREA = ((0.3, -0.3), (0.8, -0.3), (0.8, 0.3), (0.3, 0.3))
"""Corners of the area on the table that is drawn: x, y in the robot's base [m]."""
GREY, BLACK, BLUE, RED = "#999999", "#222222", "#1f5fbf", "#c02020"


class Sketch:
    """Draws the lines of one scene as a camera sees them."""

    def __init__(self, scene: SceneSpec, state: StateRecord) -> None:
        """Compute the points that are drawn.

        Args:
            scene: The scene.
            state: The state of its robot.
        """
        self._poses = ScenePoses(scene, ModelLibrary())
        self._base, self._state = scene.robot.pose, state

    def draw(
        self, camera: CameraSpec, size: tuple[int, int], *, mirror: bool, upside_down: bool = False
    ) -> Image.Image:
        """Return a sketch of what a camera sees.

        Args:
            camera: The camera.
            size: Width and height [px].
            mirror: Whether left and right are exchanged.
            upside_down: Whether top and bottom are exchanged.
        """
        image = Image.new("RGB", size, "white")
        pen, seen = ImageDraw.Draw(image), self._pixels(camera, size, (mirror, upside_down))
        for start, end, colour, width in self._lines():
            steps = np.linspace(start, end, 40)
            pixels = [seen(point) for point in steps]
            for first, second in zip(pixels, pixels[1:], strict=False):
                if first is not None and second is not None:
                    pen.line([first, second], fill=colour, width=width)
        font = ImageFont.load_default(12)
        for text, point, colour in self._words():
            if (at := seen(np.array(point))) is not None:
                pen.text(at, text, colour, font, anchor="mm", stroke_width=3, stroke_fill="white")
        return image

    def _pixels(
        self, camera: CameraSpec, size: tuple[int, int], exchanged: tuple[bool, bool]
    ) -> Callable[[Floats], tuple[float, float] | None]:
        optical = self._poses.camera_poses(self._state.robot, (camera,))[camera.name].inverse()
        scale = np.array(size) / (camera.width, camera.height)

        def seen(point: Floats) -> tuple[float, float] | None:
            place = optical @ (self._base @ Pose.from_arrays(point, Rotation.identity()))
            if place.position[2] < NEAREST_M:
                return None
            u, v = project(camera, [place.position])[0] * scale
            return (size[0] - 1 - u if exchanged[0] else u), (size[1] - 1 - v if exchanged[1] else v)

        return seen

    def _lines(self) -> list[tuple[Floats, Floats, str, int]]:
        corners = [np.array([*corner, 0.0]) for corner in AREA]
        lines = [(a, b, GREY, 2) for a, b in zip(corners, [*corners[1:], corners[0]], strict=True)]
        lines += [(np.array([x, -0.3, 0.0]), np.array([x, 0.3, 0.0]), GREY, 1) for x in (0.4, 0.5, 0.6, 0.7)]
        lines += [(np.array([0.3, y, 0.0]), np.array([0.8, y, 0.0]), GREY, 1) for y in (-0.2, -0.1, 0.0, 0.1, 0.2)]
        hand, tip = self._hand()
        return [*lines, (np.zeros(3), np.array([0.0, 0.0, 0.35]), BLACK, 6), (hand, tip, BLACK, 5), *self._fingers()]

    def _hand(self) -> tuple[Floats, Floats]:
        """Return a point of the hand and the tool centre point, in the base."""
        tool = self._base.inverse() @ self._state.robot.pose_tcp_measured
        return np.array((tool @ Pose(position=(0.0, 0.0, -0.1))).position), np.array(tool.position)

    def _fingers(self) -> list[tuple[Floats, Floats, str, int]]:
        tool = self._base.inverse() @ self._state.robot.pose_tcp_measured
        ends = [[(tool @ Pose(position=(0.0, y, z))).position for z in (-0.05, 0.0)] for y in (-0.03, 0.03)]
        return [(np.array(a), np.array(b), BLACK, 4) for a, b in ends]

    def _words(self) -> Sequence[tuple[str, tuple[float, ...] | Floats, str]]:
        return (
            ("robot", (0.0, 0.0, 0.4), BLACK), ("gripper", self._hand()[1], BLACK),
            ("robot's left", (0.5, 0.22, 0.0), BLUE), ("robot's right", (0.5, -0.22, 0.0), RED),
        )  # fmt: skip
