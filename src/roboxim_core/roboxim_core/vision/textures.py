"""Textures: a registry of procedural textures, and images from files.

Procedural textures are deterministic and need no files. A texture multiplies a material's colour. Pixels are square
roots of linear values, for which 8 bits suffice; a shader squares them. The renderer registers the room's textures, and
`models.textures` those of objects.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ConfigError, one_of
from roboxim_core.models.mesh_files import Stamp, mesh_stamp, read_scene
from roboxim_core.plain_data.pictures import file_of
from roboxim_core.registry import Registry
from roboxim_core.vision.srgb import to_linear

if TYPE_CHECKING:
    import trimesh
    from PIL import Image

Field = npt.NDArray[np.float64]
Pixels = npt.NDArray[np.uint8]

SIZE = 512
"""Width and height of a texture [px]."""

TEXTURES: Registry[Callable[[], Field]] = Registry("texture")
"""Name to a function that returns linear factors 0..1, shape (SIZE, SIZE) or (SIZE, SIZE, 3); first row at v = 0."""

ROOM_TEXTURES = ("checker", "concrete", "fabric", "marble", "oak", "plaster", "speckle", "tiles", "wood")
"""Names of the textures of tables, floors and walls, which the renderer registers."""


def pixels(name: str) -> Pixels:
    """Return a texture's pixels, square roots of linear values, shape (SIZE, SIZE, 3), the first row at v = 0.

    They are kept; a file that has changed is read again.

    Args:
        name: A registered name; that of an image (`texture_name`); or ``<mesh file>#<geometry>``, for the base colour
            image of that geometry. Empty: white.

    Raises:
        ConfigError: When there is no such texture or image; the message lists the known ones.
    """
    return _pixels(name, texture_stamp(name))


def texture_stamp(name: str) -> Stamp:
    """Return times and sizes of a texture's files; empty for a registered name. Arguments as of `pixels`."""
    return mesh_stamp(file_of(name)[0]) if "/" in name else ()


@lru_cache(maxsize=64)
def _pixels(name: str, _stamp: Stamp) -> Pixels:
    if not name:
        factor = np.ones((SIZE, SIZE))
    elif "/" in name:
        factor = _linear(_image(name))[::-1]  # the first row of an image is its top, at v = 1
    else:
        factor = TEXTURES[name]()
    image = np.rint(255.0 * np.sqrt(np.clip(factor, 0.0, 1.0))).astype(np.uint8)
    # A grey texture is stored once, not for each channel.
    return np.ascontiguousarray(image) if image.ndim == 3 else np.broadcast_to(image[..., None], (SIZE, SIZE, 3))


def _image(name: str) -> Image.Image:
    from PIL import Image, ImageOps

    path, geometry = file_of(name)
    geometries: Mapping[str, Any] = {}
    try:
        if geometry:
            geometries = read_scene(path).geometry
            image = base_color_image(geometries[geometry]) if geometry in geometries else None
        else:
            image = ImageOps.exif_transpose(Image.open(path))
        if image is not None:
            image.load()
    except (OSError, ValueError, KeyError, SyntaxError, Image.DecompressionBombError) as error:  # SyntaxError: Pillow's
        raise ConfigError(f"cannot read the texture {name}: {error}") from None
    if geometry and geometry not in geometries:
        raise ConfigError(f"{path} has no geometry '{geometry}'; {one_of(geometries, geometry)}")
    if image is None:
        raise ConfigError(f"geometry '{geometry}' of {path} has no base colour image")
    return image


def base_color_image(mesh: trimesh.Trimesh) -> Image.Image | None:
    """Return the base colour image of a mesh; None if it has none."""
    from PIL import Image

    material = getattr(mesh.visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    return image if isinstance(image, Image.Image) else None


def _linear(image: Image.Image) -> Field:
    from PIL import Image

    if image.mode.startswith("I"):  # 16 bits, which Pillow clips to 8 instead of scaling
        image = Image.fromarray(np.rint(np.asarray(image) / 257).astype(np.uint8))
    srgb = np.asarray(image.convert("RGB").resize((SIZE, SIZE), Image.Resampling.LANCZOS), dtype=np.float64) / 255.0
    return to_linear(srgb)


def noise(seed: int, cells_x: float, cells_y: float) -> Field:
    """Return tileable smooth noise of zero mean and unit deviation, with about ``cells`` blobs per side."""
    white = np.random.Generator(np.random.PCG64(seed)).standard_normal((SIZE, SIZE))
    fx, fy = np.fft.fftfreq(SIZE, 1 / SIZE)[None, :], np.fft.fftfreq(SIZE, 1 / SIZE)[:, None]
    weight = np.exp(-((fx / cells_x) ** 2) - (fy / cells_y) ** 2)
    field = np.fft.ifft2(np.fft.fft2(white) * weight).real
    field -= field.mean()
    return np.asarray(field / field.std())


def grid() -> tuple[Field, Field]:
    """Return the texture coordinates 0..1 of the pixel centres (x right, y down)."""
    axis = (np.arange(SIZE) + 0.5) / SIZE
    x, y = np.meshgrid(axis, axis)
    return x, y


def rolled(field: Field, rows: npt.NDArray[np.int64]) -> Field:
    """Roll each row of a field by its own number of pixels."""
    columns = (np.arange(SIZE)[None, :] + rows[:, None]) % SIZE
    return np.asarray(field[np.arange(SIZE)[:, None], columns])
