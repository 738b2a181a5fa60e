"""An object's YAML file: the fields of `ObjectModel` plus modifiers, checked when it is loaded."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from roboxim_core.errors import ConfigError, one_of
from roboxim_core.models.bounds import links_bounds
from roboxim_core.models.description import (
    AFFORDANCES,
    MAX_SHAPES,
    GraspAnnotation,
    Handle,
    JointModel,
    LinkModel,
    ObjectModel,
    ObjectNotes,
    PressPoint,
    Region,
    Shape,
    Visual,
)
from roboxim_core.models.hulls import hull_file
from roboxim_core.models.mesh_files import mesh_references
from roboxim_core.models.modifiers import ModifierModel
from roboxim_core.models.urdf import LARGEST, urdf_object
from roboxim_core.plain_data.pictures import is_picture
from roboxim_core.poses import Array, Pose, Vec3
from roboxim_core.rotation.quaternions import quat_about

SHAPE_SIZES = {"box": 3, "sphere": 1, "cylinder": 2, "capsule": 2, "hull": 0, "ring": 4}
"""Kind of a collision shape to how many sizes it has."""
NEEDS = {
    "graspable": "grasps",
    "support": "regions",
    "container": "regions",
    "articulated": "joints",
    "openable": "handles",
    "pressable": "press_points",
    "flippable": "handles",
    "hinged": "handles",
    "turnable": "handles",
    "upright": "toppled",
}
"""Affordance to the list that must not be empty for it."""


@dataclass(frozen=True, kw_only=True)
class ObjectConfig(ObjectNotes):
    """A YAML file of ``config/objects``."""

    mesh: str = ""
    """Mesh file (GLB, OBJ, STL, ...) of the visual; its convex hull collides. Alternatives: ``urdf``, ``links``."""
    mesh_scale: float = 1.0
    """Factor on the coordinates of ``mesh``, e.g. 0.001 for millimetres."""
    mass: float = 0.0
    """Mass of an object of a ``mesh``, or of a ``urdf`` of one link without a mass [kg]."""
    urdf: str = ""
    """URDF file with the links and joints; see `models.urdf`."""
    links: tuple[LinkModel, ...] = ()
    """Links; the first is the base."""
    size: Vec3 | None = None
    """Extents; see `ObjectModel` [m]; none: from the collision shapes."""
    rest_height: float | None = None
    """Height of the base frame above a support when it stands on it [m]; none: from the collision shapes."""
    modifiers: dict[str, ModifierModel] = field(default_factory=dict)
    """Modifier name to its allowed values."""

    def __post_init__(self) -> None:
        """Check that the links form a tree and that every reference resolves.

        Raises:
            ConfigError: Naming the link, joint, affordance or modifier.
        """
        if sum(map(bool, (self.links, self.mesh, self.urdf))) != 1:
            raise ConfigError("an object needs either links, or a mesh, or a urdf")
        if self.mesh_scale != 1.0 and not self.mesh:
            where = "give the <mesh> in the urdf a scale" if self.urdf else "give the shapes and visuals a scale"
            raise ConfigError(f"mesh_scale is the scale of `mesh`, which the object does not have: {where}")
        if self.mass and self.links:
            raise ConfigError("`mass` is that of an object of a mesh or a urdf: give each of the links its mass")
        if (part := _unbounded(self)) is not None:
            raise ConfigError(f"{part} is not a number of at most {LARGEST:g}")
        for kind, modifier in self.modifiers.items():
            modifier.check_itself(kind)
        for affordance in self.affordances:
            if affordance not in AFFORDANCES:
                raise ConfigError(f"unknown affordance '{affordance}'; {one_of(AFFORDANCES, affordance)}")
        if self.links:
            self._check_links()
            self._check_notes()

    def _check_notes(self) -> None:
        names = [link.name for link in self.links]
        joints = {joint.name: joint for joint in self.joints}
        for affordance in self.affordances:
            if affordance in NEEDS and not getattr(self, NEEDS[affordance]):
                raise ConfigError(f"affordance '{affordance}' needs at least one of `{NEEDS[affordance]}`")
        for region in self.regions:
            if region.kind not in ("surface", "interior") or region.shape not in ("rectangle", "disc"):
                raise ConfigError(
                    f"region '{region.name}': kind is surface or interior and shape rectangle or disc, "
                    f"got '{region.kind}', '{region.shape}'"
                )
        located: list[Region | GraspAnnotation] = [*self.regions, *self.grasps]
        located += [grasp for handle in self.handles for grasp in handle.grasps]
        for what in located:
            if what.link and what.link not in names:
                raise ConfigError(f"'{what.name}' is on an unknown link; {one_of(names, what.link)}")
        tinted = any(not link.visual or any(visual.tinted for visual in link.visual) for link in self.links)
        if self._is_tinted and not tinted:
            raise ConfigError(
                "the modifiers list color or material, which change only visuals with `tinted: true`, and no visual of "
                "`links` has it: add it there, or remove the modifier"
            )
        moving: list[Handle | PressPoint] = [*self.handles, *self.press_points]
        for part in moving:
            if part.joint not in joints or joints[part.joint].child != part.link:
                raise ConfigError(
                    f"'{part.name}': needs a joint of the object and the link that it moves, got joint '{part.joint}' "
                    f"and link '{part.link}'"
                )

    def _check_links(self) -> None:
        names = [link.name for link in self.links]
        if not names or len(set(names)) != len(names):
            raise ConfigError(f"an object needs at least one link and unique link names, got {names}")
        children = [joint.child for joint in self.joints]
        if sorted(children) != sorted(names[1:]):
            raise ConfigError(
                f"every link but the base '{names[0]}' needs exactly one joint; joints lead to {children}"
            )
        for joint in self.joints:
            if joint.parent not in names or joint.kind not in ("prismatic", "revolute"):
                raise ConfigError(
                    f"joint '{joint.name}': kind must be prismatic or revolute and parent one of {names}, "
                    f"got '{joint.kind}', '{joint.parent}'"
                )
            if joint.spring > 0 and joint.resistance > 0:
                raise ConfigError(f"joint '{joint.name}' cannot both spring back and stay: give spring or resistance")
        for link in self.links:
            packed = [shape for shape in link.collision if shape.kind in ("box", "ring")]
            unpacked = len(link.collision) - len(packed)
            if unpacked + bool(packed) > MAX_SHAPES:
                raise ConfigError(
                    f"link '{link.name}' has {unpacked} collision shapes other than boxes and rings, "
                    f"PyBullet takes {MAX_SHAPES - bool(packed)}; merge some"
                )
            for shape in link.collision:
                if shape.kind not in SHAPE_SIZES:
                    raise ConfigError(
                        f"link '{link.name}': unknown collision shape '{shape.kind}'; {one_of(SHAPE_SIZES, shape.kind)}"
                    )
                if len(shape.size) != SHAPE_SIZES[shape.kind] or any(value <= 0 for value in shape.size):
                    raise ConfigError(
                        f"link '{link.name}': a {shape.kind} has {SHAPE_SIZES[shape.kind]} sizes > 0 [m], "
                        f"got {list(shape.size)}"
                    )
                if shape.kind == "hull" and not shape.mesh:
                    raise ConfigError(f"link '{link.name}': a hull needs a mesh")

    @property
    def _is_tinted(self) -> bool:
        """Whether a modifier changes the look."""
        return "color" in self.modifiers or "material" in self.modifiers

    def resolved(self, folder: Path) -> ObjectConfig:
        """Return the configuration with ``links`` in place of ``mesh`` or ``urdf``.

        The modifiers ``color`` and ``material`` apply to all visuals of a mesh or a URDF.

        Args:
            folder: Folder of the YAML file, which other files are relative to.

        Raises:
            ConfigError: When a file cannot be read or lacks an element that the configuration refers to.
        """
        if self.urdf:
            links, joints = urdf_object(folder / self.urdf)
            if self.joints:
                raise ConfigError("joints come from the urdf; leave `joints` out")
            if self.mass and len(links) == 1 and not links[0].mass:
                links = (replace(links[0], mass=self.mass),)
            elif self.mass:
                raise ConfigError(
                    "masses come from the urdf; leave `mass` out: it is only for a urdf of one link without a mass"
                )
            links = tuple(
                replace(link, visual=tuple(replace(visual, tinted=self._is_tinted) for visual in link.visual))
                for link in links
            )
            return replace(self, urdf="", mass=0.0, links=links, joints=joints)
        if self.mesh:
            scale = self.mesh_scale
            link = LinkModel(
                mass=self.mass,
                collision=(Shape(kind="hull", mesh=self.mesh, scale=scale),),
                visual=(Visual(kind="mesh", mesh=self.mesh, scale=(scale, scale, scale), tinted=self._is_tinted),),
            )
            return replace(self, mesh="", mesh_scale=1.0, mass=0.0, links=(link,))
        return self

    def files(self, folder: Path) -> tuple[Path, ...]:
        """Return the existing files that the configuration names, with their material files and images.

        Args:
            folder: Folder of the YAML file, which other files are relative to.

        Raises:
            ConfigError: When a URDF cannot be read.
        """
        names = [self.urdf]
        for link in self.resolved(folder).links:
            names += [shape.mesh for shape in link.collision] + [visual.mesh for visual in link.visual]
            names += [v.material.texture for v in link.visual if is_picture(v.material.texture)]
        found = [(folder / name).resolve() for name in dict.fromkeys(names) if name]
        for file in found:
            found += [other for other in mesh_references(file).values() if other not in found]
        return tuple(file for file in found if file.is_file())

    def model(self, object_id: str, folder: Path) -> ObjectModel:
        """Return the object without modifiers, with absolute paths, cached hulls, and rings as boxes.

        Args:
            object_id: Its id.
            folder: Folder of the YAML file, which mesh files are relative to.

        Raises:
            ConfigError: When a file cannot be read or the object has no collision shape.
        """
        if not self.links:
            return self.resolved(folder).model(object_id, folder)
        values = {f.name: getattr(self, f.name) for f in fields(ObjectNotes)}
        links = tuple(
            replace(
                link,
                collision=tuple(_absolute(part, folder) for shape in link.collision for part in convex_parts(shape)),
                visual=tuple(_absolute(visual, folder) for visual in link.visual or _drawn(link)),
            )
            for link in self.links
        )
        size, rest_height = self.size, self.rest_height
        if size is None or rest_height is None:
            low, high = _bounds(links, self.joints, object_id)
            x, y, _ = (2 * np.maximum(-low, high)).tolist()
            size = size or (x, y, float(high[2] - low[2]))
            rest_height = -float(low[2]) if rest_height is None else rest_height
        return ObjectModel(id=object_id, links=links, size=size, rest_height=rest_height, **values)


def _unbounded(value: object, where: str = "") -> str | None:
    """Return the name of the first number in a configuration that is NaN or beyond `LARGEST`; None: all are valid."""
    if isinstance(value, int | float):
        return None if abs(value) <= LARGEST else where  # NaN fails the comparison
    items: Iterable[tuple[object, object]] = ()
    if is_dataclass(value):
        items = ((f.name, getattr(value, f.name)) for f in fields(value))
    elif isinstance(value, Mapping):
        items = value.items()
    elif isinstance(value, list | tuple):
        items = enumerate(value)
    for key, inner in items:
        found = _unbounded(inner, f"{where}.{key}" if where else str(key))
        if found is not None:
            return found
    return None


def _drawn(link: LinkModel) -> tuple[Visual, ...]:
    """Return a link's collision shapes as visuals, for a link without visuals."""
    return tuple(
        Visual(
            kind=part.kind,
            size=part.size,
            mesh=part.mesh,
            scale=(part.scale, part.scale, part.scale),
            pose=part.pose,
            tinted=True,
        )
        for shape in link.collision
        for part in convex_parts(shape)
    )


Piece = TypeVar("Piece", Shape, Visual)


def _absolute(shape: Piece, folder: Path) -> Piece:
    if isinstance(shape, Visual) and is_picture(shape.material.texture):
        texture = str((folder / shape.material.texture).resolve())
        shape = replace(shape, material=replace(shape.material, texture=texture))
    if not shape.mesh:
        return shape
    file = str((folder / shape.mesh).resolve())
    return replace(shape, mesh=hull_file(file) if isinstance(shape, Shape) else file)


def _bounds(links: tuple[LinkModel, ...], joints: tuple[JointModel, ...], object_id: str) -> Array:
    try:
        return links_bounds(links, joints)
    except ValueError as error:
        raise ConfigError(f"object '{object_id}': {error}, so size and rest_height must be given") from None


def convex_parts(shape: Shape) -> tuple[Shape, ...]:
    """Split a shape into convex ones: a ring becomes boxes whose outer faces touch its cone; others stay."""
    if shape.kind != "ring":
        return (shape,)
    low, high, height, thick = shape.size
    slant = float(np.hypot(high - low, height))
    width = 2 * max(low, high) * float(np.tan(np.pi / shape.segments))
    tilt = float(np.arctan2(high - low, height))
    middle = Pose(position=((low + high) / 2, 0.0, 0.0), quat_xyzw=quat_about("y", tilt))
    middle = middle @ Pose(position=(-thick / 2, 0.0, 0.0))
    boxes = []
    for k in range(shape.segments):
        turn = Pose(quat_xyzw=quat_about("z", 2 * np.pi * k / shape.segments))
        boxes.append(Shape(kind="box", size=(thick, width, slant), pose=shape.pose @ turn @ middle))
    return tuple(boxes)
