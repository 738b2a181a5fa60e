"""Triangle meshes of links, and a scene as a renderer sees it.

Everything here is a function of the scene spec, the models and a state record, so a live image and one re-rendered
from a bag come from the same numbers.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

import roboxim_core.models.solids
import roboxim_core.models.turned  # noqa: F401  (both register generators)
from roboxim_core.errors import ConfigError
from roboxim_core.kinematics.arm import ArmKinematics
from roboxim_core.models.articulation import object_link_poses
from roboxim_core.models.description import Visual
from roboxim_core.models.hulls import load_scene
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.mesh_files import Stamp, file_stamp, mesh_stamp
from roboxim_core.models.meshes import box_mesh, triangles, visual_generators
from roboxim_core.models.surfaces import is_linear, visual_parts_of
from roboxim_core.models.urdf import urdf_materials, urdf_visual
from roboxim_core.poses import IDENTITY, Pose, Vec3
from roboxim_core.specs import CameraSpec, MaterialSpec, SceneSpec, TableSpec
from roboxim_core.state import RobotState, StateRecord
from roboxim_core.vision.renderer import RenderBody, RenderWorld, TriangleMesh, VisualPart

FLOOR_Z = -0.75
"""Height of the floor in the world [m]; the table's top is at 0."""


def visual_parts(visual: Visual) -> tuple[VisualPart, ...]:
    """Return what to draw for one visual, in its link's frame.

    Args:
        visual: A shape, a mesh file (which may carry materials of its own) or a registered generator's name.

    Raises:
        ConfigError: On an unknown kind, or a mesh that cannot be read.
    """
    return _visual_parts(visual, mesh_stamp(visual.mesh) if visual.mesh else ())


@lru_cache(maxsize=512)
def _visual_parts(visual: Visual, _stamp: Stamp) -> tuple[VisualPart, ...]:
    if visual.kind in ("mesh", "hull"):
        return _mesh_parts(visual, linear=is_linear(visual.mesh))
    try:
        mesh = visual_generators[visual.kind](visual.size)
    except (IndexError, ValueError) as error:
        raise ConfigError(f"visual of kind '{visual.kind}' cannot have size {visual.size}: {error}") from None
    part = VisualPart(mesh=mesh, material=visual.material)
    return (_placed(_stretched(part, visual.scale), visual.pose),)


def _mesh_parts(visual: Visual, *, linear: bool) -> tuple[VisualPart, ...]:
    parts = _load_mesh(visual.mesh, linear, mesh_stamp(visual.mesh))
    if visual.material != MaterialSpec():  # else the mesh keeps its own materials
        parts = tuple(VisualPart(mesh=part.mesh, material=visual.material) for part in parts)
    return tuple(_placed(_stretched(part, visual.scale), visual.pose) for part in parts)


def robot_parts(urdf: Path, mesh_colors: str) -> dict[str, tuple[VisualPart, ...]]:
    """Return the visuals of each link of a robot, from its URDF; links without visuals are omitted.

    Args:
        urdf: The URDF.
        mesh_colors: Meaning of the colours in its GLB files, as `RobotModel.mesh_colors`.

    Raises:
        ConfigError: When a mesh of the URDF cannot be read.
    """
    stamp = file_stamp(urdf)
    files = _robot_meshes(urdf, stamp)
    return _robot_parts(urdf, mesh_colors, (stamp, *(each for file in files for each in mesh_stamp(file))))


@lru_cache(maxsize=16)
def _robot_meshes(urdf: Path, _stamp: tuple[int, int]) -> tuple[str, ...]:
    root = ElementTree.parse(urdf).getroot()
    materials = urdf_materials(root)
    meshes = (element for element in root.iter("visual") if element.find("geometry/mesh") is not None)
    return tuple(dict.fromkeys(urdf_visual(element, urdf, materials).mesh for element in meshes))


@lru_cache(maxsize=16)
def _robot_parts(urdf: Path, mesh_colors: str, _stamp: Stamp) -> dict[str, tuple[VisualPart, ...]]:
    parts: dict[str, tuple[VisualPart, ...]] = {}
    root = ElementTree.parse(urdf).getroot()
    materials = urdf_materials(root)
    for link in root.iter("link"):
        found: list[VisualPart] = []
        for element in link.findall("visual"):
            if element.find("geometry/mesh") is None:
                raise ConfigError(f"{urdf}: link '{link.get('name')}': only mesh visuals are supported for robots")
            visual = urdf_visual(element, urdf, materials)
            found += _mesh_parts(visual, linear=mesh_colors == "linear" and is_linear(visual.mesh))
        if found:
            parts[link.get("name", "")] = tuple(found)
    return parts


@lru_cache(maxsize=16)
def _drawn_links(urdf: Path, _stamp: tuple[int, int]) -> frozenset[str]:
    links = ElementTree.parse(urdf).getroot().iter("link")
    return frozenset(link.get("name", "") for link in links if link.find("visual") is not None)


def render_world(scene: SceneSpec, library: ModelLibrary) -> RenderWorld:
    """Return everything to draw of a scene: the room, the table, the robot, the entities.

    Raises:
        ConfigError: When a model or a modifier is unknown.
    """
    robot = library.robot(scene.robot.model)
    look = scene.look
    bodies = [
        *_room(scene.table, look.table, look.floor, look.wall if look.background == "room" else None, scene.robot.pose)
    ]
    bodies += [
        RenderBody(key=f"robot/{link}", entity="robot", parts=parts)
        for link, parts in robot_parts(robot.urdf, robot.mesh_colors).items()
    ]
    for entity in scene.entities:
        model = library.entity_model(entity)
        for link in model.links:
            parts = tuple(part for visual in link.visual for part in visual_parts(visual))
            bodies.append(RenderBody(key=body_key(entity.name, link.name), entity=entity.name, parts=parts))
    return RenderWorld(bodies=tuple(bodies), look=scene.look)


def drawn_entities(scene: SceneSpec) -> tuple[str, ...]:
    """Return the entities of `render_world`, in the order of their segmentation ids, which start at 1."""
    wall = ["wall"] if scene.look.background == "room" else []
    return ("table", "floor", *wall, "robot", *(entity.name for entity in scene.entities))


def body_key(entity: str, link: str) -> str:
    """Return the key of a body: ``<entity>`` for an unnamed link, else ``<entity>/<link>``."""
    return f"{entity}/{link}" if link else entity


class ScenePoses:
    """Where the bodies and cameras of a scene are, given a state record. Not thread-safe (see `ArmKinematics`)."""

    def __init__(self, scene: SceneSpec, library: ModelLibrary, arm: ArmKinematics | None = None) -> None:
        """Prepare the kinematics of a scene's robot and objects.

        Args:
            scene: The scene.
            library: Where its models come from.
            arm: Kinematics of its robot, to share; none: made here.

        Raises:
            ConfigError: When a model or a modifier is unknown.
        """
        self._scene = scene
        self.library = library
        """Where the models come from."""
        self._arm = arm or ArmKinematics(library.robot(scene.robot.model))
        self._drawn = _drawn_links(self._arm.model.urdf, file_stamp(self._arm.model.urdf))
        self._models = {entity.name: library.entity_model(entity) for entity in scene.entities}
        self._last: tuple[RobotState, dict[str, Pose]] | None = None
        self._last_objects: tuple[StateRecord, dict[str, Pose]] | None = None
        self._last_cameras: tuple[RobotState, dict[str, Pose]] | None = None
        for camera in scene.cameras:
            camera_parent(camera, self._arm)

    def link_poses(self, robot: RobotState) -> dict[str, Pose]:
        """Return the pose of every robot link in the world."""
        if self._last is None or self._last[0] is not robot:
            base = self._scene.robot.pose
            poses = self._arm.link_poses(robot.joint_positions, robot.finger_positions)
            if base != IDENTITY:
                poses = {link: base @ pose for link, pose in poses.items()}
            self._last = (robot, poses)
        return self._last[1]

    def body_poses(self, record: StateRecord) -> dict[str, Pose]:
        """Return the pose of every moving body of `render_world` in the world, by key."""
        drawn = self._drawn
        poses = {f"robot/{link}": pose for link, pose in self.link_poses(record.robot).items() if link in drawn}
        return poses | self.object_poses(record)

    def object_poses(self, record: StateRecord) -> dict[str, Pose]:
        """Return the pose of every link of the objects in the world, by `body_key`."""
        if self._last_objects is None or self._last_objects[0] is not record:
            poses = {}
            for entity in record.entities:
                if entity.name in self._models:
                    joints = dict(zip(entity.joint_names, entity.joint_positions, strict=True))
                    for link, pose in object_link_poses(self._models[entity.name], joints).items():
                        poses[body_key(entity.name, link)] = entity.pose @ pose if link else entity.pose
            self._last_objects = (record, poses)
        return self._last_objects[1]

    def camera_poses(self, robot: RobotState, cameras: tuple[CameraSpec, ...] | None = None) -> dict[str, Pose]:
        """Return the pose of each camera's optical frame in the world, by name.

        Args:
            robot: State of the robot.
            cameras: The cameras; none: the scene's.

        Raises:
            ConfigError: When a camera's parent is neither ``world``, ``gripper`` nor a link.
        """
        if cameras is None:
            if self._last_cameras is None or self._last_cameras[0] is not robot:
                self._last_cameras = (robot, self.camera_poses(robot, self._scene.cameras))
            return self._last_cameras[1]
        links = self.link_poses(robot) if any(camera.parent != "world" for camera in cameras) else {}
        poses = {}
        for camera in cameras:
            parent = camera_parent(camera, self._arm)
            poses[camera.name] = camera.pose if parent == "world" else links[parent] @ camera.pose
        return poses


def camera_parent(camera: CameraSpec, arm: ArmKinematics) -> str:
    """Return ``world`` or the robot link that a camera is mounted on; ``gripper`` names the hand of any robot.

    Raises:
        ConfigError: When the robot has no such link.
    """
    parent = camera.parent
    if parent == "gripper" and arm.model.gripper.links:
        parent = arm.model.gripper.links[0]
    if parent != "world" and parent not in arm.link_names:
        raise ConfigError(
            f"camera '{camera.name}' is on '{parent}'; expected 'world', 'gripper' or one of the robot's links: "
            + ", ".join(arm.link_names)
        )
    return parent


@lru_cache(maxsize=16)
def _room(
    table: TableSpec, top: MaterialSpec, ground: MaterialSpec, wall: MaterialSpec | None, base: Pose
) -> tuple[RenderBody, ...]:
    """The table with its legs, the robot's pedestal, the floor and the walls around; kept, since scenes share it.

    Args:
        table: The table.
        top: Material of its top.
        ground: Material of the floor.
        wall: Material of the walls; none: there are no walls.
        base: Pose of the robot's base.
    """
    x, y, z = table.center
    wide, deep, thick = table.size
    legs = MaterialSpec(color=(0.22, 0.23, 0.25), metallic=0.6, roughness=0.45)
    under = z - thick
    slab = _slab(table.size, (x, y, z - thick / 2), top)
    # Without texture coordinates a texture keeps its own size instead of stretching over the table.
    parts = [replace(slab, mesh=replace(slab.mesh, uv=None))]
    for side_x in (-1, 1):
        for side_y in (-1, 1):
            foot = (x + side_x * (wide / 2 - 0.06), y + side_y * (deep / 2 - 0.06), (under + FLOOR_Z) / 2)
            parts.append(_slab((0.06, 0.06, under - FLOOR_Z), foot, legs))
    bx, by, bz = base.position
    pedestal = _slab((0.26, 0.26, bz - FLOOR_Z), (bx - 0.04, by, (bz + FLOOR_Z) / 2 - 0.001), legs)
    room = 2.8
    middle = np.array([x, y, 0.0])
    floor = VisualPart(mesh=_plane(middle + [0, 0, FLOOR_Z], [room, 0, 0], [0, room, 0]), material=ground)
    height = [0, 0, 1.4]
    walls = (
        []
        if wall is None
        else [
            VisualPart(
                mesh=_plane(middle + [*(room * np.array(out)), FLOOR_Z + 1.4], room * np.array([*along, 0]), height),
                material=wall,
            )
            for out, along in (((-1, 0), (0, 1)), ((1, 0), (0, -1)), ((0, -1), (-1, 0)), ((0, 1), (1, 0)))
        ]
    )
    return (
        RenderBody(key="table", entity="table", parts=tuple(parts)),
        RenderBody(key="pedestal", entity="table", parts=(pedestal,)),
        RenderBody(key="floor", entity="floor", parts=(floor,)),
        *([RenderBody(key="wall", entity="wall", parts=tuple(walls))] if walls else []),
    )


@lru_cache(maxsize=64)
def _slab(size: tuple[float, float, float], center: tuple[float, float, float], material: MaterialSpec) -> VisualPart:
    return _placed(VisualPart(mesh=box_mesh(size), material=material), Pose(position=center))


def _plane(center: npt.ArrayLike, half_u: npt.ArrayLike, half_v: npt.ArrayLike) -> TriangleMesh:
    """A rectangle that faces ``half_u x half_v``; uv in metres."""
    c, u, v = (np.asarray(a, dtype=float) for a in (center, half_u, half_v))
    corners = np.array([c - u - v, c + u - v, c + u + v, c - u + v])
    normal = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    wide, high = 2 * np.linalg.norm(u), 2 * np.linalg.norm(v)
    uv = np.array([[0, 0], [wide, 0], [wide, high], [0, high]])
    return triangles(corners, np.tile(normal, (4, 1)), np.array([[0, 1, 2], [0, 2, 3]]), uv)


@lru_cache(maxsize=128)
def _load_mesh(path: str, linear: bool, _stamp: Stamp) -> tuple[VisualPart, ...]:
    import trimesh

    scene = load_scene(path)
    parts: list[VisualPart] = []
    for node in sorted(scene.graph.nodes_geometry):
        transform, name = scene.graph[node]
        if not isinstance(scene.geometry[name], trimesh.Trimesh):
            continue  # points and lines
        mesh = scene.geometry[name].copy(include_cache=True)  # the normals of the file are in the cache
        mesh.apply_transform(transform)
        parts += visual_parts_of(mesh, f"{path}#{name}", linear=linear)
    return tuple(parts)


def _stretched(part: VisualPart, scale: Vec3) -> VisualPart:
    if scale == (1.0, 1.0, 1.0):
        return part
    normals = part.mesh.normals / np.asarray(scale)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    lengths[lengths == 0.0] = 1.0  # a vertex of no face
    mesh = replace(
        part.mesh,
        vertices=(part.mesh.vertices * np.asarray(scale)).astype(np.float32),
        normals=(normals / lengths).astype(np.float32),
        faces=part.mesh.faces if np.prod(scale) > 0 else np.ascontiguousarray(part.mesh.faces[:, ::-1]),
    )
    return replace(part, mesh=mesh)


def _placed(part: VisualPart, pose: Pose) -> VisualPart:
    if pose == IDENTITY:
        return part
    mesh = TriangleMesh(
        vertices=pose.apply(part.mesh.vertices).astype(np.float32),
        normals=pose.rotation.apply(part.mesh.normals).astype(np.float32),
        faces=part.mesh.faces,
        uv=part.mesh.uv,
    )
    return VisualPart(mesh=mesh, material=part.material)
