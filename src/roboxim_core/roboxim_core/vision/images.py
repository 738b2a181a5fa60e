"""Images: encoding and decoding (OpenCV), resizing (Pillow).

`resized` resizes every image that is exported or fed to a network, so that training and evaluation use the same pixels.
It does not use OpenCV, whose interpolation aliases when it shrinks an image.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt
from PIL import Image

from roboxim_core.errors import InvalidRequestError, one_of

RgbImage = npt.NDArray[np.uint8]

JPEG_QUALITY = 95
PNG_COMPRESSION = 3
ENCODINGS = {"jpeg": ".jpg", "png": ".png"}
"""Name of an encoding to OpenCV's file suffix."""


def resized(image: RgbImage, height: int, width: int) -> RgbImage:
    """Resize an RGB image with an antialiasing Lanczos filter, as the training code of Octo and OpenVLA does.

    Args:
        image: uint8, shape (height, width, 3).
        height: New height [px].
        width: New width [px].
    """
    if image.shape[:2] == (height, width):
        return image
    return np.asarray(Image.fromarray(image).resize((width, height), Image.Resampling.LANCZOS))


def encode_image(image: RgbImage, encoding: str, size: tuple[int, int] | None = None) -> bytes:
    """Encode an RGB image.

    Args:
        image: uint8, shape (height, width, 3).
        encoding: ``jpeg`` (quality 95, no chroma subsampling) or ``png``.
        size: (height, width) to resize to; None keeps the size.

    Raises:
        InvalidRequestError: On an unknown encoding, or an array that is not an RGB image.
    """
    import cv2

    if encoding not in ENCODINGS:
        raise InvalidRequestError(f"unknown image encoding '{encoding}'; {one_of(ENCODINGS, encoding)}")
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise InvalidRequestError(
            f"an image must be uint8 of shape (height, width, 3), got {image.dtype} of shape {image.shape}"
        )
    bgr = cv2.cvtColor(image if size is None else resized(image, *size), cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(ENCODINGS[encoding], bgr, _parameters(encoding))
    if not done:
        raise InvalidRequestError(f"OpenCV cannot encode an image of shape {image.shape} as {encoding}")
    return bytes(data)


def decode_image(data: bytes) -> RgbImage:
    """Decode a JPEG or PNG image to RGB, uint8, shape (height, width, 3).

    Raises:
        InvalidRequestError: When the bytes are not an image.
    """
    import cv2

    as_stored = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION  # regardless of a camera's EXIF data
    image = cv2.imdecode(np.frombuffer(data, np.uint8), as_stored) if data else None
    if image is None:
        raise InvalidRequestError(f"{len(data)} bytes that are not a JPEG or PNG image")
    return np.asarray(image, np.uint8)


@cache
def _parameters(encoding: str) -> list[int]:
    """Return OpenCV's parameters of an encoding."""
    import cv2

    if encoding == "png":
        return [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION]
    sampling = (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)
    return [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, *sampling]
