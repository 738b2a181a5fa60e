"""Scene leakage: what the scenes of an experiment reveal about the instruction.

A scene reveals the object if it contains no other object, or if the others lie in a wider area. It reveals the task if
no other task has a certain object. A policy can then succeed without the instruction. If a held-out scene allows only
the instructed task, a policy cannot do anything else that it was trained to do, so a substitution of 0 has no meaning.

The facts are from the task files, which a card does not hold.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence

from roboxim_core.specs import Scalar, SceneSpec
from roboxim_eval.experiments import Design, mix_of
from roboxim_runs.experiments.definitions import tasks_of
from roboxim_tasks.config import task_mix
from roboxim_tasks.files import named
from roboxim_tasks.sampling.placement import PlacementConfig
from roboxim_tasks.task_config import TaskConfig


def scene_leakage(design: Design) -> tuple[str, ...]:
    """Return a sentence for each fact that the scenes of an experiment reveal; empty: none.

    Args:
        design: The experiment.

    Raises:
        ConfigError: When a task file is missing or invalid.
    """
    tasks = tasks_of(design)
    return (*_objects_revealed(tasks), *_places_revealed(tasks), *_tasks_revealed(tasks), *_not_substituted(design))


def _objects_revealed(tasks: Mapping[str, Sequence[TaskConfig]]) -> Iterator[str]:
    revealing = [
        name
        for name, cell_tasks in tasks.items()
        if not any(t.distractors.maximum for t in cell_tasks) and _vary(cell_tasks)
    ]
    if revealing:
        where = "No scene" if len(revealing) == len(tasks) else f"No scene of {' and '.join(revealing)}"
        yield f"{where} has distractors, so the scene alone reveals which object is meant."


def _places_revealed(tasks: Mapping[str, Sequence[TaskConfig]]) -> Iterator[str]:
    named = {model for cell_tasks in tasks.values() for task in cell_tasks for model in _named(task)}
    wider = [name for name, cell_tasks in tasks.items() if any(_lie_elsewhere(task) & named for task in cell_tasks)]
    if wider:
        yield (
            f"Distractors of {' and '.join(wider)} may lie outside the area of the objects that tasks name, so "
            "the scene alone reveals that some objects are not meant."
        )


def _lie_elsewhere(task: TaskConfig) -> set[str]:
    """Return the models of distractors if those lie in another area than the task's objects."""
    placed = (task.reset.get(component) for component in ("objects", "distractors"))
    areas = {one.area for one in placed if isinstance(one, PlacementConfig)}
    return _distractors(task) if len(areas) > 1 else set()


def _vary(tasks: Sequence[TaskConfig]) -> bool:
    """Return whether a task asks for different object models."""
    return any(len({m for task in tasks for m in task.objects[role].models.values}) > 1 for role in tasks[0].objects)


def _tasks_revealed(tasks: Mapping[str, Sequence[TaskConfig]]) -> Iterator[str]:
    for name, cell_tasks in tasks.items():
        elsewhere = {
            model for other, other_tasks in tasks.items() if other != name for t in other_tasks for model in _models(t)
        }
        for role in cell_tasks[0].objects:
            own = {str(model) for task in cell_tasks for model in task.objects[role].models.values}
            if len(tasks) > 1 and not own & elsewhere:
                has = " or ".join(sorted(model.replace("_", " ") for model in own))
                yield f"Only scenes of {name} have the {role} {has}, so the scene alone reveals this task."
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


# ------------------------------------------------------------------ substitution


def _not_substituted(design: Design) -> Iterator[str]:
    """Yield in how many held-out cells another instruction of the training can be carried out, if not in all."""
    primary = design.config.primary
    held_out = {cell.key: 1 for cell in design.cells if cell.unseen}
    if primary is None or primary.against or primary.where != "unseen" or not held_out:
        return  # no scores
    first = design.config.conditions[primary.first]
    if not first.train:
        return  # what it was trained with is unknown
    scenes = task_mix(mix_of(design.config, held_out, first.set)).cells
    trained = task_mix(mix_of(design.config, design.datasets[first.train])).cells
    allowing = sum(any(_allows_another(scene, other) for other in trained) for scene in scenes)
    if not allowing:
        yield (
            "No held-out scene allows another instruction of the training to be carried out, so substitution cannot "
            "happen here and its 0 has no meaning."
        )
    elif allowing < len(scenes):
        yield (
            f"Only {allowing} of {len(scenes)} held-out cells have scenes that allow another instruction of the "
            "training to be carried out; in the others substitution cannot happen."
        )


def _allows_another(task: TaskConfig, other: TaskConfig) -> bool:
    """Return whether a scene of a task may allow another task's instruction to be carried out, unless both are equal.

    Colours and other modifiers do not count: where only they could rule it out, it may be allowed.
    """
    own = [_models_of(task, role) for role in task.objects]
    needed = [_models_of(other, role) for role in other.objects]
    same = task.skill == other.skill and not _arguments_differ(task, other)
    for chosen in itertools.permutations(enumerate([*own, *_other_things(task)]), len(needed)):
        if all(models & wanted for (_, models), wanted in zip(chosen, needed, strict=True)):
            as_asked = same and [number for number, _ in chosen] == list(range(len(own)))
            if not as_asked:
                return True
    return False


def _arguments_differ(task: TaskConfig, other: TaskConfig) -> bool:
    """Return whether episodes of two tasks of a skill may have different arguments, e.g. directions."""
    names = task.arguments.keys() | other.arguments.keys()
    return any(len(_values(task, name) | _values(other, name)) > 1 for name in names)


def _values(task: TaskConfig, argument: str) -> set[Scalar]:
    """Return the values that an argument can have; both ends of a range."""
    given = task.arguments.get(argument)
    return set(given.drawable or given.ends) if given else {getattr(task.parameters, argument)}


def _models_of(task: TaskConfig, role: str) -> set[str]:
    return {str(model) for model in task.objects[role].models.drawable}


def _other_things(task: TaskConfig) -> Iterator[set[str]]:
    """Yield the models that each thing of a scene can have besides the objects that the task names."""
    yield from ({entity.model} for entity in named("scenes", task.scene, SceneSpec).entities)
    distractors = task.distractors
    yield from ({model} for model in distractors.always)
    drawn = {str(model) for model in distractors.models.drawable}
    yield from [drawn] * (distractors.maximum - len(distractors.always))
