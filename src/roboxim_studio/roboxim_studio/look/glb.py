"""The renderer's bodies as binary glTF, with the same meshes, materials and textures."""

from __future__ import annotations

from functools import lru_cache
from importlib import import_module
from typing import Any

import numpy as np

from roboxim_core.models.mesh_files import Stamp
from roboxim_core.specs import MaterialSpec
from roboxim_core.vision.renderer import RenderBody, VisualPart
from roboxim_core.vision.srgb import to_srgb
from roboxim_core.vision.textures import pixels, texture_stamp
from roboxim_sim.rendering.geometry import linear, textured

TEXTURE_PX = 256
"""Width and height of textures in the page [px]."""


def body_glb(body: RenderBody) -> bytes:
    """Return a body as GLB, in its own frame; bodies that share parts (in every scene: the robot's) share the bytes."""
    return _glb(body.parts, tuple(texture_stamp(part.material.texture) for part in body.parts))


@lru_cache(maxsize=256)
def _glb(parts: tuple[VisualPart, ...], _stamps: tuple[Stamp, ...]) -> bytes:
    trimesh: Any = import_module("trimesh")
    scene = trimesh.Scene()
    for number, part in enumerate(parts):
        scene.add_geometry(_mesh(part), geom_name=f"part_{number}")
    data = scene.export(file_type="glb", include_normals=True)
    assert isinstance(data, bytes)
    return data


def _mesh(part: VisualPart) -> Any:
    trimesh: Any = import_module("trimesh")  # untyped; imported here, since it takes 0.5 s

    material, mesh = part.material, part.mesh
    image = None
    if material.texture:
        mesh, image = textured(mesh), _image(material.texture, texture_stamp(material.texture))
    looks = trimesh.visual.material.PBRMaterial(
        baseColorFactor=[*(255 * linear(material.color)).round().astype(np.uint8), 255],
        metallicFactor=material.metallic,
        roughnessFactor=max(material.roughness, 0.05),
        baseColorTexture=image,
        name=_name(material),
    )
    uv = np.zeros((len(mesh.vertices), 2), np.float32) if mesh.uv is None else mesh.uv
    return trimesh.Trimesh(
        vertices=mesh.vertices, faces=mesh.faces, vertex_normals=mesh.normals, process=False,
        visual=trimesh.visual.TextureVisuals(uv=uv, material=looks),
    )  # fmt: skip


def _name(material: MaterialSpec) -> str:
    """Return a name without the machine's folders."""
    return material.texture.rpartition("/")[2] or "plain"


@lru_cache(maxsize=64)
def _image(name: str, _stamp: Stamp) -> Any:
    """Return a texture as a picture whose lowest row is at v = 0, as trimesh expects."""
    from PIL import Image

    picture = Image.fromarray(SRGB[pixels(name)][::-1])
    return picture.resize((TEXTURE_PX, TEXTURE_PX), Image.Resampling.LANCZOS)


SRGB = np.rint(255 * to_srgb((np.arange(256) / 255.0) ** 2)).astype(np.uint8)
"""Value of a renderer's texture, which is the square root of a linear one, to that of a picture, uint8."""
