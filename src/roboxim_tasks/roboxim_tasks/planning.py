"""What the expert needs of the planner, as a small port: served by ROS clients, or by the planner's core in tests."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

from roboxim_core.poses import Array, Pose
from roboxim_core.specs import SceneSpec
from roboxim_core.state import EntityState, StateRecord


@dataclass(frozen=True, kw_only=True)
class Surroundings:
    """What a motion must not collide with: the scene at one tick, with what changes during the motion."""

    scene: SceneSpec
    """The scene."""
    state: StateRecord
    """The tick; it names the revision of the scene that the planner is asked about."""
    opening: float = 1.0
    """Opening of the gripper during the motion, 1 = open."""
    held: str = ""
    """Entity in the gripper, no obstacle any more; empty: none."""
    held_in_tcp: Pose = Pose()
    """Its pose in the tool centre point's frame."""
    touching: tuple[tuple[str, str], ...] = ()
    """Pairs of bodies that may touch."""
    padding_m: float = 0.0
    """Distance that a checked path keeps from what it may not touch [m]."""
    moved: tuple[EntityState, ...] = ()
    """Entities that are elsewhere than in ``state`` by the time of the motion; poses in the world."""

    @property
    def state_then(self) -> StateRecord:
        """The state with the moved entities where they are by the time of the motion."""
        moved = {entity.name: entity for entity in self.moved}
        return replace(self.state, entities=tuple(moved.get(e.name, e) for e in self.state.entities))


class PlannerPort(Protocol):
    """The planner as the expert sees it."""

    def plan_to_pose(self, joints: Array, pose_tcp_in_world: Pose, around: Surroundings, seed: int) -> Array:
        """Return a collision-free joint path from joints to a pose, shape (n, joints) [rad].

        Raises:
            PlannerError: When there is none.
        """
        ...

    def check_path(self, path: Array, period_s: float, around: Surroundings) -> str:
        """Return what is wrong with a joint path of shape (n, joints) [rad], or an empty text.

        Args:
            path: Joint positions, joined by straight lines in joint space.
            period_s: Time between them [s]; the joints' speed limits hold.
            around: What to avoid.
        """
        ...
