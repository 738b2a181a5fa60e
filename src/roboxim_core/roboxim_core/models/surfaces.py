"""Colours and surfaces of mesh files, whose formats differ in what their numbers mean.

Colour factors and vertex colours of glTF are linear light; those of other formats are values of pictures (sRGB). A
surface here is one colour, one gloss and perhaps an image: textures of metalness and roughness become their mean, and
colours at vertices become parts of one colour each.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ConfigError
from roboxim_core.models.meshes import triangles
from roboxim_core.poses import Array
from roboxim_core.specs import MaterialSpec
from roboxim_core.vision.renderer import VisualPart
from roboxim_core.vision.srgb import to_linear, to_srgb
from roboxim_core.vision.textures import base_color_image

if TYPE_CHECKING:
    import trimesh

LINEAR_FORMATS = (".glb", ".gltf")
"""Formats whose colours are linear light."""
MOST_COLORS = 32
"""Most colours of a mesh with colours at its vertices or faces; more are joined by median cut."""


def is_linear(path: Path | str) -> bool:
    """Return whether the colours of a mesh file are linear light."""
    return Path(path).suffix.lower() in LINEAR_FORMATS


def visual_parts_of(mesh: trimesh.Trimesh, name: str, *, linear: bool) -> list[VisualPart]:
    """Return a mesh as parts of one colour each: one part, unless it has colours at its vertices or faces.

    Args:
        mesh: The mesh.
        name: Name by which `roboxim_core.vision.textures.pixels` finds its image.
        linear: Whether its colours are linear light, not sRGB.
    """
    material = material_of(mesh, name, linear=linear)
    uv: Any = getattr(mesh.visual, "uv", None)
    uv = None if uv is None else np.asarray(uv)
    vertices, normals, faces = mesh.vertices, mesh.vertex_normals, mesh.faces
    colors = _face_colors(mesh, linear=linear)
    if colors is None:
        return [VisualPart(mesh=triangles(vertices, normals, faces, uv), material=material)]
    parts = []
    for color in np.unique(colors, axis=0):
        used, corners = np.unique(faces[(colors == color).all(axis=1)], return_inverse=True)
        own = triangles(vertices[used], normals[used], corners.reshape(-1, 3), None if uv is None else uv[used])
        r, g, b = (color / 255).tolist()
        parts.append(
            VisualPart(
                mesh=own,
                material=MaterialSpec(
                    color=(r, g, b),
                    metallic=material.metallic,
                    roughness=material.roughness,
                    texture=material.texture,
                ),
            )
        )
    return parts


def material_of(mesh: trimesh.Trimesh, name: str, *, linear: bool) -> MaterialSpec:
    """Return a mesh's own material, without colours at its vertices or faces; arguments as of `visual_parts_of`."""
    from trimesh.visual.material import PBRMaterial, SimpleMaterial

    material, uv = getattr(mesh.visual, "material", None), getattr(mesh.visual, "uv", None)
    texture = name if base_color_image(mesh) is not None and uv is not None else ""
    if isinstance(material, PBRMaterial):
        factor = material.baseColorFactor
        color = np.ones(3) if factor is None else factor[:3] / 255
        r, g, b = (to_srgb(color) if linear else color).tolist()
        metallic = 1.0 if material.metallicFactor is None else float(material.metallicFactor)
        roughness = 1.0 if material.roughnessFactor is None else float(material.roughnessFactor)
        if (image := material.metallicRoughnessTexture) is not None and uv is not None:
            _, rough, metal = _mean(image, np.asarray(uv), mesh) / 255  # green and blue, in glTF
            metallic, roughness = metallic * float(metal), roughness * float(rough)
        return MaterialSpec(color=(r, g, b), metallic=metallic, roughness=roughness, texture=texture)
    if isinstance(material, SimpleMaterial):
        r, g, b = (float(c) / 255 for c in material.diffuse[:3])
        return MaterialSpec(color=(1.0, 1.0, 1.0) if texture else (r, g, b), texture=texture)
    return MaterialSpec()


def refuse_transparency(mesh: trimesh.Trimesh, path: Path | str) -> None:
    """Refuse a glTF material that is transparent somewhere, which would be drawn opaque.

    Raises:
        ConfigError: Naming the file, the material and what to do.
    """
    from trimesh.visual.material import PBRMaterial

    material = getattr(mesh.visual, "material", None)
    if not isinstance(material, PBRMaterial) or material.alphaMode in (None, "OPAQUE"):
        return
    factor, image = material.baseColorFactor, material.baseColorTexture
    seen = image is not None and ("A" in image.getbands() or "transparency" in image.info)
    least = image.convert("RGBA").getchannel("A").getextrema()[0] if seen else 255
    if least < 255 or (factor is not None and factor[3] < 255):
        raise ConfigError(
            f"the mesh {path} has a transparent material '{material.name}' (alphaMode {material.alphaMode}), which is "
            "not drawn; make it OPAQUE, and cut away what must not be seen"
        )


def paint(mesh: trimesh.Trimesh) -> None:
    """Make colours of glTF vertices beside a material, which trimesh drops in copies, the mesh's colours.

    They multiply the material's colour. Beside an image they stay out of account.
    """
    from trimesh.visual import ColorVisuals

    visual: Any = mesh.visual
    colors = getattr(visual, "vertex_attributes", {}).get("color")
    if colors is None or base_color_image(mesh) is not None:
        return
    most = np.iinfo(colors.dtype).max if colors.dtype.kind in "iu" else 1.0
    factor = visual.material.baseColorFactor
    shares = colors[:, :3] / most * (1.0 if factor is None else factor[:3] / 255)
    mesh.visual = ColorVisuals(mesh, vertex_colors=np.rint(255 * np.clip(shares, 0.0, 1.0)).astype(np.uint8))


def rewrite(scene: Any, source: Path, target: Path) -> None:
    """Give a scene's colours the meaning that they have in the format of another file.

    Args:
        scene: `trimesh.Scene` of the file.
        source: The file.
        target: The file that it will be written to.
    """
    from trimesh.visual.material import PBRMaterial

    if is_linear(source) == is_linear(target):
        return
    for part in scene.geometry.values():
        if part.visual.kind in ("vertex", "face"):
            colors = part.visual.vertex_colors.copy()
            colors[:, :3] = _encoded(colors[:, :3], is_linear(target))
            part.visual.vertex_colors = colors
        elif getattr(part.visual, "material", None) is not None:
            own = material_of(part, "", linear=is_linear(source))
            color = 255 * np.array(own.color)
            part.visual.material = PBRMaterial(
                name=part.visual.material.name,
                baseColorFactor=[*(_encoded(color, True) if is_linear(target) else np.rint(color)).astype(int), 255],
                baseColorTexture=base_color_image(part),
                metallicFactor=own.metallic,
                roughnessFactor=own.roughness,
            )


def _encoded(colors: npt.ArrayLike, linear: bool) -> npt.NDArray[np.uint8]:
    """Return 8-bit colours as linear light, given as sRGB, or the other way round."""
    values = np.asarray(colors) / 255
    return np.asarray(np.rint(255 * (to_linear(values) if linear else to_srgb(values))), dtype=np.uint8)


def _face_colors(mesh: trimesh.Trimesh, *, linear: bool) -> npt.NDArray[np.uint8] | None:
    """Return the sRGB colour of each face, 0..255, shape (N, 3), of at most `MOST_COLORS`; None: all have one."""
    from PIL import Image

    visual: Any = mesh.visual
    if visual.kind not in ("vertex", "face"):
        return None
    colors = visual.face_colors[:, :3] / 255
    colors = np.asarray(np.rint(255 * (to_srgb(colors) if linear else colors)), dtype=np.uint8)
    if len(np.unique(colors, axis=0)) > MOST_COLORS:
        few = Image.fromarray(colors[None]).quantize(MOST_COLORS, dither=Image.Dither.NONE)
        colors = np.asarray(few.convert("RGB"))[0]
    return np.asarray(colors, dtype=np.uint8)


def _mean(image: Any, uv: Array, mesh: trimesh.Trimesh) -> Array:
    """Return the mean of an image's channels over the faces of a mesh, weighted by area, 0..255, shape (3,)."""
    texels = np.asarray(image.convert("RGB"), dtype=float)
    high, wide, _ = texels.shape
    u, v = uv[mesh.faces].mean(axis=1).T
    found = texels[np.floor((1.0 - v) * high).astype(int) % high, np.floor(u * wide).astype(int) % wide]
    areas = mesh.area_faces
    return np.asarray(np.average(found, axis=0, weights=areas) if areas.sum() > 0 else found.mean(axis=0))
