"""Facts of recorded episodes that the conditions of `roboxim_datasets.where` compare."""

from __future__ import annotations

from roboxim_core.episode import EpisodeInfo, EpisodeResult
from roboxim_datasets.where import Fact, facts_of_task


def facts_of(info: EpisodeInfo, result: EpisodeResult) -> dict[str, Fact]:
    """Return the facts of an episode that conditions can use; all are known before its ticks are read.

    Beside those of its task (`facts_of_task`), ``camera`` has the names of the cameras, ``entity`` the scene's models.
    """
    scene = info.scene
    facts: dict[str, Fact] = {
        "episode": (info.episode_id,),
        "instruction": (info.task.instruction,),
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
        "entity": tuple(dict.fromkeys(entity.model for entity in scene.entities)),
    }
    return facts | facts_of_task(info.task)
