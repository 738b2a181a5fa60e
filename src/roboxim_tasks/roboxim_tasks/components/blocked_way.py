"""Reset component ``blocked_way``: rows of distractors that block the tool's straight path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from roboxim_core.errors import ConfigError, one_of
from roboxim_core.poses import Array, Pose
from roboxim_core.specs import EntitySpec, SceneSpec
from roboxim_tasks.choices import Choice
from roboxim_tasks.components.base import ResetComponent, ResetContext, register
from roboxim_tasks.roles import distractor_role, task_distractors
from roboxim_tasks.sampling.placement import refusal
from roboxim_tasks.sampling.rejection import RejectedError
from roboxim_tasks.task_config import TaskConfig

TOOL = "tool"
CONSTRAINT = "way_blocked"
"""Name of the constraint that the expert's straight paths collide."""
HAND_RADIUS_M = 0.11
"""Radius around the tool centre point that the open hand takes up [m]."""


@dataclass(frozen=True, kw_only=True)
class BlockedWayConfig:
    """The blocked paths and the rows that block them."""

    between: tuple[tuple[str, str], ...] = ((TOOL, "target"),)
    """Paths from one end to another. An end is a role of the task, ``tool`` (the initial tool centre point), or a
    distractor that every episode has and no row uses, e.g. ``distractor_3`` after one row of two."""
    row: int = 2
    """Number of distractors across each path; the others stay where the component ``distractors`` has put them."""
    share: Choice = Choice(lower=0.0, upper=1.0)
    """Position of the row along the free part of the path, 0 = closest to its start, 1 = closest to its end."""
    apart_m: float = 0.03
    """Free space between the row and both ends of its path [m]."""
    aside_m: Choice = Choice(lower=-0.02, upper=0.02)
    """Shift of the row's middle along the row [m]."""
    yaw_rad: Choice = Choice(lower=-0.2, upper=0.2)
    """Yaw of each object relative to the row [rad]."""
    gap_m: float = 0.01
    """Free space between the objects of a row, too narrow for the hand [m]."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: When there is no path, a row is empty or a distance is negative.
        """
        if not self.between or self.row < 1 or min(self.gap_m, self.apart_m) < 0:
            raise ConfigError(
                "needs at least one way, row >= 1, gap_m >= 0 and apart_m >= 0, "
                f"got {self.between}, {self.row}, {self.gap_m:g} and {self.apart_m:g}"
            )
        self.share.require_numbers("share", 0.0, 1.0)
        self.aside_m.require_numbers("aside_m")
        self.yaw_rad.require_numbers("yaw_rad")

    @property
    def needed(self) -> int:
        """Number of distractors in all rows."""
        return self.row * len(self.between)


@register
class BlockedWayReset(ResetComponent):
    """Moves the first distractors into rows across the paths, and checks that straight paths then collide.

    Randomisation: position of each row along its path, its shift and the yaw of its objects.

    Non-obvious: the component runs after ``objects`` and ``distractors``. Where scenes are planned (parameter
    ``solvable`` of the task node), ``way_blocked`` refuses a scene unless the expert's straight paths, from its start
    through every stage, collide. The check ``solvable`` then shows that a detour exists, as in every scene.
    """

    name = "blocked_way"
    Config = BlockedWayConfig
    places = True

    @classmethod
    def check(cls, config: BlockedWayConfig, roles: Sequence[str], task: TaskConfig) -> None:
        """Refuse paths to what an episode may lack or what stands in a row, and more rows than distractors."""
        standing = range(config.needed, task.distractors.minimum)
        ends = (TOOL, *roles, *(distractor_role(number + 1) for number in standing))
        for end in (end for way in config.between for end in way):
            if end not in ends:
                raise ConfigError(f"between: no role '{end}'; {one_of(ends, end)}")
        if task.distractors.minimum < config.needed:
            raise ConfigError(
                f"needs {config.needed} distractors for {len(config.between)} ways with rows of {config.row}; "
                f"set distractors.minimum to {config.needed} or more, it is {task.distractors.minimum}"
            )

    def reset(self, scene: SceneSpec, context: ResetContext) -> SceneSpec:
        """Draw each row.

        Raises:
            RejectedError: When there is no room for an object, or the direct path is free.
        """
        things = task_distractors(context.task)
        moved = {thing.entity for thing in things[: self.config.needed]}
        order = [entity.name for entity in scene.entities]
        standing = {entity.name: entity for entity in scene.entities}
        scene = replace(scene, entities=tuple(e for e in scene.entities if e.name not in moved))
        for number, way in enumerate(self.config.between):
            row = things[number * self.config.row : (number + 1) * self.config.row]
            scene = self._across(scene, [standing[thing.entity] for thing in row], way, context)
        scene = replace(scene, entities=tuple(sorted(scene.entities, key=lambda entity: order.index(entity.name))))
        if context.way_blocked is not None and not context.way_blocked(scene):
            raise RejectedError(CONSTRAINT)
        return scene

    def _across(
        self, scene: SceneSpec, row: Sequence[EntitySpec], way: tuple[str, str], context: ResetContext
    ) -> SceneSpec:
        """Add entities side by side across a path."""
        from scipy.spatial.transform import Rotation

        rng, index, config = context.rng(self.name), context.index, self.config
        (begin, room_begin), (end, room_end) = (_end(name, scene, context) for name in way)
        length = float(np.linalg.norm(end - begin))
        widths = [max(context.library.entity_model(entity).size[:2]) for entity in row]
        first = room_begin + config.apart_m + max(widths) / 2
        last = length - room_end - config.apart_m - max(widths) / 2
        if first > last:
            raise RejectedError("way_long_enough")
        along = (end - begin) / length
        across = np.array([-along[1], along[0]])
        share = config.share.draw_number(rng, index)
        context.record(f"blocked_way.{'-'.join(way)}", config.share, share)
        middle = begin + (first + share * (last - first)) * along
        middle = middle + config.aside_m.draw_number(rng, index) * across
        offset = -(sum(widths) + config.gap_m * (len(row) - 1)) / 2
        for entity, width in zip(row, widths, strict=True):
            x, y = middle + (offset + width / 2) * across
            turn = np.arctan2(across[1], across[0]) + config.yaw_rad.draw_number(rng, index)
            pose = Pose.from_arrays((x, y, entity.pose.position[2]), Rotation.from_euler("z", turn))
            placed = replace(entity, pose=pose)
            reason = refusal(scene, placed, 0.0, context.library)
            if reason:
                raise RejectedError(f"{entity.name}_in_the_way_{reason}")
            scene = replace(scene, entities=(*scene.entities, placed))
            offset += width + config.gap_m
        return scene


def _end(name: str, scene: SceneSpec, context: ResetContext) -> tuple[Array, float]:
    """Return the end of a path on the table in the world, and the radius that is taken up there [m]."""
    if name == TOOL:
        tool = scene.robot.pose @ context.arm.fk(scene.robot.joint_positions)
        return np.array(tool.position[:2]), HAND_RADIUS_M
    entity = scene.entity(context.task.objects[name].entity)
    return np.array(entity.pose.position[:2]), max(context.library.entity_model(entity).size[:2]) / 2
