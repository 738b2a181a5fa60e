"""Encoded pictures of a dataset, decoded after a look at what they say of themselves."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image

from roboxim_core.errors import ErrorCode, InvalidRequestError, RecorderError
from roboxim_core.vision.images import decode_image
from roboxim_datasets.episode import ImageSize, RGBImage

MAX_PIXELS = 2**26
"""Pixels of an image: 8192 x 8192. A file of a few bytes can claim more than any memory holds."""
MAX_COMPONENTS = 2**16
"""Components of a vector."""
_ALWAYS_READ = 2**23  # pixels
_MAX_PIXELS_PER_BYTE = 1100  # pixels; PNG's deflate packs at most 1,032 bytes into one
_WIDE = ("I", "F")  # Pillow's modes of more than 8 bits a channel begin so


@dataclass(frozen=True, kw_only=True)
class PictureHead:
    """What an encoded picture says of itself."""

    size: ImageSize
    """Its size."""
    deep: bool
    """Whether it has more than 8 bits a channel, as depth images do."""
    alpha: bool = False
    """Whether it has an alpha channel, which is not read."""


def head_of(data: bytes) -> PictureHead:
    """Read the head of an encoded picture.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when it is no picture, or claims more than `MAX_PIXELS` or bytes hold.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of its size, which is checked here
            with Image.open(io.BytesIO(data), formats=("PNG", "JPEG", "WEBP", "BMP", "TIFF")) as picture:
                width, height, mode = picture.width, picture.height, picture.mode
                alpha = mode.endswith(("A", "a")) or "transparency" in picture.info
    except Exception as error:
        if isinstance(error, Image.DecompressionBombError):
            raise _bad(f"a picture claims more than {MAX_PIXELS} pixels") from None
        raise _bad(f"{len(data)} bytes that are no picture") from None
    if width * height > MAX_PIXELS:
        raise _bad(f"a picture claims {width} x {height} pixels; at most {MAX_PIXELS} are read")
    if width * height > max(_ALWAYS_READ, _MAX_PIXELS_PER_BYTE * len(data)):
        raise _bad(f"a picture claims {width} x {height} pixels, which its {len(data)} bytes cannot hold")
    return PictureHead(size=ImageSize(height=height, width=width), deep=mode.startswith(_WIDE), alpha=alpha)


def _head_of_size(data: bytes, expected: ImageSize | None) -> PictureHead:
    head = head_of(data)
    if expected is not None and expected != head.size:
        found, wanted = (f"{size.width} x {size.height}" for size in (head.size, expected))
        raise _bad(f"a picture has the size {found}, expected {wanted}")
    return head


def decoded(decode: Callable[[bytes, ImageSize], Any], data: bytes, expected: ImageSize, where: str) -> Any:
    """Decode a picture by `colour_picture` or `deep_picture`; an error says where it is.

    Raises:
        RecorderError: As these two.
    """
    try:
        return decode(data, expected)
    except RecorderError as error:
        raise _bad(f"{where}: {error}") from None


def colour_picture(data: bytes, expected: ImageSize | None = None) -> RGBImage:
    """Decode a picture of 8 bits a channel to RGB.

    Args:
        data: The encoded picture.
        expected: Its size, which is checked before memory is taken; None: any.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when it is no picture, too large, of another size, or has more than 8
            bits a channel.
    """
    if _head_of_size(data, expected).deep:
        raise _bad("a picture of 16 bits a channel, expected a colour image of 8")
    try:
        return decode_image(data)
    except InvalidRequestError as error:
        raise _bad(str(error)) from None


def deep_picture(data: bytes, expected: ImageSize) -> np.ndarray[tuple[int, ...], np.dtype[Any]]:
    """Decode a picture of one channel, of 16 bits or of float32 (TIFF), shape (height, width).

    Args:
        data: The encoded picture.
        expected: Its size, which is checked before memory is taken.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when it is no such picture, or of another size.
    """
    import cv2

    _head_of_size(data, expected)
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if picture is None or picture.ndim != 2 or picture.dtype not in (np.uint8, np.uint16, np.float32):
        raise _bad("an image of depth or segmentation is damaged")
    return picture if picture.dtype == np.float32 else np.asarray(picture, np.uint16)


def _bad(message: str) -> RecorderError:
    return RecorderError(message, ErrorCode.BAG_DAMAGED)
