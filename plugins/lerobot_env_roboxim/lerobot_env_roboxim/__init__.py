"""RoboXim's tasks as environments of LeRobot: ``--env.type=roboxim``."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from lerobot_env_roboxim.client import RoboXimClient, RoboXimError

STATE_SIZE = 10
"""Measured position, 6D rotation, opening."""


@EnvConfig.register_subclass("roboxim")
@dataclass
class RoboXimEnvConfig(EnvConfig):
    """Environments of ``roboxim gymnasium serve``."""

    task: str | None = "pick_cube"
    """Task of RoboXim's ``config/tasks``, or several, separated by commas."""
    fps: int = 0
    """Control rate [Hz]; 0: the task's."""
    url: str = "ws://127.0.0.1:8765"
    """The server, or several, separated by commas: environment i uses the i-th."""
    size: int = 256
    """Side of the pictures [px]."""
    cameras: str = "workspace,wrist"
    """The task's cameras, separated by commas."""
    control: str = "end_effector_delta"
    """Control mode of the actions."""
    action_size: int = 7
    """Numbers of an action."""
    episode_length: int = 0
    """Actions per episode; 0: the task's."""
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Declare the features."""
        self.features = {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(self.action_size,)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(STATE_SIZE,)),
        }
        self.features_map = {ACTION: ACTION, "agent_pos": OBS_STATE}
        for name in self.camera_names:
            self.features[f"pixels/{name}"] = PolicyFeature(type=FeatureType.VISUAL, shape=(self.size, self.size, 3))
            self.features_map[f"pixels/{name}"] = f"{OBS_IMAGES}.{name}"

    @property
    def camera_names(self) -> tuple[str, ...]:
        """The cameras."""
        return tuple(name.strip() for name in self.cameras.split(",") if name.strip())

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of each environment but its address and task."""
        return {
            "size": self.size, "control": self.control, "rate": float(self.fps), "max_steps": self.episode_length,
            "cameras": self.camera_names,
        }  # fmt: skip

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """Return a vector environment for each task: ``{task: {0: environment}}``."""
        urls = [url.strip() for url in self.url.split(",")]
        vector: Any = gym.vector.SyncVectorEnv
        more: dict[str, Any] = {"autoreset_mode": gym.vector.AutoresetMode.SAME_STEP}
        if use_async_envs and n_envs > 1:
            vector = gym.vector.AsyncVectorEnv
            more["context"] = "spawn"
        found = {}
        for task in (part.strip() for part in str(self.task).split(",")):
            made = [partial(RoboXimClient, urls[i % len(urls)], task, **self.gym_kwargs) for i in range(n_envs)]
            found[task] = {0: vector(made, **more)}
        return found


__all__ = ["RoboXimClient", "RoboXimEnvConfig", "RoboXimError"]
