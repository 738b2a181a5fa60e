"""Converts the visual and collision meshes of a URDF's link to the files that RoboXim uses."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import trimesh

from roboxim_core.errors import ConfigError
from roboxim_core.models.hulls import load_scene
from roboxim_core.models.surfaces import is_linear
from roboxim_core.models.urdf import mesh_path
from roboxim_core.vision.srgb import to_srgb
from roboxim_runs.robots.convex_parts import coarser, convex_parts
from roboxim_runs.robots.decimation import Color, visual

Element = ElementTree.Element
MIN_GAIN = 0.03
"""Fraction of a link's hull that a further convex part must save."""
MAX_PARTS = 8
WELD_M = 0.001
"""Detail of visual meshes that is dropped [m]."""
GREY: Color = (190, 192, 196)
"""Colour of a mesh that neither its file nor the URDF gives one."""


class LinkMeshes:
    """Writes the meshes of links into a robot's or a gripper's folder."""

    def __init__(
        self, package: str, folder: Path, source: Path, materials: dict[str, Element], *, triangles: int,
        collision_m: float, weld_m: float = WELD_M, max_parts: int = MAX_PARTS,
    ) -> None:  # fmt: skip
        """Set where meshes come from and go to.

        Args:
            package: Name of the folder in the mesh paths of the URDF to write.
            folder: That folder, with ``visual`` and ``collision``.
            source: The URDF that links come from.
            materials: Its materials by name.
            triangles: Triangles of a link's visual mesh.
            collision_m: How far a convex part of a collision shape may reach beyond its hull [m].
            weld_m: Detail of visual meshes that is dropped [m].
            max_parts: Convex parts of a collision shape.
        """
        self.package, self.folder, self._source, self._materials = package, folder, source, materials
        self._triangles, self._weld_m, self._max_parts = triangles, weld_m, max_parts
        self._collision_m = collision_m
        self._seen: trimesh.Trimesh | None = None
        self._parts: list[trimesh.Trimesh] = []

    def visual(self, link: Element) -> list[Element]:
        """Return the visual element of a link; none: it has no shape."""
        parts: list[tuple[Color, trimesh.Trimesh]] = []
        for shape in link.findall("visual"):
            parts += coloured(shape, self._source, self._materials)
        if not parts:
            return []
        file = f"visual/{link.get('name')}.glb"
        scene = visual(parts, triangles=self._triangles, weld_m=self._weld_m)
        (self.folder / file).write_bytes(scene.export(file_type="glb", include_normals=True))
        self._seen = _together([mesh for mesh in scene.dump() if isinstance(mesh, trimesh.Trimesh)])
        return [self.element("visual", file)]

    def collision(self, link: Element, beyond_m: float | None = None, *, cover: bool = False) -> list[Element]:
        """Return the collision elements of a link: convex parts.

        Args:
            link: The link.
            beyond_m: How far a part may reach beyond its hull [m]; none: as all links' do.
            cover: Make them of the visual mesh, which `visual` has made, instead of the link's collision shapes.
        """
        made, solids = [], [self._seen] if cover and self._seen else self._solids(link)
        for k, solid in enumerate(solids):
            for i, hull in enumerate(convex_parts(solid, min_gain=MIN_GAIN, max_parts=self._max_parts)):
                file = f"collision/{link.get('name')}_{k + 1}_{i + 1}.stl"
                part = coarser(hull, self._collision_m if beyond_m is None else beyond_m)
                part.export(self.folder / file)
                self._parts.append(part)
                made.append(self.element("collision", file))
        return made

    @property
    def uncovered_m(self) -> float:
        """How far the visual mesh made last reaches beyond the collision parts made so far, at least [m]."""
        if self._seen is None or not self._parts:
            return 0.0
        points = self._seen.vertices
        # A point is as far from a convex part as it is in front of the part's faces, or farther.
        beyond = [
            (points @ part.face_normals.T - np.sum(part.face_normals * part.triangles[:, 0], axis=1)).max(axis=1)
            for part in self._parts
        ]
        return max(0.0, float(np.min(beyond, axis=0).max()))

    def _solids(self, link: Element) -> list[trimesh.Trimesh]:
        """Return the mesh of each collision shape of a link."""
        shapes = [coloured(shape, self._source, self._materials) for shape in link.findall("collision")]
        return [_together([mesh for _, mesh in shape]) for shape in shapes]

    def element(self, tag: str, file: str) -> Element:
        """Return a visual or collision element of a mesh file of the folder."""
        made = ElementTree.Element(tag)
        geometry = ElementTree.SubElement(made, "geometry")
        ElementTree.SubElement(geometry, "mesh", {"filename": f"package://{self.package}/{file}"})
        return made


def _together(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    return trimesh.Trimesh(*trimesh.util.append_faces([m.vertices for m in meshes], [m.faces for m in meshes]))


def coloured(shape: Element, path: Path, materials: dict[str, Element]) -> list[tuple[Color, trimesh.Trimesh]]:
    """Return colour and mesh of each part of a URDF's visual or collision shape, in its link's frame.

    Raises:
        ConfigError: When the geometry is missing, unreadable or of another kind.
    """
    geometry = shape.find("geometry")
    item = None if geometry is None else next(iter(geometry), None)
    if item is None:
        raise ConfigError(f"{path}: a <{shape.tag}> has no geometry")
    material = shape.find("material")
    named = None if material is None else materials.get(str(material.get("name")))
    color = next((c for m in (material, named) if m is not None and (c := m.find("color")) is not None), None)
    stated: Color | None = None
    if color is not None:
        stated = tuple(round(255 * float(value)) for value in str(color.get("rgba")).split()[:3])
    if item.tag == "mesh":
        parts = _loaded(mesh_path(str(item.get("filename")), path), _numbers(item.get("scale", "1 1 1")))
    elif item.tag == "box":
        parts = [(None, trimesh.creation.box(_numbers(str(item.get("size")))))]
    elif item.tag == "cylinder":
        solid = trimesh.creation.cylinder(float(str(item.get("radius"))), float(str(item.get("length"))))
        parts = [(None, solid)]
    elif item.tag == "capsule":  # of an MJCF; a URDF has none
        solid = trimesh.creation.capsule(float(str(item.get("length"))), float(str(item.get("radius"))))
        parts = [(None, solid)]
    elif item.tag == "sphere":
        parts = [(None, trimesh.creation.icosphere(radius=float(str(item.get("radius")))))]
    else:
        raise ConfigError(f"{path}: geometry <{item.tag}> is not supported; use mesh, box, cylinder or sphere")
    origin = shape.find("origin")
    placed = np.eye(4)
    if origin is not None:
        placed = trimesh.transformations.euler_matrix(*_numbers(origin.get("rpy", "0 0 0")))
        placed[:3, 3] = _numbers(origin.get("xyz", "0 0 0"))
    for _, mesh in parts:
        mesh.apply_transform(placed)
    return [(stated or own or GREY, mesh) for own, mesh in parts]


def _loaded(file: Path, scale: list[float]) -> list[tuple[Color | None, trimesh.Trimesh]]:
    """Return colour and mesh of each part of a mesh file; no colour: the file has none."""
    parts: list[tuple[Color | None, trimesh.Trimesh]] = []
    for mesh in load_scene(file, merge=True).dump():
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            mesh.apply_scale(scale)
            parts.append((_color(mesh, linear=is_linear(file)), mesh))
    if not parts:
        raise ConfigError(f"{file} holds no triangles")
    return parts


def _color(mesh: trimesh.Trimesh, *, linear: bool) -> Color | None:
    """Return the sRGB colour of a mesh, 0..255; none: its file gives none.

    Args:
        mesh: The mesh.
        linear: Whether its colours are linear light.
    """
    main = getattr(getattr(mesh.visual, "material", None), "main_color", None)
    if main is None or len(main) < 3 or tuple(main[:3]) == (102, 102, 102):  # trimesh's default
        return None
    return tuple(round(255 * float(c)) for c in (to_srgb(main[:3] / 255) if linear else main[:3] / 255))


def _numbers(text: str) -> list[float]:
    return [float(word) for word in text.split()]
