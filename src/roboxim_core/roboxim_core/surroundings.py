"""Obstacles of a motion, as tasks pass them to the planner."""

from __future__ import annotations

from dataclasses import dataclass, replace

from roboxim_core.poses import Pose
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
    """Entities that have moved between ``state`` and the motion, with their new poses in the world."""

    @property
    def state_then(self) -> StateRecord:
        """The state with the moved entities at their poses at the time of the motion."""
        moved = {entity.name: entity for entity in self.moved}
        return replace(self.state, entities=tuple(moved.get(e.name, e) for e in self.state.entities))
