"""Pictures of a request: which camera goes where, and how its picture is turned, cropped, resized and laid out.

The steps run in the order of `ImageInput`'s fields: turn, JPEG round trip, resize, centre crop, layout.
"""

from __future__ import annotations

import io
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from PIL import Image

from roboxim_core import limits
from roboxim_core.errors import InvalidRequestError
from roboxim_core.plain_data.closed_enum import ClosedEnum

Picture = npt.NDArray[np.uint8]


class Resize(ClosedEnum):
    """How a picture is brought to the size that the policy expects."""

    PAD = "pad"
    """Scale by PIL's bilinear filter so that the whole picture fits, and fill the rest with black bars.
    Source: `resize_with_pad` of openpi-client 0.1.2."""
    CROP = "crop"
    """Cut the largest centred part of the target's shape, then scale it by PIL's Lanczos filter."""
    LANCZOS3 = "lanczos3"
    """Stretch to the size by PIL's antialiasing Lanczos filter, as Octo and OpenVLA do (TensorFlow's ``lanczos3``)."""
    AREA = "area"
    """Stretch to the size by OpenCV's mean of areas (``INTER_AREA``)."""
    BILINEAR = "bilinear"
    """Stretch to the size by PIL's antialiasing bilinear filter."""
    NONE = "none"
    """Refuse a picture of another size."""


class Layout(ClosedEnum):
    """Order of a picture's axes."""

    HWC = "hwc"
    """(height, width, 3)."""
    CHW = "chw"
    """(3, height, width)."""


@dataclass(frozen=True, kw_only=True)
class ImageInput:
    """A camera whose picture the policy receives, RGB, uint8."""

    camera: str
    """RoboXim's camera, e.g. ``workspace``."""
    key: str
    """Key of the picture in the request, e.g. ``observation/image``."""
    width: int = 224
    """Width that the policy receives [px]."""
    height: int = 224
    """Height that the policy receives [px]."""
    render_width: int = 0
    """Width that the camera renders [px]; 0: as in the scene."""
    render_height: int = 0
    """Height that the camera renders [px]; 0: as in the scene."""
    mirror: bool = False
    """Whether left and right are exchanged. RoboXim's pictures are upright, as a camera sees the scene. Clients of
    LIBERO turn robosuite's raw pictures by 180 degrees; these are flipped from top to bottom, so the policies were
    trained on upright, mirrored ones."""
    upside_down: bool = False
    """Whether top and bottom are exchanged, as in robosuite's raw pictures (X-VLA's wrist camera)."""
    jpeg_quality: int = 0
    """Quality of a JPEG round trip before resizing, as for data stored as JPEG; 0: none."""
    resize: Resize = Resize.LANCZOS3
    """How the picture is brought to its size."""
    crop_area: float = 1.0
    """Part of the resized picture's area that a centred crop keeps; the rest is scaled up again. 0.9 is the crop that
    policies trained with random crops expect. 1: no crop."""
    layout: Layout = Layout.HWC
    """Order of the axes."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            InvalidRequestError: Naming the field and its range.
        """
        limits.require_name("camera", self.camera, topic=True)
        for name, minimum in (("width", 1), ("height", 1), ("render_width", 0), ("render_height", 0)):
            limits.require_range(f"{name} of image '{self.key}'", getattr(self, name), minimum, limits.IMAGE_PX)
        limits.require_range(f"jpeg_quality of image '{self.key}'", self.jpeg_quality, 0, 100)
        limits.require_range(f"crop_area of image '{self.key}'", self.crop_area, 0.01, 1.0)

    def prepare(self, picture: Picture) -> Picture:
        """Return a camera's picture as the policy receives it.

        Args:
            picture: RGB, uint8, shape (height, width, 3), upright.

        Returns:
            uint8, contiguous, shape (height, width, 3) or (3, height, width).

        Raises:
            InvalidRequestError: On any other array, or a size that ``resize: none`` refuses.
        """
        if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
            raise InvalidRequestError(
                f"the picture of camera '{self.camera}' must be uint8 of shape (height, width, 3), "
                f"got {picture.dtype} of shape {picture.shape}"
            )
        picture = self.turned(picture)
        if self.jpeg_quality:
            picture = _through_jpeg(picture, self.jpeg_quality)
        picture = self._cropped(self._resized(picture))
        if self.layout == Layout.CHW:
            picture = np.moveaxis(picture, 2, 0)
        return np.ascontiguousarray(picture)

    def turned(self, picture: Picture) -> Picture:
        """Return a picture, shape (height, width, 3), with its sides exchanged as the fields say; its own inverse."""
        picture = picture[:, ::-1] if self.mirror else picture
        return picture[::-1] if self.upside_down else picture

    def _resized(self, picture: Picture) -> Picture:
        height, width = picture.shape[:2]
        if (height, width) == (self.height, self.width):
            return picture
        kind = self.resize
        if kind == Resize.NONE:
            raise InvalidRequestError(
                f"image '{self.key}' must be {self.width} x {self.height} px, camera '{self.camera}' delivers "
                f"{width} x {height}; set render_width and render_height, or another kind of resizing than 'none'"
            )
        if kind == Resize.PAD:
            return _padded(picture, self.height, self.width)
        box: tuple[float, float, float, float] | None = None
        if kind == Resize.CROP:
            scale = min(width / self.width, height / self.height)
            box = _centred(width, height, self.width * scale, self.height * scale)
        elif kind == Resize.AREA:
            import cv2

            return np.asarray(cv2.resize(picture, (self.width, self.height), interpolation=cv2.INTER_AREA), np.uint8)
        elif kind == Resize.LANCZOS3:
            return _lanczos(picture, self.height, self.width)
        filter_ = Image.Resampling.BILINEAR if kind == Resize.BILINEAR else Image.Resampling.LANCZOS
        return np.asarray(Image.fromarray(picture).resize((self.width, self.height), filter_, box=box))

    def _cropped(self, picture: Picture) -> Picture:
        if self.crop_area == 1.0:
            return picture
        height, width = picture.shape[:2]
        side = math.sqrt(self.crop_area)
        box = _centred(width, height, width * side, height * side)
        return np.asarray(Image.fromarray(picture).resize((width, height), Image.Resampling.BILINEAR, box=box))


def _centred(width: float, height: float, new_width: float, new_height: float) -> tuple[float, float, float, float]:
    """Return the box (left, upper, right, lower) of a size in the middle of a picture [px]."""
    left, upper = (width - new_width) / 2, (height - new_height) / 2
    return max(left, 0.0), max(upper, 0.0), min(left + new_width, width), min(upper + new_height, height)


def _padded(picture: Picture, height: int, width: int) -> Picture:
    """Scale a picture to fit and paste it in the middle of a black one. Rounds as openpi-client does."""
    ratio = max(picture.shape[1] / width, picture.shape[0] / height)
    new_height, new_width = int(picture.shape[0] / ratio), int(picture.shape[1] / ratio)
    small = np.asarray(Image.fromarray(picture).resize((new_width, new_height), Image.Resampling.BILINEAR))
    above, left = (height - new_height) // 2, (width - new_width) // 2
    padded = np.zeros((height, width, 3), np.uint8)
    padded[above : above + new_height, left : left + new_width] = small
    return padded


def _through_jpeg(picture: Picture, quality: int) -> Picture:
    """Encode as a JPEG with chroma subsampling 4:2:0, and decode with the fast transform, as TensorFlow does."""
    import simplejpeg

    data = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(picture)).save(data, "JPEG", quality=quality)
    decoded: Picture = simplejpeg.decode_jpeg(data.getvalue(), fastdct=True, fastupsample=False)
    return decoded


def _lanczos(picture: Picture, height: int, width: int) -> Picture:
    """Resize with antialiasing in floating point, as TensorFlow does; Pillow's own integers differ by 2 grey levels."""
    channels = [
        np.asarray(Image.fromarray(channel).resize((width, height), Image.Resampling.LANCZOS))
        for channel in np.moveaxis(picture.astype(np.float32), 2, 0)
    ]
    return np.stack(channels, axis=2).round().clip(0, 255).astype(np.uint8)
