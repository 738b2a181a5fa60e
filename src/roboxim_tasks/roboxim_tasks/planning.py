"""The expert's port to the planner, served by ROS clients or, without a node graph, by the planner's core."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

from roboxim_core.poses import Array, Pose
from roboxim_core.specs import SceneSpec
from roboxim_core.state import EntityState, StateRecord


@dataclass(frozen=True, kw_only=True)
class Surroundings:
    """Obstacles of a motion: the scene at one tick, with the changes during the motion."""

    scene: SceneSpec
    """The scene."""
    state: StateRecord
    """State at the tick; it identifies the scene's revision in requests to the planner."""
    opening: float = 1.0
    """Opening of the gripper during the motion, 1 = open."""
    held: str = ""
    """Entity in the gripper, which is no longer an obstacle; empty: none."""
    held_in_tcp: Pose = Pose()
    """Its pose in the tool centre point's frame."""
    touching: tuple[tuple[str, str], ...] = ()
    """Pairs of bodies that may touch."""
    padding_m: float = 0.0
    """Distance that a checked path keeps from bodies that it may not touch [m]."""
    moved: tuple[EntityState, ...] = ()
    """Entities that have left their pose in ``state`` by the time of the motion; poses in the world."""

    @property
    def state_then(self) -> StateRecord:
        """The state with the moved entities at their poses at the time of the motion."""
        moved = {entity.name: entity for entity in self.moved}
        return replace(self.state, entities=tuple(moved.get(e.name, e) for e in self.state.entities))


class PlannerPort(Protocol):
    """Interface of the planner to the expert."""

    def plan_to_pose(self, joints: Array, pose_tcp_in_world: Pose, around: Surroundings, seed: int) -> Array:
        """Return a collision-free joint path from joints to a pose, shape (n, joints) [rad].

        Raises:
            PlannerError: When there is no such path.
        """
        ...

    def check_path(self, path: Array, period_s: float, around: Surroundings) -> str:
        """Return the violations of a joint path of shape (n, joints) [rad], or an empty text.

        Args:
            path: Joint positions, joined by straight lines in joint space.
            period_s: Time between two positions [s]; the joints' speed limits apply.
            around: Obstacles to avoid.
        """
        ...
