"""What an episode is before it runs: the task, the scene, and the address of its randomness.

All are frozen plain values made of numbers, strings, tuples and one another, so that they compare, serialise
(`config.to_plain` / `config.from_plain`), travel as messages of the same field names (`roboxim_ros.conversions`) and
hash (`config.digest`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from roboxim_core.errors import InvalidRequestError
from roboxim_core.poses import IDENTITY, Pose, Vec3

Scalar = str | float | int | bool
RGB = tuple[float, float, float]
"""sRGB colour, each component 0..1."""


@dataclass(frozen=True, kw_only=True)
class PhysicalObject:
    """An object that a task speaks of (thesis 4.2.1): which model, what it is called, how it is modified."""

    entity: str
    """Name of the entity in the scene, unique there, e.g. ``target`` or ``distractor_1``."""
    model: str
    """Id of the object model, e.g. ``cube``."""
    name: str
    """Noun used in instructions, e.g. ``cube``."""
    modifiers: dict[str, Scalar] = field(default_factory=dict)
    """Modifier name to value, e.g. ``{"color": "red", "scale": 1.0}``."""


@dataclass(frozen=True, kw_only=True)
class TaskSpec:
    """A task: a skill, the objects by role, arguments, and the instruction that asks for it."""

    skill: str
    """Registered skill, e.g. ``pick_up``."""
    objects: dict[str, PhysicalObject]
    """Role to object, e.g. ``{"target": ...}``."""
    arguments: dict[str, Scalar] = field(default_factory=dict)
    """Skill-specific arguments and thresholds, e.g. ``{"lift_m": 0.05}``."""
    instruction: str
    """Natural language instruction, e.g. ``Pick up the red cube``."""


@dataclass(frozen=True, kw_only=True)
class EntitySpec:
    """One object placed in a scene."""

    name: str
    """Unique name in the scene."""
    model: str
    """Id of the object model."""
    modifiers: dict[str, Scalar] = field(default_factory=dict)
    """Modifier name to value."""
    pose: Pose = IDENTITY
    """Pose of the object's base link in the world."""
    joint_positions: dict[str, float] = field(default_factory=dict)
    """Joint name to initial position [m or rad]; joints left out start at 0."""
    fixed: bool = False
    """Whether the base is fixed to the world."""


@dataclass(frozen=True, kw_only=True)
class RobotSpec:
    """The robot and its state at the start."""

    model: str = "panda"
    """Id of the robot model."""
    pose: Pose = IDENTITY
    """Pose of the robot's base in the world."""
    joint_positions: tuple[float, ...] = ()
    """Arm joint positions in the model's order [rad]; empty: the model's home."""
    gripper_opening: float = 1.0
    """1 = fully open, 0 = closed, linear in the total opening."""


@dataclass(frozen=True, kw_only=True)
class CameraSpec:
    """A pinhole camera fixed in the world or on a robot link."""

    name: str
    """Unique name; topics are ``camera/<name>/...``."""
    width: int = 256
    """Image width [px], 16..4096."""
    height: int = 256
    """Image height [px], 16..4096."""
    fov_y_rad: float = math.radians(45.0)
    """Vertical field of view [rad]."""
    parent: str = "world"
    """``world`` or the name of a robot link."""
    pose: Pose = IDENTITY
    """Pose of the optical frame (x right, y down, z forward) in the parent."""
    near: float = 0.02
    """Nearest visible distance along the optical axis [m]."""
    far: float = 6.0
    """Farthest visible distance along the optical axis [m]."""
    depth: bool = False
    """Whether metric depth is published."""
    segmentation: bool = False
    """Whether entity segmentation is published."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            InvalidRequestError: On a size, field of view or clipping range that makes no image.
        """
        if not (16 <= self.width <= 4096 and 16 <= self.height <= 4096):
            raise InvalidRequestError(f"camera '{self.name}': size must be 16..4096 px, got {self.width}x{self.height}")
        if not 0.01 < self.fov_y_rad < 3.0:
            raise InvalidRequestError(f"camera '{self.name}': fov_y_rad must be 0.01..3, got {self.fov_y_rad}")
        if not 0.0 < self.near < self.far:
            raise InvalidRequestError(f"camera '{self.name}': needs 0 < near < far, got {self.near}, {self.far}")


@dataclass(frozen=True, kw_only=True)
class LightSpec:
    """A light. A directional one is a sun; a positional one a lamp."""

    kind: str = "sun"
    """``sun`` or ``lamp``."""
    direction: Vec3 = (0.35, -0.25, -1.0)
    """Direction that a sun's light travels in, in the world (any length > 0)."""
    position: Vec3 = (0.0, 0.0, 2.0)
    """Position of a lamp in the world [m]."""
    color: RGB = (1.0, 0.97, 0.92)
    """Colour of the light."""
    intensity: float = 2.3
    """Radiance factor; a white diffuse surface facing an unshadowed sun of 3.14 is about white. A lamp's is what
    arrives at the world's origin."""
    shadow: bool = True
    """Whether it casts shadows."""


@dataclass(frozen=True, kw_only=True)
class MaterialSpec:
    """Metallic-roughness material of a surface."""

    color: RGB = (0.7, 0.7, 0.7)
    """Base colour."""
    metallic: float = 0.0
    """0 = dielectric, 1 = metal."""
    roughness: float = 0.6
    """0 = mirror, 1 = chalk."""
    texture: str = ""
    """Name of a built-in texture, multiplied with the colour; empty: none."""


@dataclass(frozen=True, kw_only=True)
class LookSpec:
    """How the scene looks besides its entities."""

    table: MaterialSpec = MaterialSpec(color=(0.72, 0.56, 0.42), roughness=0.55, texture="wood")
    """Material of the table's top."""
    floor: MaterialSpec = MaterialSpec(color=(0.44, 0.45, 0.47), roughness=0.9)
    """Material of the floor."""
    wall: MaterialSpec = MaterialSpec(color=(0.92, 0.92, 0.9), roughness=0.95)
    """Material of the wall behind the table."""
    ambient: RGB = (0.54, 0.55, 0.58)
    """Radiance of the surroundings (image-based light's mean)."""
    lights: tuple[LightSpec, ...] = (LightSpec(),)
    """Lights; the first one that casts a shadow is the main light."""


@dataclass(frozen=True, kw_only=True)
class TableSpec:
    """The table in front of the robot; its top is at z = 0."""

    center: Vec3 = (0.5, 0.0, 0.0)
    """Centre of the top's surface in the world [m]."""
    size: Vec3 = (0.9, 1.4, 0.05)
    """Extent of the top along x, y, z [m]."""
    friction: float = 0.8
    """Lateral friction coefficient."""


@dataclass(frozen=True, kw_only=True)
class WorkspaceSpec:
    """Box in the world that the commanded tool centre point stays in."""

    lower: Vec3 = (0.2, -0.5, 0.002)
    """Lower corner [m]."""
    upper: Vec3 = (0.8, 0.5, 0.7)
    """Upper corner [m]."""
    on_leave: str = "clamp"
    """``clamp``, or ``fail``: the episode ends as ``left_workspace``."""


@dataclass(frozen=True, kw_only=True)
class SceneSpec:
    """All that the sim needs to rebuild a world: same spec, same bits."""

    robot: RobotSpec = RobotSpec()
    """The robot."""
    table: TableSpec = TableSpec()
    """The table."""
    entities: tuple[EntitySpec, ...] = ()
    """The objects, in the order in which they are built."""
    cameras: tuple[CameraSpec, ...] = ()
    """The cameras."""
    look: LookSpec = LookSpec()
    """Materials and lights."""
    workspace: WorkspaceSpec = WorkspaceSpec()
    """Bounds of the commanded tool centre point."""
    control_rate_hz: float = 10.0
    """Ticks per simulated second; must divide ``physics_rate_hz``."""
    physics_rate_hz: float = 240.0
    """Physics steps per simulated second."""
    settle_steps: int = 60
    """Physics steps run after building, before tick 0."""

    def __post_init__(self) -> None:
        """Check names and rates.

        Raises:
            InvalidRequestError: On a duplicate name or a control rate that does not divide the physics rate.
        """
        for kind, names in (
            ("entity", [entity.name for entity in self.entities]),
            ("camera", [camera.name for camera in self.cameras]),
        ):
            twice = sorted({name for name in names if names.count(name) > 1 or not name})
            if twice:
                raise InvalidRequestError(f"{kind} names must be unique and not empty, got {twice} more than once")
        if self.control_rate_hz <= 0 or (self.physics_rate_hz / self.control_rate_hz) % 1:
            raise InvalidRequestError(
                f"control_rate_hz must divide the physics rate of {self.physics_rate_hz:g} Hz, "
                f"got {self.control_rate_hz:g}; for example 5, 8, 10, 12, 15, 20, 24, 30"
            )

    def entity(self, name: str) -> EntitySpec:
        """Return an entity by name.

        Raises:
            InvalidRequestError: When there is none of that name.
        """
        for entity in self.entities:
            if entity.name == name:
                return entity
        raise InvalidRequestError(f"no entity '{name}' in the scene; there are {[e.name for e in self.entities]}")

    @property
    def tick_ns(self) -> int:
        """Length of a tick [ns]."""
        return round(1e9 / self.control_rate_hz)
