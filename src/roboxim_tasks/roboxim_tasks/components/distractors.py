"""Reset component ``distractors``: placement of the objects that the task is not about.

Which objects these are is drawn in `roboxim_tasks.sampling.generators`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from roboxim_core.errors import ConfigError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Array
from roboxim_core.specs import EntitySpec, PhysicalObject, SceneSpec
from roboxim_tasks.components.base import ResetComponent, ResetContext, register
from roboxim_tasks.roles import task_distractors
from roboxim_tasks.sampling.placement import Demand, PlacementConfig, centre, footprint, grown, nearest_distance, place
from roboxim_tasks.sampling.rejection import RejectedError
from roboxim_tasks.task_config import TaskConfig

TARGET = "target"
BLOCK = 20
"""Number of consecutive episodes in which exactly the configured share has a distractor close to the target."""
ROOM_M = 0.01
"""Least width of the ring around a target for the nearest point of a distractor [m]; below it the target is wide."""


@dataclass(frozen=True, kw_only=True)
class NearConfig:
    """Frequency of distractors close to the target."""

    share: float = 0.5
    """Share of the episodes in which the first distractor lies close to the target; in the others none does."""
    distance_m: float = 0.10
    """Largest distance from the middle of the target to the nearest point of the distractor [m].

    If the target and the gap take up that distance, it counts from the nearest point of the target to the middle of the
    distractor."""
    gap_m: float = 0.03
    """Free space between target and distractor, so that a finger fits in between [m]."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: When a number is out of range.
        """
        if not 0.0 <= self.share <= 1.0 or self.distance_m <= 0 or self.gap_m < 0:
            raise ConfigError(
                "near needs 0 <= share <= 1, distance_m > 0 and gap_m >= 0, "
                f"got {self.share:g}, {self.distance_m:g} and {self.gap_m:g}"
            )


@dataclass(frozen=True, kw_only=True)
class DistractorsResetConfig(PlacementConfig):
    """Where distractors lie."""

    near: NearConfig | None = None
    """Frequency of distractors close to the target; none: not controlled."""


@register
class DistractorsReset(ResetComponent):
    """Places distractors around the objects of the task without moving those.

    Randomisation: position and yaw of each distractor; with ``near``, whether the first one is close to the target. It
    is close in exactly the configured share of every 20 episodes, at random. Refused placements and repeated attempts
    do not change that share.
    """

    name = "distractors"
    Config = DistractorsResetConfig
    places = True

    @classmethod
    def check(cls, config: DistractorsResetConfig, roles: Sequence[str], task: TaskConfig) -> None:
        """Refuse ``near`` where no role is called target, whose distance it controls."""
        if config.near and TARGET not in roles:
            raise ConfigError(f"near: is the distance from the role '{TARGET}', and the roles are {', '.join(roles)}")

    def reset(self, scene: SceneSpec, context: ResetContext) -> SceneSpec:
        """Place each distractor apart from all other objects.

        Raises:
            RejectedError: When there is no room for a distractor, or the objects of the task already leave too little.
        """
        if no_room := context.room_taken(scene):
            raise RejectedError(no_room)
        near = self.config.near
        target = next((entity for entity in scene.entities if entity.name == TARGET), None)
        close = bool(near and self._turn(context) < near.share)
        if near and target and task_distractors(context.task):
            context.drawn["distractors.near"] = "yes" if close else "no"
        for number, thing in enumerate(task_distractors(context.task)):
            demand = Demand()
            if near and target:
                if not close:
                    demand = self._away(near, target, context)
                elif number == 0:
                    demand = self._near(near, scene, target, thing, context)
            demand = replace(demand, leaves=context.room_taken)
            scene = place(scene, thing, self.config, context, self.name, demand)
        return scene

    def _turn(self, context: ResetContext) -> float:
        """Return a stratified random number: each `BLOCK` episodes have one in each `BLOCK`-th of [0, 1)."""
        block, place = divmod(context.index, BLOCK)
        rng = replace(context.seed, index=block, attempt=0).rng(f"{self.name}/near")
        return float((rng.permutation(BLOCK)[place] + rng.random()) / BLOCK)

    def _away(self, near: NearConfig, target: EntitySpec, context: ResetContext) -> Demand:
        distance = distance_to(target, near, context.library)
        return Demand(name="beside_target", holds=lambda entity: distance(entity) > near.distance_m)

    def _near(
        self, near: NearConfig, scene: SceneSpec, target: EntitySpec, thing: PhysicalObject, context: ResetContext
    ) -> Demand:
        middle, size = centre(target, context.library), context.library.entity_model(target).size
        reach = math.hypot(*context.library.object(thing.model, thing.modifiers).size[:2]) / 2
        nearest = min(size[:2]) / 2 + near.gap_m
        x, y, _ = scene.robot.pose.inverse().apply(middle)
        distance = distance_to(target, near, context.library)
        outline = footprint(target, context.library)

        def around(rng: np.random.Generator) -> Array:
            angle, radius = rng.uniform(-math.pi, math.pi), rng.uniform(nearest, near.distance_m + reach)
            return np.array([x + radius * math.cos(angle), y + radius * math.sin(angle)])

        def along(rng: np.random.Generator) -> Array:
            corners = grown(outline, rng.uniform(near.gap_m, near.distance_m))
            begin, share = rng.choice(4, p=_side_shares(corners)), rng.random()
            at = (1 - share) * corners[begin] + share * corners[(begin + 1) % 4]
            return scene.robot.pose.inverse().apply((*at, 0.0))[:2]

        def holds(entity: EntitySpec) -> bool:
            at = scene.robot.pose.inverse().apply(entity.pose.position)[:2]
            area = self.config.area
            inside = area.lower is None or bool(np.all(at >= area.lower) and np.all(at <= area.upper))
            return inside and distance(entity) <= near.distance_m

        position = along if _is_wide(target, near, context.library) else around
        return Demand(name="away_from_target", holds=holds, position=position, gaps={TARGET: near.gap_m})


def distance_to(target: EntitySpec, near: NearConfig, library: ModelLibrary) -> Callable[[EntitySpec], float]:
    """Return a function that measures an object's distance from a target as `NearConfig` defines it [m]."""
    if _is_wide(target, near, library):
        return lambda entity: nearest_distance(target, centre(entity, library), library)
    middle = centre(target, library)
    return lambda entity: nearest_distance(entity, middle, library)


def _is_wide(target: EntitySpec, near: NearConfig, library: ModelLibrary) -> bool:
    """Return whether a target is too wide for an object to be close to its middle."""
    return min(library.entity_model(target).size[:2]) / 2 + near.gap_m + ROOM_M > near.distance_m


def _side_shares(corners: Array) -> Array:
    lengths = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    return np.asarray(lengths / lengths.sum())
