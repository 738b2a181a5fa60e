"""Facts of recorded episodes that the conditions of `roboxim_datasets.where` compare."""

from __future__ import annotations

from roboxim_core.episode import EpisodeInfo, EpisodeResult
from roboxim_core.seeds import CELL
from roboxim_datasets.where import Fact


def facts_of(info: EpisodeInfo, result: EpisodeResult) -> dict[str, Fact]:
    """Return the facts of an episode that conditions can use; all are known before its ticks are read.

    ``object`` has the models of the task's objects. A role (``target``) has its model, ``target.color`` a modifier of
    it. ``camera`` has the names of the cameras, ``drawn.<name>`` a drawn parameter, ``argument.<name>`` an argument.
    """
    task, scene = info.task, info.scene
    facts: dict[str, Fact] = {
        "episode": (info.episode_id,),
        "skill": (task.skill,),
        "cell": (cell_of(info),),
        "instruction": (task.instruction,),
        "outcome": (result.outcome,),
        "reason": (result.reason,) if result.reason else (),
        "recovered": (str(result.recovered).lower(),),
        "steps": (str(result.steps),),
        "robot": (scene.robot.model,),
        "actor": (info.actor,),
        "renderer": (info.renderer,),
        "purpose": (info.purpose,),
        "run_seed": (str(info.run_seed),),
        "index": (str(info.index),),
        "attempt": (str(info.attempt),),
        "rate_hz": (f"{info.semantics.rate_hz:g}",),
        "camera": tuple(camera.name for camera in scene.cameras),
        "object": tuple(dict.fromkeys(thing.model for thing in task.objects.values())),
        "entity": tuple(dict.fromkeys(entity.model for entity in scene.entities)),
    }
    for role, thing in task.objects.items():
        facts[role] = (thing.model,)
        facts |= {f"{role}.{name}": (_text(value),) for name, value in thing.modifiers.items()}
    facts |= {f"argument.{name}": (_text(value),) for name, value in task.arguments.items()}
    facts |= {f"drawn.{name}": (value,) for name, value in task.drawn.items()}
    return facts


def cell_of(info: EpisodeInfo) -> str:
    """Return the cell of an episode: that of its mix if it has one, else its skill."""
    return info.task.drawn.get(CELL, info.task.skill)


def _text(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
