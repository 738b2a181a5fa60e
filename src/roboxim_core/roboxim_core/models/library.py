"""Loads robot and object models from ``config/`` and applies modifiers to objects.

Both kinds are a YAML file each, so a new object or robot is one new file. A modifier that a model does not list is
refused: a task that asks for a green apple must not silently get a red one.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import TypeVar

from roboxim_core.config import config_dir as default_config_dir
from roboxim_core.config import load_config
from roboxim_core.errors import ConfigError, ErrorCode, one_of
from roboxim_core.models.description import (
    Friction,
    GraspAnnotation,
    GripperModel,
    JointLimits,
    JointModel,
    LinkModel,
    ObjectModel,
    RobotModel,
    Shape,
    Visual,
)
from roboxim_core.poses import Pose, Vec3
from roboxim_core.specs import RGB, EntitySpec, Scalar

PALETTE: Mapping[str, RGB] = MappingProxyType(
    {
        "red": (0.76, 0.10, 0.09),
        "green": (0.13, 0.55, 0.19),
        "blue": (0.10, 0.27, 0.75),
        "yellow": (0.93, 0.77, 0.10),
        "orange": (0.93, 0.45, 0.06),
        "purple": (0.45, 0.17, 0.60),
        "pink": (0.93, 0.50, 0.65),
        "cyan": (0.15, 0.68, 0.75),
        "brown": (0.38, 0.22, 0.12),
        "white": (0.90, 0.90, 0.88),
        "black": (0.07, 0.07, 0.08),
        "gray": (0.45, 0.46, 0.47),
    }
)
"""The colours that instructions name, in sRGB."""


@dataclass(frozen=True, kw_only=True)
class ModifierModel:
    """How an object may be modified: ``color`` (a name of the palette) or ``scale`` (a uniform factor)."""

    default: str | float
    """Value when a scene does not say."""
    choices: tuple[str, ...] = ()
    """Allowed colours; empty: all of the palette."""
    lower: float = 1.0
    """Smallest factor."""
    upper: float = 1.0
    """Largest factor."""

    def check(self, source: str, kind: str, value: Scalar) -> None:
        """Refuse a value that is not allowed.

        Raises:
            ConfigError: Saying what is.
        """
        if kind == "scale":
            if isinstance(value, bool) or not isinstance(value, float | int) or not self.lower <= value <= self.upper:
                raise ConfigError(
                    f"{source}: scale must be a number from {self.lower:g} to {self.upper:g}, got {value!r}"
                )
        elif value not in self.colors:
            raise ConfigError(f"{source}: unknown color '{value}'; {one_of(self.colors, str(value))}")

    @property
    def colors(self) -> tuple[str, ...]:
        """Allowed colours of a ``color`` modifier."""
        return self.choices or tuple(PALETTE)


@dataclass(frozen=True, kw_only=True)
class ObjectConfig:
    """A YAML file of ``config/objects``; fields as in `ObjectModel`, plus the modifiers."""

    name: str
    """Noun used in instructions."""
    links: tuple[LinkModel, ...]
    """Links; the first is the base."""
    joints: tuple[JointModel, ...] = ()
    """Joints."""
    friction: Friction = Friction()
    """Contact parameters."""
    size: Vec3
    """Extents of the base's bounding box [m]."""
    rest_height: float
    """Height of the base frame above a support when it lies on it [m]."""
    grasps: tuple[GraspAnnotation, ...] = ()
    """Grasps, best first."""
    affordances: tuple[str, ...] = ()
    """Of ``graspable``, ``support``, ``container``, ``articulated``."""
    yaw_symmetry_rad: float = 0.0
    """The object looks the same every so many radians about z; 0: no symmetry."""
    modifiers: dict[str, ModifierModel] = field(default_factory=dict)
    """Modifier name to what it allows."""

    def __post_init__(self) -> None:
        """Check that the links hang together and the modifiers are known.

        Raises:
            ConfigError: Naming the link, joint or modifier.
        """
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
                raise ConfigError(f"joint '{joint.name}' either springs back or stays: give spring or resistance")
        for kind, modifier in self.modifiers.items():
            if kind not in ("color", "scale"):
                raise ConfigError(f"unknown modifier '{kind}'; {one_of(('color', 'scale'), kind)}")
            modifier.check("default", kind, modifier.default)


@dataclass(frozen=True, kw_only=True)
class RobotConfig:
    """A YAML file of ``config/robots``; fields as in `RobotModel`, files relative to the YAML's folder."""

    urdf: str
    """URDF file; its meshes are ``package://<robot id>/...`` in this folder."""
    srdf: str
    """SRDF file."""
    base_link: str
    """Root link."""
    tcp_link: str
    """Frame of the tool centre point."""
    joint_names: tuple[str, ...]
    """Arm joints."""
    limits: JointLimits
    """Their limits."""
    gripper: GripperModel
    """The gripper."""
    home: tuple[float, ...]
    """Arm joint positions at home [rad]."""
    named_states: dict[str, tuple[float, ...]] = field(default_factory=dict)
    """Name to arm joint positions [rad]."""
    position_gain: float = 0.3
    """PyBullet position gain of the arm's motors."""
    motor_force: tuple[float, ...] = ()
    """Largest motor torque used by the sim [N m]."""

    def __post_init__(self) -> None:
        """Check that every list has one number per joint.

        Raises:
            ConfigError: Naming the list.
        """
        lists = {
            **dataclasses.asdict(self.limits),
            "home": self.home,
            "motor_force": self.motor_force,
            **self.named_states,
        }
        for name, values in lists.items():
            if len(values) != len(self.joint_names):
                raise ConfigError(f"{name} must have {len(self.joint_names)} numbers, one per joint, got {len(values)}")


class ModelLibrary:
    """The robots and objects of a config directory. Answers are frozen and cached."""

    def __init__(self, config_dir: Path | str | None = None) -> None:
        """Make a library.

        Args:
            config_dir: Directory with ``robots/`` and ``objects/``; none: RoboXim's own.
        """
        self.config_dir = Path(config_dir) if config_dir is not None else default_config_dir()
        self._objects: dict[str, ObjectConfig] = {}
        self._robots: dict[str, RobotModel] = {}
        self._modified: dict[tuple[str, tuple[tuple[str, Scalar], ...]], ObjectModel] = {}

    @property
    def robot_ids(self) -> tuple[str, ...]:
        """Ids of all robots, sorted."""
        return self._ids("robots")

    @property
    def object_ids(self) -> tuple[str, ...]:
        """Ids of all objects, sorted."""
        return self._ids("objects")

    def robot(self, robot_id: str) -> RobotModel:
        """Return a robot.

        Raises:
            ConfigError: When the id is unknown or the file is wrong; lists what there is.
        """
        if robot_id not in self._robots:
            path = self._path("robots", robot_id)
            config = load_config(path, RobotConfig)
            fields = {f.name: getattr(config, f.name) for f in dataclasses.fields(RobotConfig)}
            for kind in ("urdf", "srdf"):
                fields[kind] = path.parent / fields[kind]
                if not fields[kind].is_file():
                    raise ConfigError(f"{path}: {kind}: no such file: {fields[kind]}")
            self._robots[robot_id] = RobotModel(id=robot_id, **fields)
        return self._robots[robot_id]

    def object(self, object_id: str, modifiers: Mapping[str, Scalar] | None = None) -> ObjectModel:
        """Return an object with its modifiers applied.

        Args:
            object_id: Id, e.g. ``cube``.
            modifiers: Modifier name to value; those left out take the model's default.

        Raises:
            ConfigError: When the id, a modifier or its value is unknown; lists what there is.
        """
        config = self._object_config(object_id)
        source = f"object '{object_id}'"
        for kind, value in (modifiers or {}).items():
            if kind not in config.modifiers:
                raise ConfigError(f"{source} has no modifier '{kind}'; {one_of(config.modifiers, kind)}")
            config.modifiers[kind].check(source, kind, value)
        values = {kind: modifier.default for kind, modifier in config.modifiers.items()} | dict(modifiers or {})
        key = (object_id, tuple(sorted(values.items())))
        if key not in self._modified:
            fields = {
                f.name: getattr(config, f.name) for f in dataclasses.fields(ObjectConfig) if f.name != "modifiers"
            }
            model = _resolve_meshes(ObjectModel(id=object_id, **fields), self.config_dir / "objects")
            if "color" in values:
                model = _tinted(model, PALETTE[str(values["color"])])
            scale = float(values.get("scale", 1.0))
            self._modified[key] = model if scale == 1.0 else _scaled(model, scale)
        return self._modified[key]

    def entity_model(self, entity: EntitySpec) -> ObjectModel:
        """Return the model of a scene's entity.

        Raises:
            ConfigError: As `object`, and when a joint position names no joint or is beyond its limits.
        """
        model = self.object(entity.model, entity.modifiers)
        joints = {joint.name: joint for joint in model.joints}
        for name, position in entity.joint_positions.items():
            if name not in joints:
                raise ConfigError(f"entity '{entity.name}' has no joint '{name}'; {one_of(joints, name)}")
            if not joints[name].lower - 1e-9 <= position <= joints[name].upper + 1e-9:
                raise ConfigError(
                    f"entity '{entity.name}': joint '{name}' must be from {joints[name].lower:g} "
                    f"to {joints[name].upper:g}, got {position:g}"
                )
        return model

    def object_modifiers(self, object_id: str) -> dict[str, ModifierModel]:
        """Return what modifiers an object takes.

        Raises:
            ConfigError: When the id is unknown; lists what there is.
        """
        return dict(self._object_config(object_id).modifiers)

    def digest(self, model_id: str) -> str:
        """Return a hash of everything that defines a robot or object: its YAML and the files it names.

        Returns:
            16 hexadecimal digits.

        Raises:
            ConfigError: When the id is unknown; lists what there is.
        """
        kind = "robots" if model_id in self.robot_ids else "objects"
        path = self._path(kind, model_id)
        files = [path, *sorted(p for p in path.with_suffix("").rglob("*") if p.suffix in _ASSETS)]
        hashed = hashlib.blake2b(digest_size=8)
        for file in files:
            hashed.update(json.dumps([file.relative_to(path.parent).as_posix(), file.stat().st_size]).encode())
            hashed.update(file.read_bytes())
        return hashed.hexdigest()

    def _ids(self, kind: str) -> tuple[str, ...]:
        return tuple(sorted(path.stem for path in (self.config_dir / kind).glob("*.yaml")))

    def _path(self, kind: str, model_id: str) -> Path:
        if model_id not in self._ids(kind):
            raise ConfigError(
                f"unknown {kind[:-1]} '{model_id}'; {one_of(self._ids(kind), model_id)}", ErrorCode.UNKNOWN_MODEL
            )
        return self.config_dir / kind / f"{model_id}.yaml"

    def _object_config(self, object_id: str) -> ObjectConfig:
        if object_id not in self._objects:
            self._objects[object_id] = load_config(self._path("objects", object_id), ObjectConfig)
        return self._objects[object_id]


Piece = TypeVar("Piece", Shape, Visual)
_ASSETS = {".urdf", ".srdf", ".stl", ".obj", ".glb", ".png", ".jpg"}


@lru_cache(maxsize=8)
def mesh_path(filename: str, urdf: Path) -> Path:
    """Return the file that a URDF's mesh filename means.

    Args:
        filename: ``package://<package>/<path>`` or a path relative to the URDF.
        urdf: The URDF; its folder's parent holds the packages.
    """
    package = re.match(r"package://(.+)", filename)
    return urdf.parent.parent / package.group(1) if package else urdf.parent / filename


def _resolve_meshes(model: ObjectModel, folder: Path) -> ObjectModel:
    def absolute(shape: Piece) -> Piece:
        return replace(shape, mesh=str((folder / shape.mesh).resolve())) if shape.mesh else shape

    links = tuple(
        replace(
            link,
            collision=tuple(absolute(shape) for shape in link.collision),
            visual=tuple(absolute(visual) for visual in link.visual),
        )
        for link in model.links
    )
    return replace(model, links=links)


def _tinted(model: ObjectModel, color: RGB) -> ObjectModel:
    links = tuple(
        replace(
            link,
            visual=tuple(replace(v, material=replace(v.material, color=color)) if v.tinted else v for v in link.visual),
        )
        for link in model.links
    )
    return replace(model, links=links)


def _scaled(model: ObjectModel, factor: float) -> ObjectModel:
    def moved(pose: Pose) -> Pose:
        x, y, z = pose.position
        return replace(pose, position=(x * factor, y * factor, z * factor))

    meshes = [s.mesh for link in model.links for s in link.collision]
    meshes += [v.mesh for link in model.links for v in link.visual]
    if any(meshes):
        raise ConfigError(f"object '{model.id}' is made of meshes, which the scale modifier does not carry")
    links = tuple(
        replace(
            link,
            mass=link.mass * factor**3,
            collision=tuple(
                replace(s, size=tuple(v * factor for v in s.size), pose=moved(s.pose)) for s in link.collision
            ),
            visual=tuple(replace(v, size=tuple(x * factor for x in v.size), pose=moved(v.pose)) for v in link.visual),
        )
        for link in model.links
    )
    joints = tuple(
        replace(
            joint,
            pose=moved(joint.pose),
            lower=joint.lower * (factor if joint.kind == "prismatic" else 1.0),
            upper=joint.upper * (factor if joint.kind == "prismatic" else 1.0),
        )
        for joint in model.joints
    )
    grasps = tuple(replace(grasp, pose=moved(grasp.pose), width_m=grasp.width_m * factor) for grasp in model.grasps)
    x, y, z = (value * factor for value in model.size)
    return replace(
        model, links=links, joints=joints, grasps=grasps, size=(x, y, z), rest_height=model.rest_height * factor
    )


__all__ = ["PALETTE", "ModelLibrary", "ModifierModel", "ObjectConfig", "RobotConfig", "mesh_path"]
