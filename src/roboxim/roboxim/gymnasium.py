"""RoboXim's Gymnasium environments; ``gymnasium.make("roboxim:roboxim/PickCube-v0")`` needs no import of this."""

from __future__ import annotations

from roboxim_runs.environments.gymnasium_env import RoboXimEnv
from roboxim_runs.environments.ids import environment_id, register

__all__ = ["RoboXimEnv", "environment_id", "register"]

register()
