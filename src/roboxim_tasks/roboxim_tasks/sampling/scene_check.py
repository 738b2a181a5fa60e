"""Which constraints a given scene violates: the same constraints that refuse a drawn scene, all reported by name."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from roboxim_core.errors import RoboximError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.specs import EntitySpec, SceneSpec
from roboxim_tasks.components import ResetContext
from roboxim_tasks.demonstration.solvable import CONSTRAINT, Solvability, state_at_rest
from roboxim_tasks.roles import Wording
from roboxim_tasks.sampling.placement import Room, footprint, overlap
from roboxim_tasks.sampling.visible import CONSTRAINT as VISIBLE
from roboxim_tasks.sampling.visible import SIZE_PX, Visibility
from roboxim_tasks.sequences.skill import skill_of

UNAMBIGUOUS = "instruction_unambiguous"


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A constraint that a scene violates."""

    constraint: str
    """Its name, e.g. ``target_overlaps``, ``target_reachable``, ``solvable``."""
    entity: str = ""
    """The entity that it concerns; empty: the whole scene."""
    message: str
    """What is wrong, for a person."""


def quick_findings(scene: SceneSpec, context: ResetContext) -> Iterator[Finding]:
    """Yield what takes milliseconds to see: places on the table, overlaps, the skill's constraints, the instruction.

    Args:
        scene: The scene.
        context: A reset of its task, with the skill's constraints.
    """
    library = context.library
    for entity in scene.entities:
        yield from _place(scene, entity, library)
    for constraint in context.constraints:
        if not constraint.holds(scene):
            role = constraint.name.rsplit("_", 1)[0]
            thing = context.task.objects.get(role)
            why = constraint.why(scene) if constraint.why else f"the task's constraint {constraint.name} does not hold"
            yield Finding(
                constraint=constraint.name, entity=thing.entity if thing else "",
                message=why,
            )  # fmt: skip
    wording = Wording.of_task(context.task, skill_of(context.task).roles, library)
    for thing in wording.mistakable(scene, context.task):
        yield Finding(
            constraint=UNAMBIGUOUS, entity=thing.entity,
            message=f"'{context.task.instruction}' could mean '{thing.entity}' too, or is not true of it",
        )  # fmt: skip


def slow_findings(
    scene: SceneSpec, context: ResetContext, visibility: Visibility | None, solvability: Solvability | None
) -> Iterator[Finding]:
    """Yield what needs pictures or a planner: whether cameras see the named objects, whether the expert has a solution.

    Args:
        scene: The scene.
        context: A reset of its task.
        visibility: Check of the cameras; none: no check.
        solvability: Check of the solution; none: no check.
    """
    config = context.config.visible
    sights = (
        visibility.look(context.task, scene, state_at_rest(scene, context.arm), config.cameras) if visibility else ()
    )
    for sight in sights:
        if sight.pixels < config.pixels or sight.share < config.share:
            yield Finding(
                constraint=f"{sight.entity}_{VISIBLE}", entity=sight.entity,
                message=f"camera '{sight.camera}' sees {sight.pixels} pixels and {100 * sight.share:.0f} % of it; "
                f"the task demands {config.pixels} (in an image of {SIZE_PX}) and {100 * config.share:.0f} %",
            )  # fmt: skip
    if solvability:
        try:
            solvability.solution(context.task, scene, context.seed.derived_seed("policy"))
        except RoboximError as error:
            yield Finding(constraint=CONSTRAINT, message=str(error))


def _place(scene: SceneSpec, entity: EntitySpec, library: ModelLibrary) -> Iterator[Finding]:
    alone = replace(scene, entities=())
    if Room.of(alone, library, 0.0).refusal(entity) == "off_table":
        yield Finding(
            constraint=f"{entity.name}_off_table", entity=entity.name, message="it is not wholly on the table"
        )
    own, (low, high) = footprint(entity, library), _heights(entity, library)
    for other in scene.entities:
        if other.name == entity.name:
            break  # each pair once, named after the later one
        under, over = _heights(other, library)
        if low < over - 1e-4 and under < high - 1e-4 and overlap(own, footprint(other, library)):
            yield Finding(
                constraint=f"{entity.name}_overlaps", entity=entity.name, message=f"it overlaps with '{other.name}'"
            )


def _heights(entity: EntitySpec, library: ModelLibrary) -> tuple[float, float]:
    """Return the lowest and the highest point of an object's box in the world [m]."""
    model = library.entity_model(entity)
    width, depth, height = model.size
    corners = entity.pose.apply(
        [
            (x, y, z)
            for x in (-width / 2, width / 2)
            for y in (-depth / 2, depth / 2)
            for z in (-model.rest_height, height - model.rest_height)
        ]
    )
    return float(np.min(corners[:, 2])), float(np.max(corners[:, 2]))
