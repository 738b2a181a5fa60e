"""Images from files as textures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from roboxim_core.errors import ConfigError
from roboxim_core.vision.textures import pixels

TOP_DARK = np.repeat(np.array([[40], [200]], np.uint8), 32, axis=0).repeat(64, axis=1)
"""Grey image, 64 x 64, whose upper half is dark."""


def test_an_image_of_16_bits_looks_as_one_of_8(tmp_path: Path) -> None:
    Image.fromarray(TOP_DARK).save(tmp_path / "8.png")
    Image.fromarray(TOP_DARK.astype(np.uint16) * 257).save(tmp_path / "16.png")
    assert np.array_equal(pixels(str(tmp_path / "16.png")), pixels(str(tmp_path / "8.png")))


def test_the_orientation_in_a_photo_is_heeded(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 3  # turned by 180 degrees
    Image.fromarray(TOP_DARK).save(tmp_path / "a.jpg", exif=exif)
    shown = pixels(str(tmp_path / "a.jpg"))
    assert shown[-1].mean() > shown[0].mean()  # the last row is the top


@pytest.mark.parametrize("name", ["a.png", "a.jpg"])
def test_an_image_that_ends_too_soon_is_named(name: str, tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    Image.fromarray(noise).save(tmp_path / name)
    content = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(content[: len(content) // 2])
    with pytest.raises(ConfigError, match=f"cannot read the texture .*{name}"):
        pixels(str(tmp_path / name))
