"""Check at tick 0 that an episode may begin: the settled scene must match the drawn one.

Most infeasible scenes are refused when they are drawn, before anything is simulated. Two checks need the simulator:
whether every object rests where it was placed, and whether the skill's judge already sees success. Both apply to every
scene, independent of its skill, objects and source.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from roboxim_core.poses import distance
from roboxim_core.specs import EntitySpec, SceneSpec
from roboxim_core.state import EntityState, StateRecord
from roboxim_core.verdicts import Verdict

MOVED_M, TURNED_RAD = 0.002, math.radians(2.0)
"""Largest displacement [m] and turn [rad] of an object that counts as resting where it was placed."""
DROPPED_M = 0.01
"""Largest sinking of an object while settling [m]; its initial height above a support is seldom exact."""
JOINT = 0.01
"""Largest deviation of a joint from its initial position [m or rad]."""
SPEED_M_S, SPIN_RAD_S = 0.01, 0.2
"""Largest linear and angular speed of an object that counts as resting."""


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """A constraint that tick 0 violates."""

    constraint: str
    """Name of the constraint, e.g. ``target_unsettled``."""
    message: str
    """Message: the violation, and how to fix it."""


def start_refusal(scene: SceneSpec, state: StateRecord, verdict: Verdict) -> Refusal | None:
    """Return the constraint that tick 0 violates; None: the episode may begin.

    Note: a scene that must begin in motion sets ``settle_steps: 0``; tick 0 is then the drawn scene, at rest.

    Args:
        scene: The scene as drawn.
        state: Tick 0.
        verdict: The judge's verdict on tick 0.
    """
    specs = {entity.name: entity for entity in scene.entities}
    for entity in state.entities:
        if entity.name in specs and (found := _motion_of(specs[entity.name], entity)):
            return Refusal(
                constraint=f"{entity.name}_unsettled",
                message=f"'{entity.name}' {found}; place its model ({specs[entity.name].model}) where it rests, see "
                "`roboxim assets check`, or give the scene `settle_steps: 0` if it must begin in motion",
            )
    if verdict.failed:
        return Refusal(
            constraint="not_failed_already",
            message=f"the task has failed before the first action ({verdict.reason}); change `reset` or `parameters`",
        )
    if verdict.solved:
        return Refusal(
            constraint="not_solved_already",
            message="every condition of the task holds before the first action; change `reset` or `parameters`",
        )
    return None


def _motion_of(spec: EntitySpec, entity: EntityState) -> str:
    """Describe how an object fails to rest where it was placed; empty if it rests."""
    x, y, z = (now - put for now, put in zip(entity.pose.position, spec.pose.position, strict=True))
    turned_rad = distance(spec.pose, entity.pose)[1]
    if math.hypot(x, y) > MOVED_M or not -DROPPED_M <= z <= MOVED_M or turned_rad > TURNED_RAD:
        return (
            f"has moved by {1e3 * math.hypot(x, y, z):.0f} mm and {math.degrees(turned_rad):.0f} deg from where it "
            "was put"
        )
    positions = dict(zip(entity.joint_names, entity.joint_positions, strict=True))
    for joint, put in spec.joint_positions.items():
        if abs(positions.get(joint, put) - put) > JOINT:
            return f"has its joint '{joint}' at {positions[joint]:.3f} instead of {put:.3f}"
    speed, spin = math.hypot(*entity.linear_velocity), math.hypot(*entity.angular_velocity)
    if speed > SPEED_M_S or spin > SPIN_RAD_S:
        return f"moves at {1e3 * speed:.0f} mm/s and {spin:.2f} rad/s"
    return ""
