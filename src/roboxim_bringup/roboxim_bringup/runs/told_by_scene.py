"""What the scenes of an experiment tell without its words.

They tell the object where no other one is in the scene, or where others lie in a wider area, and the task where it
alone has a certain object. A policy can then succeed without the instruction. The facts are from the task files, which
a card does not hold.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from roboxim_eval.experiments import Design, mix_of
from roboxim_tasks.config import task_mix
from roboxim_tasks.placement import PlacementConfig
from roboxim_tasks.task_config import TaskConfig


def told_by_scene(design: Design) -> tuple[str, ...]:
    """Return a sentence for each thing that the scenes of an experiment tell; empty: none of these.

    Args:
        design: The experiment.

    Raises:
        ConfigError: When a task file is missing or invalid.
    """
    tasks = _tasks(design)
    return (*_told_objects(tasks), *_told_places(tasks), *_told_tasks(tasks))


def _tasks(design: Design) -> dict[str, list[TaskConfig]]:
    """Return the configurations of each task in all cells, also as the conditions change them."""
    once = {cell.key: 1 for cell in design.cells}
    changes = [{}, *(condition.set for condition in design.config.conditions.values())]
    found: dict[str, list[TaskConfig]] = {}
    for number, change in enumerate(changes):
        if change not in changes[:number]:
            mix = task_mix(mix_of(design.config, once, change))
            for name, task in zip(mix.tasks, mix.cells, strict=True):
                found.setdefault(name, []).append(task)
    return found


def _told_objects(tasks: Mapping[str, Sequence[TaskConfig]]) -> Iterator[str]:
    told = [name for name, mine in tasks.items() if not any(t.distractors.maximum for t in mine) and _vary(mine)]
    if told:
        where = "No scene" if len(told) == len(tasks) else f"No scene of {' and '.join(told)}"
        yield f"{where} has distractors, so that the scene alone tells which object is meant."


def _told_places(tasks: Mapping[str, Sequence[TaskConfig]]) -> Iterator[str]:
    named = {model for mine in tasks.values() for task in mine for model in _named(task)}
    wider = [name for name, mine in tasks.items() if any(_lie_elsewhere(task) & named for task in mine)]
    if wider:
        yield (
            f"Distractors of {' and '.join(wider)} may lie outside the area of the objects that tasks name, so that "
            "the scene alone tells that some objects are not meant."
        )


def _lie_elsewhere(task: TaskConfig) -> set[str]:
    """Return the models of distractors if those lie in another area than the task's objects."""
    placed = (task.reset.get(component) for component in ("objects", "distractors"))
    areas = {one.area for one in placed if isinstance(one, PlacementConfig)}
    return _distractors(task) if len(areas) > 1 else set()


def _vary(tasks: Sequence[TaskConfig]) -> bool:
    """Return whether a task asks for different object models."""
    return any(len({m for task in tasks for m in task.objects[role].models.values}) > 1 for role in tasks[0].objects)


def _told_tasks(tasks: Mapping[str, Sequence[TaskConfig]]) -> Iterator[str]:
    for name, mine in tasks.items():
        elsewhere = {model for other, theirs in tasks.items() if other != name for t in theirs for model in _models(t)}
        for role in mine[0].objects:
            own = {str(model) for task in mine for model in task.objects[role].models.values}
            if len(tasks) > 1 and not own & elsewhere:
                has = " or ".join(sorted(model.replace("_", " ") for model in own))
                yield f"Scenes of {name} alone have the {role} {has}, so that the scene alone tells this task."
                break


def _models(task: TaskConfig) -> set[str]:
    """Return the models that a scene of a task can have."""
    return _named(task) | _distractors(task)


def _named(task: TaskConfig) -> set[str]:
    """Return the models of the objects that a task can name."""
    return {str(model) for one in task.objects.values() for model in one.models.values}


def _distractors(task: TaskConfig) -> set[str]:
    """Return the models that a task's distractors can have."""
    distractors = task.distractors
    return {*distractors.always, *map(str, distractors.models.values)} if distractors.maximum else set()
