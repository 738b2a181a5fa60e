"""Encoding, decoding and resizing of images."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from roboxim_core.errors import InvalidRequestError
from roboxim_core.vision.images import decode_image, encode_image, resized


def picture(height: int = 48, width: int = 64) -> np.ndarray:
    """Return a smooth image whose channels differ, so that swapped channels are detected."""
    y, x = np.mgrid[:height, :width]
    return np.stack([4 * x % 256, 255 - 3 * y % 256, np.full_like(x, 40)], axis=-1).astype(np.uint8)


def test_png_keeps_every_pixel() -> None:
    assert np.array_equal(decode_image(encode_image(picture(), "png")), picture())


@pytest.mark.parametrize("encoding", ["jpeg", "png"])
def test_another_reader_sees_the_same_colours(encoding: str) -> None:
    data = encode_image(picture(), encoding)
    seen = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), float)
    assert np.abs(seen - picture()).max() <= 12
    assert np.abs(seen - decode_image(data)).max() <= 1


def test_jpeg_has_the_colours_in_full_resolution() -> None:
    """Check alternating red and blue columns, one pixel wide; chroma subsampling would make both purple."""
    stripes = np.zeros((16, 16, 3), np.uint8)
    stripes[:, ::2, 0] = stripes[:, 1::2, 2] = 255
    assert np.abs(decode_image(encode_image(stripes, "jpeg")).astype(int) - stripes).mean() < 10


def test_resizing_averages_and_does_not_alias() -> None:
    checker = (np.indices((128, 128)).sum(axis=0) % 2 * 255).astype(np.uint8)
    small = resized(np.repeat(checker[..., None], 3, axis=2), 37, 41)
    assert small.shape == (37, 41, 3)
    assert np.abs(small.astype(int) - 128).max() < 16


def test_encoding_at_another_size_is_resizing_and_encoding() -> None:
    assert encode_image(picture(), "png", (20, 30)) == encode_image(resized(picture(), 20, 30), "png")


@pytest.mark.parametrize(
    ("image", "encoding", "message"),
    [
        (picture(), "jpg", "did you mean 'jpeg'"),
        (picture().astype(float), "png", "must be uint8"),
        (picture()[..., :2], "png", "shape"),
    ],
)
def test_what_cannot_be_encoded_is_refused(image: np.ndarray, encoding: str, message: str) -> None:
    with pytest.raises(InvalidRequestError, match=message):
        encode_image(image, encoding)


@pytest.mark.parametrize("data", [b"", b"not an image", encode_image(picture(), "png")[:40]])
def test_bytes_that_are_not_an_image_are_refused(data: bytes) -> None:
    with pytest.raises(InvalidRequestError, match="not a JPEG or PNG"):
        decode_image(data)
