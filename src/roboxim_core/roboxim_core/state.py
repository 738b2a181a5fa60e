"""The state record of a tick: everything an evaluator, a planner or a re-renderer needs, as plain values."""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass, field

from roboxim_core.poses import IDENTITY, Pose, Vec3


@dataclass(frozen=True, kw_only=True)
class EntityState:
    """State of one object at the end of a tick."""

    name: str
    """Name of the entity."""
    pose: Pose = IDENTITY
    """Pose of its base link in the world."""
    linear_velocity: Vec3 = (0.0, 0.0, 0.0)
    """Velocity of its base link's centre of mass in the world [m/s]; that of the pose's origin differs as it turns."""
    angular_velocity: Vec3 = (0.0, 0.0, 0.0)
    """Angular velocity of its base link in the world [rad/s]."""
    fastest_fall: float = 0.0
    """Largest downward speed of that centre of mass over the tick's physics steps [m/s]; 0: it never moved down."""
    joint_names: tuple[str, ...] = ()
    """Names of its joints; empty for a rigid object."""
    joint_positions: tuple[float, ...] = ()
    """Positions of its joints [m or rad]."""
    joint_lowest: tuple[float, ...] = ()
    """Lowest position of each joint over the tick's physics steps [m or rad]."""
    joint_highest: tuple[float, ...] = ()
    """Highest position of each joint over the tick's physics steps [m or rad]."""


@dataclass(frozen=True, kw_only=True)
class RobotState:
    """State of the robot at the end of a tick."""

    joint_names: tuple[str, ...]
    """Names of the arm joints, in the model's order."""
    joint_positions: tuple[float, ...]
    """Measured arm joint positions [rad]."""
    joint_velocities: tuple[float, ...]
    """Measured arm joint velocities [rad/s]."""
    joint_commands: tuple[float, ...]
    """Commanded arm joint positions [rad]."""
    pose_tcp_measured: Pose
    """Measured pose of the tool centre point in the world."""
    pose_tcp_commanded: Pose
    """Commanded pose of the tool centre point in the world, to which deltas are added."""
    gripper_opening: float
    """Measured opening, 1 = open, 0 = closed."""
    gripper_command: float
    """Commanded opening, 1 = open, 0 = closed."""
    finger_positions: tuple[float, ...] = ()
    """Measured positions of the fingers' driven joints [m, or rad of fingers that turn]."""
    joint_efforts: tuple[float, ...] = ()
    """Torque of each arm motor in the tick's last physics step [N m]."""
    finger_velocities: tuple[float, ...] = ()
    """Their velocities [m/s or rad/s]."""
    finger_efforts: tuple[float, ...] = ()
    """Force of each finger motor in the tick's last physics step [N]."""


@dataclass(frozen=True, kw_only=True)
class Contact:
    """Contact of two bodies during a tick. Bodies are entity names, ``robot`` or ``table``; base links are ``""``."""

    body_a: str
    """First body; the two bodies are sorted by name."""
    link_a: str
    """Link of the first body."""
    body_b: str
    """Second body."""
    link_b: str
    """Link of the second body."""
    force_last: float
    """Normal force in the tick's last physics step [N]."""
    force_max: float
    """Largest normal force over the tick's physics steps [N]."""
    force_on_b: Vec3 = (0.0, 0.0, 0.0)
    """Sum of the normal forces on the second body in the last physics step, in the world [N]."""


@dataclass(frozen=True, kw_only=True)
class StateRecord:
    """State of the world at one tick; tick 0 is the settled scene."""

    episode_id: str
    """Episode that the tick belongs to."""
    seq: int
    """Number of the tick, from 0. Action k leads from tick k to k + 1."""
    stamp_ns: int
    """Simulated time since tick 0 [ns]."""
    robot: RobotState
    """The robot."""
    entities: tuple[EntityState, ...] = ()
    """The objects, in the scene's order."""
    contacts: tuple[Contact, ...] = ()
    """Contacts during the tick, sorted."""
    action_executed: tuple[float, ...] = ()
    """Action that the controller integrated in this tick, after clipping, float32 values of the episode's semantics:
    7 by default, else one per arm joint and the gripper; empty at tick 0."""
    clipped: bool = False
    """Whether the action exceeded a limit and was clipped."""
    left_workspace: bool = False
    """Whether the commanded tool centre point would have left the workspace in this tick."""
    disturbed: bool = False
    """Whether anything other than this episode's ticks has moved the world since tick 0."""
    state_hash: str = field(default="", compare=True)
    """Hash of the full dynamic state, 32 hexadecimal digits; equal hashes mean equal bits. It does not cover motor
    efforts, which follow from the state and the command."""
    scene_hash: str = ""
    """`roboxim_core.config.digest` of the scene that the state belongs to; empty: unknown."""

    def entity(self, name: str) -> EntityState:
        """Return an entity's state by name.

        Raises:
            KeyError: When the record has no such entity.
        """
        for entity in self.entities:
            if entity.name == name:
                return entity
        raise KeyError(name)

    def contacts_between(self, body_a: str, body_b: str) -> tuple[Contact, ...]:
        """Return the contacts between two bodies, given in any order."""
        first, second = sorted((body_a, body_b))
        return tuple(c for c in self.contacts if c.body_a == first and c.body_b == second)


def hash_floats(*groups: tuple[float, ...] | list[float]) -> str:
    """Hash groups of float64 numbers, bit for bit.

    Returns:
        32 hexadecimal digits (BLAKE2b, 16 bytes). ``-0.0`` counts as ``0.0``.
    """
    digest = hashlib.blake2b(digest_size=16)
    for group in groups:
        digest.update(struct.pack(f"<q{len(group)}d", len(group), *(value + 0.0 for value in group)))
    return digest.hexdigest()
