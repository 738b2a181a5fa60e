"""Registration of the environments with Gymnasium; light, because importing `roboxim` may trigger it."""

from __future__ import annotations

import gymnasium

from roboxim_core.config_folders import config_names


def environment_id(task: str) -> str:
    """Return the id of a task's environment: ``roboxim/PickCube-v0`` for ``pick_cube``."""
    return f"roboxim/{''.join(part.capitalize() for part in task.split('_'))}-v0"


def register() -> None:
    """Register an environment for each task of ``config/tasks`` and of the user's folders; a second call adds none."""
    for task in config_names("tasks"):
        name = environment_id(task)
        if name not in gymnasium.registry:
            gymnasium.register(
                id=name,
                entry_point="roboxim_runs.environments.gymnasium_env:RoboXimEnv",
                kwargs={"task": task},
            )
