"""The value types of robot and object models; `library` loads them from ``config/``."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from roboxim_core.errors import ConfigError
from roboxim_core.poses import IDENTITY, Pose, Vec3
from roboxim_core.specs import MaterialSpec


@dataclass(frozen=True, kw_only=True)
class Shape:
    """A convex collision primitive or hull in its link's frame; in a file also a ``ring``, a wall made of boxes."""

    kind: str
    """``box``, ``sphere``, ``cylinder``, ``capsule`` (both along z), ``hull``; ``ring``: becomes boxes when loaded."""
    size: tuple[float, ...] = ()
    """box: extents x, y, z; sphere: (radius,); cylinder: (radius, length); capsule: (radius, cylinder length);
    ring: (outer radius at its lower end, at its upper end, height, thickness) [m], along z and centred."""
    mesh: str = ""
    """For a hull: absolute path of the mesh whose convex hull it is."""
    scale: float = 1.0
    """Factor on a mesh's coordinates, e.g. 0.001 for a file in millimetres."""
    segments: int = 16
    """Boxes of a ring."""
    pose: Pose = IDENTITY
    """Pose in the link."""


MOST_JOINTS = 64
"""Most joints of an arm that the planner's kernel takes."""
MAX_SHAPES = 16
"""Most collision shapes of one link that PyBullet takes; it silently drops further ones. Boxes are packed into one."""


@dataclass(frozen=True, kw_only=True)
class Visual:
    """A visual shape in a link's frame."""

    kind: str
    """A shape's kind, ``mesh``, or the name of a registered visual generator."""
    size: tuple[float, ...] = ()
    """As for `Shape`; a generator defines its own numbers."""
    mesh: str = ""
    """For a mesh: absolute path."""
    scale: Vec3 = (1.0, 1.0, 1.0)
    """Factors on the coordinates along x, y, z, before the pose."""
    pose: Pose = IDENTITY
    """Pose in the link."""
    material: MaterialSpec = MaterialSpec()
    """Material."""
    tinted: bool = False
    """Whether the ``color`` modifier replaces the material's colour, and the ``material`` modifier its surface."""


@dataclass(frozen=True, kw_only=True)
class LinkModel:
    """A rigid link."""

    name: str = ""
    """Name; a rigid object's single link is ``""``."""
    mass: float = 0.0
    """Mass [kg]."""
    collision: tuple[Shape, ...] = ()
    """Collision geometry."""
    visual: tuple[Visual, ...] = ()
    """Visual geometry."""


@dataclass(frozen=True, kw_only=True)
class Friction:
    """Contact parameters of a body."""

    lateral: float = 0.8
    """Coulomb coefficient."""
    spinning: float = 0.002
    """Torsional coefficient [m]."""
    rolling: float = 0.001
    """Rolling coefficient [m]."""


@dataclass(frozen=True, kw_only=True)
class JointModel:
    """A one-degree-of-freedom joint of an object."""

    name: str
    """Name."""
    kind: str
    """``prismatic`` or ``revolute``."""
    parent: str
    """Parent link."""
    child: str
    """Child link."""
    pose: Pose = IDENTITY
    """Pose of the joint in the parent."""
    axis: Vec3 = (0.0, 0.0, 1.0)
    """Axis in the joint's frame, of any length."""
    lower: float = 0.0
    """Lower limit [m or rad]."""
    upper: float = 0.0
    """Upper limit [m or rad]."""
    resistance: float = 0.0
    """Friction force or torque that holds the joint in place, e.g. of a drawer that stays open [N or N m]."""
    damping: float = 0.0
    """Force or torque against its motion, proportional to its speed [N s/m or N m s/rad]."""
    spring: float = 0.0
    """Force or torque that returns it to position 0, e.g. a button; excludes ``resistance`` [N or N m]."""

    def __post_init__(self) -> None:
        """Give the axis the length 1: PyBullet moves a sliding joint by its position times the length.

        Raises:
            ConfigError: When the axis has no direction.
        """
        object.__setattr__(self, "axis", unit_axis(self.axis, f"joint '{self.name}': axis"))


def unit_axis(axis: Vec3, where: str) -> Vec3:
    """Return the unit vector of an axis.

    Args:
        axis: Vector of any length.
        where: What it is, for the message.

    Raises:
        ConfigError: When it has no direction.
    """
    length = float(np.linalg.norm(axis))
    if not 0.0 < length < np.inf:
        raise ConfigError(f"{where} has no direction, got {axis[0]:g} {axis[1]:g} {axis[2]:g}")
    return (axis[0] / length, axis[1] / length, axis[2] / length)


@dataclass(frozen=True, kw_only=True)
class GraspAnnotation:
    """A family of grasps in the object's frame.

    A gripper turned by 180 degrees about its own z axis grasps equally well; a family lists one of the two poses.
    """

    name: str
    """Name of the family, e.g. ``top``, ``side``, ``rim``, ``handle``."""
    link: str = ""
    """Link whose frame the pose is in; empty: the base."""
    pose: Pose
    """Pose of the tool centre point in the link (z of the tool points into the object, y is the closing direction)."""
    yaw_symmetry_rad: float = 0.0
    """Angle about the object's z axis after which the grasp repeats [rad]; 0: no repetition."""
    opening_m: float = 0.08
    """Opening of the gripper before the grasp [m]."""
    width_m: float = 0.0
    """Width of what is grasped [m]."""


@dataclass(frozen=True, kw_only=True)
class Region:
    """A place for other objects: on a surface, or inside an interior."""

    name: str = ""
    """Name, e.g. ``top`` of three drawers; empty where there is only one."""
    kind: str
    """``surface``, or ``interior``."""
    link: str = ""
    """Link whose frame the pose is in; empty: the base."""
    shape: str = "rectangle"
    """``rectangle`` or ``disc`` (of the smaller of the sizes along x and y)."""
    pose: Pose = IDENTITY
    """Pose of the middle of the surface, or of the interior's floor, in the link; z points up."""
    size: Vec3
    """Extents along x and y, and height [m]: that of an interior up to its rim, 0 for a surface."""


@dataclass(frozen=True, kw_only=True)
class Handle:
    """A handle that opens and closes a part."""

    name: str
    """Name of the part in instructions, e.g. ``top``."""
    link: str
    """Link that it is on."""
    joint: str
    """Joint that opens the part: closed at `JointModel.lower`, fully open at `JointModel.upper`."""
    pose: Pose
    """Pose of the middle of the bar in the link; x points where the link moves when it is opened."""
    grasps: tuple[GraspAnnotation, ...] = ()
    """Grasps of the bar, best first."""


@dataclass(frozen=True, kw_only=True)
class PressPoint:
    """Something to press."""

    name: str = ""
    """Name, where there are several."""
    link: str
    """Link that moves when pressed."""
    joint: str
    """Its joint; the position grows when it is pressed."""
    pose: Pose
    """Pose of the middle of the face in the link; z points out of it, against the press."""
    pressed_at: float
    """Joint position from which the button counts as pressed [m]."""


AFFORDANCES = (
    "graspable",
    "support",
    "container",
    "articulated",
    "openable",
    "pressable",
    "flippable",
    "hinged",
    "turnable",
    "upright",
    "pushable",
)
"""Abilities of an object: ``support`` has surfaces, ``container`` interiors, ``openable`` handles,
``pressable`` press points; ``flippable`` has a lever, ``hinged`` a door and ``turnable`` a knob, each with the first
handle; ``upright`` can topple and be put upright; ``pushable`` moves steadily when pushed."""


@dataclass(frozen=True, kw_only=True)
class ObjectNotes:
    """Fields that an object's file and its model share."""

    name: str
    """Noun used in instructions."""
    joints: tuple[JointModel, ...] = ()
    """Joints."""
    friction: Friction = Friction()
    """Contact parameters."""
    grasps: tuple[GraspAnnotation, ...] = ()
    """Grasps, best first."""
    affordances: tuple[str, ...] = ()
    """Of `AFFORDANCES`."""
    regions: tuple[Region, ...] = ()
    """Places for other objects, best first."""
    handles: tuple[Handle, ...] = ()
    """Handles that open it."""
    press_points: tuple[PressPoint, ...] = ()
    """Points to press."""
    toppled: tuple[Pose, ...] = ()
    """Poses of the base, above a support whose surface is at z = 0, in which it lies toppled; any yaw."""
    yaw_symmetry_rad: float = 0.0
    """Angle of rotational symmetry about z [rad]; 0: no symmetry."""


@dataclass(frozen=True, kw_only=True)
class ObjectModel(ObjectNotes):
    """An object with its modifiers applied."""

    id: str
    """Id, e.g. ``cube``."""
    links: tuple[LinkModel, ...]
    """Links; the first is the base."""
    size: Vec3
    """Extents of the smallest box that holds all links with all joints at 0, is centred on the base frame along x and
    y, and reaches from ``-rest_height`` up [m]."""
    rest_height: float
    """Height of the base frame above a support when it stands on it, z upwards [m]."""


@dataclass(frozen=True, kw_only=True)
class FollowerJoint:
    """A joint of a finger that moves in a fixed ratio with a driven one: ``<mimic>`` of a URDF."""

    name: str
    """Name."""
    leader: str
    """Driven joint, of `GripperModel.joint_names`."""
    ratio: float
    """Its position per position of the leader."""


@dataclass(frozen=True, kw_only=True)
class GripperModel:
    """A gripper with two fingers that move alike, or one jaw that moves against a fixed one, and one opening."""

    joint_names: tuple[str, ...]
    """The driven joint of each finger; both have the same position. One joint: a jaw that moves against a fixed one.
    The tool centre point is then on the face of the fixed jaw, and the moving jaw is on the side of its +y."""
    max_opening_m: float
    """Total opening when fully open [m]."""
    force_n: float
    """Force of each finger where it holds an object [N]."""
    speed_m_s: float
    """Speed of each finger [m/s]."""
    keeps_speed: bool = False
    """Whether the simulated motors keep to `speed_m_s`. The Franka hand uses faster ones, as in all its episodes."""
    links: tuple[str, ...] = ()
    """Links that may touch a held object: the hand, the two finger tips, the fixed one first, and what else moves with
    the fingers."""
    followers: tuple[FollowerJoint, ...] = ()
    """Further joints of the fingers, e.g. those that keep the finger tips parallel."""
    opening_map: tuple[tuple[float, float], ...] = ()
    """Total opening [m] and position of a driven joint [m or rad], from closed to open; linear in between. Empty:
    fingers that slide, each by half of the opening."""
    arm_m: float = 1.0
    """Torque of a driven joint per force of its finger [m]; 1: fingers that slide."""

    def __post_init__(self) -> None:
        """Check that followers have leaders and that the map is one.

        Raises:
            ConfigError: Naming the entry.
        """
        if len(self.joint_names) not in (1, 2):
            raise ConfigError(f"gripper: expected the driven joints of 1 or 2 fingers, got {len(self.joint_names)}")
        if self.one_jaw and not self.opening_map:
            raise ConfigError("gripper: one moving jaw needs an opening_map: opening [m] and position of its joint")
        for follower in self.followers:
            if follower.leader not in self.joint_names:
                raise ConfigError(
                    f"gripper: follower '{follower.name}': no driven joint '{follower.leader}'; "
                    f"expected one of {', '.join(self.joint_names)}"
                )
        openings, positions = [row[0] for row in self.opening_map], [row[1] for row in self.opening_map]
        if openings and (len(openings) < 2 or any(b <= a for a, b in itertools.pairwise(openings))):
            raise ConfigError("gripper: opening_map: expected two or more rows with rising openings")
        if not _one_way(positions):
            raise ConfigError("gripper: opening_map: joint positions must rise or fall throughout")
        if openings and abs(openings[-1] - self.max_opening_m) > 1e-6:
            raise ConfigError(f"gripper: opening_map ends at {openings[-1]} m, not at max_opening_m")

    def driven(self, opening: float) -> float:
        """Return the position of each driven joint [m or rad] at an opening, 0 = closed, 1 = open."""
        if not self.opening_map:
            return opening * self.max_opening_m / 2
        openings, positions = zip(*self.opening_map, strict=True)
        return float(np.interp(opening * self.max_opening_m, openings, positions))

    def opening(self, positions: Sequence[float]) -> float:
        """Return the opening, 0 = closed, 1 = open, at positions of the driven joints [m or rad]."""
        total = sum(positions)
        if self.opening_map:
            openings, places = zip(*sorted(self.opening_map, key=lambda row: row[1]), strict=True)
            total = float(np.interp(total / len(positions), places, openings))
        return min(1.0, max(0.0, total / self.max_opening_m))

    def followed(self, positions: Sequence[float]) -> tuple[float, ...]:
        """Return the positions of the followers, given those of the driven joints [m or rad]."""
        leaders = dict(zip(self.joint_names, positions, strict=True))
        return tuple(follower.ratio * leaders[follower.leader] for follower in self.followers)

    @property
    def lever(self) -> float:
        """Mean travel of a finger tip per position of its driven joint: 1 if it slides, else [m/rad]."""
        if not self.opening_map:
            return 1.0
        (closed, first), (opened, last) = self.opening_map[0], self.opening_map[-1]
        return (opened - closed) / len(self.joint_names) / abs(last - first)

    @property
    def one_jaw(self) -> bool:
        """Whether one jaw moves against a fixed one."""
        return len(self.joint_names) == 1

    @property
    def travel_m(self) -> float:
        """Way of a finger from closed to open [m]."""
        return self.max_opening_m / len(self.joint_names)


def _one_way(values: Sequence[float]) -> bool:
    steps = [b - a for a, b in itertools.pairwise(values)]
    return all(step > 0 for step in steps) or all(step < 0 for step in steps)


@dataclass(frozen=True, kw_only=True)
class JointLimits:
    """Limits of the arm's joints, in the order of `RobotModel.joint_names`."""

    lower: tuple[float, ...]
    """[rad]."""
    upper: tuple[float, ...]
    """[rad]."""
    velocity: tuple[float, ...]
    """[rad/s]."""
    acceleration: tuple[float, ...]
    """[rad/s^2]."""
    jerk: tuple[float, ...]
    """[rad/s^3]."""
    effort: tuple[float, ...]
    """[N m]."""


@dataclass(frozen=True, kw_only=True)
class ClosePair:
    """A pair of links that come so close that one's collision mesh is too coarse; the SRDF disables the pair."""

    link: str
    """First link, checked with its collision geometry."""
    other: str
    """Second link, checked with ``parts`` against the first."""
    parts: tuple[str, ...]
    """Convex mesh files in the second link's frame."""


@dataclass(frozen=True, kw_only=True)
class RobotModel:
    """An arm with a gripper: a YAML file of ``config/robots``, whose files are relative to its folder."""

    id: str = ""
    """Id, e.g. ``panda``: the name of its file."""
    urdf: Path
    """URDF that sim and planner both load; its meshes are ``package://<robot id>/...``."""
    srdf: Path
    """SRDF with the disabled collision pairs."""
    base_link: str
    """Root link."""
    tcp_link: str
    """Frame of the tool centre point: between the finger tips, z forward out of the hand, y along the opening."""
    joint_names: tuple[str, ...]
    """Arm joints."""
    limits: JointLimits
    """Their limits, from the maker's data sheet."""
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
    close_pairs: tuple[ClosePair, ...] = ()
    """Pairs of links that the planner checks with finer geometry."""
    mesh_colors: str = "srgb"
    """What the colour factors in the GLB files of its URDF are: ``srgb``, as `roboxim robot new` writes them, or
    ``linear``, as glTF states. Textures are sRGB in both."""
    rotations: int = 3
    """Directions in which the tool turns while it stays where it is: 3 with six joints or more, 2 with five. With 2,
    the tool goes to a place first and turns as far as it can there, and skills that need all three are refused."""
    start: tuple[float, ...] = ()
    """Box of an arm that does not reach where tasks begin, in the base: least x, y, z and greatest x, y, z of the tool
    centre point [m]. Starts are drawn from the part of a task's box that is inside; along an axis on which none is,
    from this box. Empty: the tasks' own."""
    stand: tuple[float, ...] = ()
    """Rectangle on the table that the arm's stand covers, in the base: least x and y, greatest x and y [m]. Objects are
    placed off it. Empty: the arm stands beside the table."""

    def __post_init__(self) -> None:
        """Check the number of joints, one number per joint in each list, the colours' meaning, rotations, start, stand.

        Raises:
            ConfigError: Naming the list.
        """
        if not 1 <= len(self.joint_names) <= MOST_JOINTS:
            raise ConfigError(f"joint_names: expected 1 to {MOST_JOINTS} joints of an arm, got {len(self.joint_names)}")
        if self.mesh_colors not in ("srgb", "linear"):
            raise ConfigError(f"mesh_colors: expected srgb or linear, got '{self.mesh_colors}'")
        if self.stand and (len(self.stand) != 4 or self.stand[0] >= self.stand[2] or self.stand[1] >= self.stand[3]):
            raise ConfigError(f"stand: expected least x, least y, greatest x, greatest y, got {list(self.stand)}")
        least, greatest = self.start[:3], self.start[3:]
        if self.start and (len(self.start) != 6 or any(a >= b for a, b in zip(least, greatest, strict=True))):
            raise ConfigError(f"start: expected least x, y, z and greatest x, y, z, got {list(self.start)}")
        possible = max(0, min(3, len(self.joint_names) - 3))
        if not 0 <= self.rotations <= possible:
            raise ConfigError(
                f"rotations: an arm of {len(self.joint_names)} joints turns its tool in up to {possible} directions, "
                f"got {self.rotations}"
            )
        lists = {
            **asdict(self.limits),
            "home": self.home,
            "motor_force": self.motor_force,
            **self.named_states,
        }
        for name, values in lists.items():
            if len(values) != len(self.joint_names):
                raise ConfigError(f"{name} must have {len(self.joint_names)} numbers, one per joint, got {len(values)}")
