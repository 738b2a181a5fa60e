"""The line above pictures of episodes."""

from __future__ import annotations

import numpy as np

from roboxim_core.vision.cameras import load_camera
from roboxim_runs.episodes.caption import BAND_PX, captioned, directions


def test_the_compass_shows_the_robots_directions_in_the_picture() -> None:
    """The workspace camera stands opposite the robot: left is on the right, what is behind is nearer to the camera."""
    shown = directions(load_camera("workspace"))
    assert shown["left"][0] > 0 > shown["right"][0]
    assert shown["behind"][1] > 0 > shown["front"][1]


def test_the_line_is_above_the_picture_and_leaves_it_alone() -> None:
    picture = np.random.default_rng(0).integers(0, 255, (128, 640, 3), np.uint8)
    plain = captioned(picture, "Push the sponge to the left")
    compass = captioned(picture, "Push the sponge to the left", load_camera("workspace"))
    assert plain.shape == compass.shape == (128 + BAND_PX, 640, 3)
    assert np.array_equal(compass[BAND_PX:], picture)
    assert (plain[:BAND_PX, :400] < 100).any()
    assert not np.array_equal(plain[:BAND_PX], compass[:BAND_PX])


def test_a_long_instruction_stays_in_the_line() -> None:
    band = captioned(np.zeros((32, 400, 3), np.uint8), "Put the large green wooden block behind it " * 5)[:BAND_PX]
    assert (band[:, -8:] > 200).all()
