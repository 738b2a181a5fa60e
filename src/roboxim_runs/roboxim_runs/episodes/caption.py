"""The caption of an episode's picture: its instruction, and a compass of the robot's directions."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from roboxim_core.specs import CameraSpec
from roboxim_core.vision.cameras import ideal_camera, project

RgbImage = npt.NDArray[np.uint8]

BAND_PX = 64
"""Height of the line [px]."""
COMPASS_PX = 150
"""Width of the compass [px]."""
ARROW_PX = 17.0
"""Length of the compass' longest arrow [px]."""
DIRECTIONS = {"left": (0.0, 1.0), "right": (0.0, -1.0), "behind": (1.0, 0.0), "front": (-1.0, 0.0)}
"""Word to the direction in the robot's base (x away from it, y to its left), as instructions mean it."""
CENTRE = (0.5, 0.0, 0.0)
"""Point of the table at which the directions are drawn [m]."""
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_INK, _PAPER = (25, 25, 25), 250


def captioned(picture: RgbImage, text: str, camera: CameraSpec | None = None) -> RgbImage:
    """Return a picture under a line with its instruction and, where it fits, the compass of a camera.

    Args:
        picture: uint8, shape (height, width, 3).
        text: The instruction.
        camera: Camera that took the picture, fixed in the world; None: no compass.
    """
    width = picture.shape[1]
    band = np.full((BAND_PX, width, 3), _PAPER, np.uint8)
    fixed = camera is not None and camera.parent == "world" and width >= 2 * COMPASS_PX
    room = width - (COMPASS_PX if fixed else 0) - 16
    (wide, _), _ = cv2.getTextSize(text, _FONT, 1.0, 1)
    scale = min(0.8, room / max(wide, 1))
    cv2.putText(band, text, (8, BAND_PX // 2 + round(11 * scale)), _FONT, scale, _INK, 1 + (scale > 0.6), cv2.LINE_AA)
    if fixed and camera is not None:
        draw_compass(band, camera, (width - COMPASS_PX // 2, BAND_PX // 2))
    return np.concatenate([band, picture], axis=0)


def draw_compass(image: RgbImage, camera: CameraSpec, centre: tuple[int, int]) -> None:
    """Draw where the robot's left, right, front and behind are in a camera's picture.

    Args:
        image: Is drawn on; uint8, shape (height, width, 3).
        camera: A camera fixed in the world.
        centre: Middle of the compass [px].
    """
    ends = directions(camera)
    scale = ARROW_PX / max(float(np.linalg.norm(end)) for end in ends.values())
    for word, end in ends.items():
        tip = np.array(centre) + scale * end
        cv2.arrowedLine(image, centre, _pixel(tip), _INK, 1, cv2.LINE_AA, tipLength=0.35)
        (wide, high), _ = cv2.getTextSize(word, _FONT, 0.4, 1)
        away = end / np.linalg.norm(end)
        corner = tip + away * (wide / 2 + 5, high / 2 + 5) + (-wide / 2, high / 2)
        cv2.putText(image, word, _pixel(corner), _FONT, 0.4, _INK, 1, cv2.LINE_AA)


def directions(camera: CameraSpec) -> dict[str, npt.NDArray[np.float64]]:
    """Return the robot's directions in a camera's picture: word to (right, down), of any common length."""
    steps = np.array([CENTRE, *((CENTRE[0] + 0.1 * x, CENTRE[1] + 0.1 * y, 0.0) for x, y in DIRECTIONS.values())])
    middle, *points = project(ideal_camera(camera), camera.pose.inverse().apply(steps))
    return {word: point - middle for word, point in zip(DIRECTIONS, points, strict=True)}


def _pixel(point: npt.NDArray[np.float64]) -> tuple[int, int]:
    return round(float(point[0])), round(float(point[1]))
