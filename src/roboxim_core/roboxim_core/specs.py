"""Specifications of tasks and scenes: everything that defines an episode before it runs.

All are frozen plain values made of numbers, strings, tuples and one another. They can be compared, hashed, serialised
(`config.to_plain` / `config.from_plain`) and sent as messages with the same field names
(`roboxim_ros.messages.conversions`).
`config.digest` is a hash that is the same in every process.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

from roboxim_core import limits
from roboxim_core.errors import InvalidRequestError
from roboxim_core.poses import IDENTITY, Pose, Vec3
from roboxim_core.rates import DEFAULT_RATE_HZ, PHYSICS_RATE_HZ, require_control_rate

Scalar = str | float | int | bool
RGB = tuple[float, float, float]
"""sRGB colour, each component 0..1."""
LIGHT_KINDS = ("sun", "lamp")
BACKGROUNDS = ("room", "plain")
LEAVING = ("clamp", "fail")
RESERVED_NAMES = ("robot", "table", "tcp", "world", "floor", "wall", "pedestal")
"""Names of bodies and frames that every scene has; no entity may have one of them."""


def optical_frame(camera: str) -> str:
    """Return the name of a camera's optical frame, the frame of its images."""
    return f"{camera}_optical"


def _hash(spec: Any) -> int:
    """Hash a spec that has mappings as fields, by value."""
    values = (getattr(spec, field.name) for field in fields(spec))
    return hash(tuple(frozenset(value.items()) if isinstance(value, Mapping) else value for value in values))


@dataclass(frozen=True, kw_only=True)
class PhysicalObject:
    """An object that a task refers to: its model, name and modifiers."""

    entity: str
    """Name of the entity in the scene, unique there, e.g. ``target`` or ``distractor_1``."""
    model: str
    """Id of the object model, e.g. ``cube``."""
    name: str
    """Noun used in instructions, e.g. ``cube``."""
    modifiers: dict[str, Scalar] = field(default_factory=dict)
    """Modifier name to value, e.g. ``{"color": "red", "scale": 1.0}``."""

    def __hash__(self) -> int:
        """Return the hash; equal values have equal hashes."""
        return _hash(self)


@dataclass(frozen=True, kw_only=True)
class TaskSpec:
    """A task: a skill, its objects by role, its arguments, and the instruction."""

    skill: str
    """Registered skill, e.g. ``pick_up``."""
    objects: dict[str, PhysicalObject]
    """Role to object, e.g. ``{"target": ...}``."""
    arguments: dict[str, Scalar] = field(default_factory=dict)
    """Skill-specific arguments and thresholds, e.g. ``{"lift_m": 0.05}``."""
    instruction: str
    """Natural language instruction, e.g. ``Pick up the red cube``."""
    drawn: dict[str, str] = field(default_factory=dict)
    """Drawn choices by name, e.g. ``{"target": "apple", "direction": "clockwise", "camera.workspace": "pose_3"}``.

    Results are grouped by them. Lists are recorded with every draw, and numbers of ranges with four digits; positions
    and vectors of ranges are in the scene."""

    @property
    def step_words(self) -> tuple[str, ...]:
        """Sentence of each step of a task of several steps, in order; empty: the task has one step."""
        names = (f"step_{number}.instruction" for number in itertools.count(1))
        return tuple(str(self.arguments[name]) for name in itertools.takewhile(self.arguments.__contains__, names))

    def __hash__(self) -> int:
        """Return the hash; equal values have equal hashes."""
        return _hash(self)


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

    def __post_init__(self) -> None:
        """Check the name and the numbers.

        Raises:
            InvalidRequestError: On a name that is reserved or cannot be part of a frame, or a number out of bounds.
        """
        limits.require_name("entity", self.name, RESERVED_NAMES)
        limits.require_finite(f"the position of '{self.name}'", self.pose.position, limits.LENGTH_M)
        limits.require_finite(f"joint_positions of '{self.name}'", self.joint_positions.values(), limits.LENGTH_M)

    def __hash__(self) -> int:
        """Return the hash; equal values have equal hashes."""
        return _hash(self)


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

    def __post_init__(self) -> None:
        """Check the position of the robot.

        Raises:
            InvalidRequestError: On a position that is not finite or too large.
        """
        limits.require_finite("the robot's position", self.pose.position, limits.LENGTH_M)


@dataclass(frozen=True, kw_only=True)
class CameraNoise:
    """Noise and blur that a camera's sensor adds to the ideal image. All zero: none.

    Source: the linear camera model of EMVA 1288 (photon noise whose variance grows with the signal, plus constant
    read-out noise). The deviation of the depth grows with the square of the distance, as in triangulation.
    """

    shot: float = 0.0
    """Standard deviation of the photon noise of a white pixel, as a fraction of white in linear light."""
    read: float = 0.0
    """Standard deviation of the read-out noise, as a fraction of white in linear light."""
    blur_px: float = 0.0
    """Standard deviation of the lens blur [px]."""
    exposure_ev: float = 0.0
    """Exposure correction [stops]."""
    depth: float = 0.0
    """Standard deviation of the depth at 1 m [m]; grows with the square of the depth."""
    seed: int = 0
    """Seed of the noise; a frame's noise depends on the seed, the camera's name and the tick only."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            InvalidRequestError: On a value out of range.
        """
        limits = {"shot": (0.0, 1.0), "read": (0.0, 1.0), "blur_px": (0.0, 16.0), "exposure_ev": (-8.0, 8.0)}
        for name, (low, high) in {**limits, "depth": (0.0, 1.0), "seed": (0, 2**63)}.items():
            if not low <= getattr(self, name) <= high:
                raise InvalidRequestError(f"camera noise: {name} must be {low:g}..{high:g}, got {getattr(self, name)}")


@dataclass(frozen=True, kw_only=True)
class CameraSpec:
    """A camera fixed in the world or on a robot link: a pinhole with lens distortion and sensor noise.

    Image coordinates are those of ``sensor_msgs/CameraInfo``: (0, 0) is the centre of the upper left pixel.
    """

    name: str
    """Unique name; topics are ``camera/<name>/...``."""
    width: int = 256
    """Image width [px], 16..4096."""
    height: int = 256
    """Image height [px], 16..4096."""
    fov_y_rad: float = math.radians(45.0)
    """Vertical field of view [rad]."""
    parent: str = "world"
    """``world``, the name of a robot link, or ``gripper``, the robot's hand."""
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
    intrinsics: tuple[float, ...] = ()
    """fx, fy, cx, cy [px]; empty: from ``fov_y_rad``, with square pixels and the principal point in the middle."""
    distortion: tuple[float, ...] = ()
    """Lens distortion k1, k2, p1, p2, k3 (``plumb_bob``); empty: none."""
    rate_hz: float = 0.0
    """Frames per simulated second; must divide the control rate; 0: a frame at every tick."""
    noise: CameraNoise = CameraNoise()
    """Noise and blur of the sensor."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            InvalidRequestError: On an invalid size, field of view, intrinsics or clipping range.
        """
        limits.require_name("camera", self.name)
        limits.require_finite(f"camera '{self.name}': position", self.pose.position, limits.LENGTH_M)
        limits.require_finite(f"camera '{self.name}': far", (self.far,), limits.LENGTH_M * 10)
        limits.require_finite(f"camera '{self.name}': intrinsics", self.intrinsics, 1e6)
        limits.require_finite(f"camera '{self.name}': distortion", self.distortion, 100.0)
        limits.require_finite(f"camera '{self.name}': rate_hz", (self.rate_hz,))
        if not (16 <= self.width <= 4096 and 16 <= self.height <= 4096):
            raise InvalidRequestError(f"camera '{self.name}': size must be 16..4096 px, got {self.width}x{self.height}")
        if not 0.01 < self.fov_y_rad < 3.0:
            raise InvalidRequestError(f"camera '{self.name}': fov_y_rad must be 0.01..3, got {self.fov_y_rad}")
        if not 0.0 < self.near < self.far:
            raise InvalidRequestError(f"camera '{self.name}': needs 0 < near < far, got {self.near}, {self.far}")
        if self.intrinsics and (len(self.intrinsics) != 4 or min(self.intrinsics[:2]) <= 0):
            raise InvalidRequestError(
                f"camera '{self.name}': intrinsics are fx, fy, cx, cy with fx, fy > 0, got {self.intrinsics}"
            )
        if len(self.distortion) not in (0, 5):
            raise InvalidRequestError(
                f"camera '{self.name}': distortion is k1, k2, p1, p2, k3 or nothing, got {self.distortion}"
            )
        if self.rate_hz < 0:
            raise InvalidRequestError(f"camera '{self.name}': rate_hz must be >= 0, got {self.rate_hz}")

    @property
    def matrix(self) -> tuple[float, float, float, float]:
        """Focal lengths and principal point fx, fy, cx, cy [px], from ``intrinsics`` or from ``fov_y_rad``."""
        if self.intrinsics:
            fx, fy, cx, cy = self.intrinsics
            return fx, fy, cx, cy
        focal = self.height / 2 / math.tan(self.fov_y_rad / 2)
        return focal, focal, self.width / 2 - 0.5, self.height / 2 - 0.5

    def resized(self, width: int, height: int) -> CameraSpec:
        """Return the camera with another resolution and accordingly scaled ``intrinsics``, if they are given."""
        intrinsics: tuple[float, ...] = ()
        if self.intrinsics:
            fx, fy, cx, cy = self.intrinsics
            x, y = width / self.width, height / self.height
            intrinsics = (fx * x, fy * y, (cx + 0.5) * x - 0.5, (cy + 0.5) * y - 0.5)
        return replace(self, width=width, height=height, intrinsics=intrinsics)

    def ticks_per_frame(self, control_rate_hz: float) -> int:
        """Return the number of ticks per frame.

        Raises:
            InvalidRequestError: When the camera's rate does not divide the control rate.
        """
        ratio = control_rate_hz / self.rate_hz if self.rate_hz else 1.0
        if abs(ratio - round(ratio)) > 1e-6 or round(ratio) < 1:
            raise InvalidRequestError(
                f"camera '{self.name}': rate_hz must be the control rate of {control_rate_hz:g} Hz divided by a whole "
                f"number, or 0 for a frame at every tick; got {self.rate_hz:g}"
            )
        return round(ratio)


@dataclass(frozen=True, kw_only=True)
class LightSpec:
    """A light: a directional ``sun`` or a positional ``lamp``."""

    kind: str = "sun"
    """``sun`` or ``lamp``."""
    direction: Vec3 = (0.35, -0.25, -1.0)
    """Direction that a sun's light travels in, in the world (any length > 0)."""
    position: Vec3 = (0.0, 0.0, 2.0)
    """Position of a lamp in the world [m]."""
    color: RGB = (1.0, 0.97, 0.92)
    """Colour of the light."""
    intensity: float = 2.3
    """Radiance factor; a white diffuse surface that faces an unshadowed sun of 3.14 is about white. For a lamp, the
    intensity that arrives at the world's origin."""
    shadow: bool = True
    """Whether it casts shadows."""
    radius: float = 0.04
    """Radius of a lamp [m], angular radius of a sun [rad]; a larger radius gives softer shadow edges."""

    def __post_init__(self) -> None:
        """Check kind, direction and size.

        Raises:
            InvalidRequestError: Naming the wrong field.
        """
        if self.kind not in LIGHT_KINDS:
            raise InvalidRequestError(f"a light's kind is {' or '.join(LIGHT_KINDS)}, got {limits.echo(self.kind)}")
        limits.require_finite("a light's direction", self.direction, 1e6)
        limits.require_finite("a light's position", self.position, limits.LENGTH_M * 10)
        limits.require_finite("a light's colour and intensity", (*self.color, self.intensity), 1e6)
        if self.kind == "sun" and not any(self.direction):
            raise InvalidRequestError("a sun's direction must not be zero")
        if self.intensity < 0 or not 0 <= self.radius <= 1:
            raise InvalidRequestError(
                f"a light needs intensity >= 0 and a radius of 0..1, got {self.intensity} and {self.radius}"
            )


@dataclass(frozen=True, kw_only=True)
class MaterialSpec:
    """Metallic-roughness material of a surface."""

    color: RGB = (0.7, 0.7, 0.7)
    """Base colour in sRGB, 0..1."""
    metallic: float = 0.0
    """0 = dielectric, 1 = metal."""
    roughness: float = 0.6
    """0 = mirror, 1 = chalk."""
    texture: str = ""
    """Name of a built-in texture, multiplied with the colour; empty: none."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            InvalidRequestError: On a colour outside 0..1, or a number that is not finite.
        """
        for value in self.color:
            limits.require_range("red, green and blue of a material's color", value, 0.0, 1.0)
        limits.require_finite("a material's numbers", (self.metallic, self.roughness), 1e6)


@dataclass(frozen=True, kw_only=True)
class LookSpec:
    """Appearance of the scene, without its entities."""

    table: MaterialSpec = MaterialSpec(color=(0.72, 0.56, 0.42), roughness=0.55, texture="wood")
    """Material of the table's top."""
    floor: MaterialSpec = MaterialSpec(color=(0.5, 0.51, 0.53), roughness=0.9, texture="concrete")
    """Material of the floor."""
    wall: MaterialSpec = MaterialSpec(color=(0.92, 0.92, 0.9), roughness=0.95, texture="plaster")
    """Material of the wall behind the table."""
    ambient: RGB = (0.54, 0.55, 0.58)
    """Mean radiance of the surroundings (image-based light)."""
    lights: tuple[LightSpec, ...] = (LightSpec(),)
    """Lights, at most 4 with the renderer `raster`; the first one that casts a shadow is the main light."""
    background: str = "room"
    """``room``: walls around the table; ``plain``: no walls, the backdrop colour instead."""
    backdrop: RGB = (0.76, 0.77, 0.79)
    """sRGB colour of pixels that show no surface."""

    def __post_init__(self) -> None:
        """Check the background.

        Raises:
            InvalidRequestError: On an unknown kind of background.
        """
        if self.background not in BACKGROUNDS:
            raise InvalidRequestError(
                f"the background is {' or '.join(BACKGROUNDS)}, got {limits.echo(self.background)}"
            )
        limits.require_count("lights", len(self.lights), limits.LIGHTS)
        limits.require_finite("ambient and backdrop", (*self.ambient, *self.backdrop), 1e6)


@dataclass(frozen=True, kw_only=True)
class TableSpec:
    """The table in front of the robot; its top is at z = 0."""

    center: Vec3 = (0.5, 0.0, 0.0)
    """Centre of the top's surface in the world [m]."""
    size: Vec3 = (0.9, 1.4, 0.05)
    """Extent of the top along x, y, z [m]."""
    friction: float = 0.8
    """Lateral friction coefficient."""

    def __post_init__(self) -> None:
        """Check position and size.

        Raises:
            InvalidRequestError: On a size, position or friction out of range.
        """
        limits.require_finite("the table's centre", self.center, limits.LENGTH_M)
        for length in self.size:
            limits.require_range("the table's size [m]", length, 0.001, limits.LENGTH_M)
        limits.require_range("the table's friction", self.friction, 0.0, 100.0)


@dataclass(frozen=True, kw_only=True)
class WorkspaceSpec:
    """Box in the world that the commanded tool centre point stays in."""

    lower: Vec3 = (0.2, -0.5, 0.002)
    """Lower corner [m]."""
    upper: Vec3 = (0.8, 0.5, 0.7)
    """Upper corner [m]."""
    on_leave: str = "clamp"
    """``clamp``, or ``fail``: the episode ends as ``left_workspace``."""

    def __post_init__(self) -> None:
        """Check the corners and ``on_leave``.

        Raises:
            InvalidRequestError: When a lower bound exceeds the upper one, or on an unknown ``on_leave``.
        """
        limits.require_finite("the workspace", (*self.lower, *self.upper), limits.LENGTH_M)
        if any(low > high for low, high in zip(self.lower, self.upper, strict=True)):
            raise InvalidRequestError(f"the workspace's lower corner {self.lower} is above its upper one {self.upper}")
        if self.on_leave not in LEAVING:
            raise InvalidRequestError(f"on_leave is {' or '.join(LEAVING)}, got {limits.echo(self.on_leave)}")


@dataclass(frozen=True, kw_only=True)
class SceneSpec:
    """Everything that the sim needs to rebuild a world; equal specs give equal bits."""

    robot: RobotSpec = RobotSpec()
    """The robot."""
    table: TableSpec = TableSpec()
    """The table."""
    entities: tuple[EntitySpec, ...] = ()
    """The objects, in the order in which the sim builds them."""
    cameras: tuple[CameraSpec, ...] = ()
    """The cameras."""
    look: LookSpec = LookSpec()
    """Materials and lights."""
    workspace: WorkspaceSpec = WorkspaceSpec()
    """Bounds of the commanded tool centre point."""
    control_rate_hz: float = DEFAULT_RATE_HZ
    """Ticks per simulated second; must divide ``physics_rate_hz``."""
    physics_rate_hz: float = PHYSICS_RATE_HZ
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
            twice = sorted(name for name, count in Counter(names).items() if count > 1)
            if twice:
                raise InvalidRequestError(f"{kind} names must be unique, got {limits.echo(twice)} more than once")
        limits.require_count("entities", len(self.entities), limits.ENTITIES)
        limits.require_count("cameras", len(self.cameras), limits.CAMERAS)
        pixels = sum(camera.width * camera.height for camera in self.cameras)
        limits.require_count("pixels of all cameras together", pixels, limits.SCENE_PIXELS)
        limits.require_range("physics_rate_hz", self.physics_rate_hz, *limits.PHYSICS_RATE_HZ)
        limits.require_range("settle_steps", self.settle_steps, 0, limits.SETTLE_STEPS)
        slowest = self.physics_rate_hz / limits.TICK_STEPS
        limits.require_range("control_rate_hz", self.control_rate_hz, slowest, self.physics_rate_hz)
        require_control_rate(self.control_rate_hz, self.physics_rate_hz)
        for camera in self.cameras:
            camera.ticks_per_frame(self.control_rate_hz)

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
