"""The conformance check of skills that draws their tasks; `roboxim_tasks.skills.SKILLS` loads it."""

from __future__ import annotations

from roboxim_core.config import config_dirs, load_yaml
from roboxim_core.models.library import ModelLibrary
from roboxim_core.seeds import SeedPath
from roboxim_tasks.config import task_config
from roboxim_tasks.sampling.episodes import EpisodeGenerator
from roboxim_tasks.skills import SKILLS
from roboxim_tasks.skills.base import Skill


@SKILLS.conformance
def draws_the_same_task_again(name: str, item: Skill) -> None:
    """Refuse a skill whose task cannot be drawn, or whose second draw differs from the first.

    Draw the first task of the skill in the configuration's folders, or the default task if there is none.
    """
    files = [path for folder in config_dirs() for path in sorted((folder / "tasks").glob("*.yaml"))]
    shipped = (data for path in files if (data := load_yaml(path)) and data.get("skill") == name)
    config = task_config(next(shipped, {"skill": name}))
    seed = SeedPath(run_seed=1, purpose="test", index=0)
    first, second = (EpisodeGenerator(ModelLibrary(), None, None).draw(seed, config) for _ in range(2))
    assert first.task == second.task, "two draws of one seed give different tasks"
    assert first.scene == second.scene, "two draws of one seed give different scenes"
    assert first.task.instruction, "its instruction is empty"
