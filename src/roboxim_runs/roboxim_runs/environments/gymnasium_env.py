"""RoboXim as a Gymnasium environment: one id per task of ``config/tasks``, e.g. ``roboxim/PickCube-v0``."""

from __future__ import annotations

import operator
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box, Dict, Space

from roboxim_core.actions import ActionSemantics, ControlMode
from roboxim_core.episode import EpisodeResult
from roboxim_core.episode.runner import LEFT_WORKSPACE
from roboxim_core.errors import ConfigError, EvaluationError
from roboxim_core.models.description import RobotModel
from roboxim_core.policies import Observation
from roboxim_core.proprioception import STATE_SIZE
from roboxim_runs.environments.session import EpisodeSession, SessionConfig

STATE_BOUND = 10.0
"""Bound of ``agent_pos``, far outside of what an arm reaches [m]."""
DRAWN_SEEDS = 2**31
"""Number of seeds from which an environment draws its own when it is given none."""


class RoboXimEnv(gymnasium.Env[dict[str, Any], npt.NDArray[np.float32]]):
    """Episodes of a task, step by step.

    Observation: ``pixels`` (camera to uint8 RGB, shape (height, width, 3)) and ``agent_pos`` (float32: measured
    position, 6D rotation and opening, as ``observation/state`` of exports). The instruction is `task_description` and
    ``info["task_description"]``. The reward is 1 on success, else 0; ``info["is_success"]`` says the same.

    Non-obvious:

    - ``reset(seed=s)`` begins episode 0 of seed s, each further ``reset()`` the next one, and
      ``reset(options={"index": i})`` episode i. It is the episode that ``roboxim evaluate --seed s`` gives for that
      index, with the same scene.
    - An environment that was never given a seed draws one at its first reset; ``info["seed"]`` says which.
    - The last step includes one second in which the robot holds still, as an evaluation's final verdict does.
    - A policy that runs out of actions is truncated; leaving the workspace or failing the task terminates.
    - The window, physics and renderer are made at the first reset, in the process that resets.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 - Gymnasium's own declaration

    def __init__(self, task: str = "pick_cube", *, render_mode: str | None = None, **options: Any) -> None:
        """Read the task.

        Args:
            task: Task of ``config/tasks``, or a YAML file.
            render_mode: ``rgb_array``: `render` returns all cameras side by side.
            **options: Further fields of `SessionConfig`: ``size``, ``control``, ``rate``, ``max_steps``, ``purpose``,
                ``renderer`` and ``out``.

        Raises:
            ConfigError: When the task cannot be used, or the process was forked.
        """
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ConfigError(f"unknown render_mode '{render_mode}'; expected 'rgb_array' or None")
        self.render_mode = render_mode
        self.session = EpisodeSession(SessionConfig(task=task, **options))
        fps = max(round(self.session.rate_hz), 1)  # whole, as video writers want
        self.metadata = {**self.metadata, "render_fps": fps}
        self.task_description = ""
        """Instruction of the running episode."""
        self._run_seed: int | None = None
        self._index = -1
        pixels: dict[str, Space[Any]] = {
            name: Box(0, 255, (height, width, 3), np.uint8) for name, (width, height) in self.session.cameras.items()
        }
        limits = Box(-STATE_BOUND, STATE_BOUND, (STATE_SIZE,), np.float32)
        self.observation_space = Dict({"pixels": Dict(pixels), "agent_pos": limits})
        space: Space[Any] = action_box(self.session.config.actions, self.session.robot, self.session.rate_hz)
        self.action_space = space

    @property
    def _max_episode_steps(self) -> int:
        """Largest number of actions of an episode; LeRobot reads this name."""
        return self.session.max_steps

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: Seed of the run; its episode 0 begins. None: the next episode of the present seed, which is a random
                one at first.
            options: ``{"index": i}`` begins episode i.

        Returns:
            Observation, and info with ``is_success``, ``task_description``, ``scene_hash``, ``seed`` and ``index``.

        Raises:
            ConfigError: On an unknown option, or a seed or an index that is not a whole number >= 0.
            TaskError: When the scene cannot be drawn.
        """
        seed = None if seed is None else _whole("seed", seed)
        super().reset(seed=seed)
        given = dict(options or {})
        index = _whole("index", given.pop("index", 0 if seed is not None else self._index + 1))
        if given:
            raise ConfigError(f"options may give 'index', a whole number >= 0; got {options}")
        if seed is not None:
            self._run_seed = seed
        elif self._run_seed is None:
            self._run_seed = int(self.np_random.integers(DRAWN_SEEDS))
        self._index = index
        window = self.session.start(self._run_seed, index)
        self.task_description = window.instruction
        info = self._info(success=False) | {
            "scene_hash": self.session.scene_hash, "seed": self._run_seed, "index": index,
        }  # fmt: skip
        return self._observation(window.newest), info

    def step(self, action: npt.NDArray[np.float32]) -> tuple[dict[str, Any], SupportsFloat, bool, bool, dict[str, Any]]:
        """Execute an action.

        Returns:
            Observation, reward, whether the episode has ended, whether it was cut off, and info. The info of the last
            step has the episode's ``reason``.

        Raises:
            EvaluationError: When the action is not valid; the message says why.
            PolicyError: When no episode is running.
        """
        answer = self.session.step(action)
        if not isinstance(answer, EpisodeResult):
            return self._observation(answer.newest), 0.0, False, False, self._info(success=False)
        if answer.outcome == "error":
            raise EvaluationError(f"{answer.reason}: {answer.message}")
        success = answer.outcome == "success"
        truncated = _ran_out(answer)
        info = self._info(success=success) | {"reason": answer.reason}
        return self._observation(self.session.observe()), float(success), not truncated, truncated, info

    def render(self) -> Any:
        """Return all cameras side by side, uint8, shape (height, width, 3); None without a render mode."""
        if self.render_mode is None:
            return None
        images = list(self.session.observe().images.values())
        height = max(image.shape[0] for image in images)
        return np.concatenate([np.pad(i, ((0, height - i.shape[0]), (0, 0), (0, 0))) for i in images], axis=1)

    def close(self) -> None:
        """Free physics and renderer."""
        self.session.close()

    def _observation(self, observation: Observation) -> dict[str, Any]:
        return {
            "pixels": {name: np.array(image) for name, image in observation.images.items()},
            "agent_pos": observation.proprio.vector(),
        }

    def _info(self, *, success: bool) -> dict[str, Any]:
        return {"is_success": success, "task_description": self.task_description}


def _whole(name: str, value: Any) -> int:
    """Return a whole number >= 0, also of NumPy's types."""
    try:
        number = operator.index(value)
    except TypeError:
        number = -1
    if number < 0:
        raise ConfigError(f"{name} must be a whole number >= 0, got {value!r}")
    return number


def _ran_out(result: EpisodeResult) -> bool:
    """Return whether the limit of actions ended the episode: nothing that ends it earlier happened."""
    ended = result.verdict.success_ever or result.verdict.failed or result.reason == LEFT_WORKSPACE
    return result.outcome == "failure" and not ended


def action_box(semantics: ActionSemantics, robot: RobotModel, rate_hz: float) -> Box:
    """Return the space of actions whose every component is within its limit.

    Args:
        semantics: Their meaning: end-effector deltas or joint space.
        robot: The robot's model.
        rate_hz: Control rate [Hz].

    Raises:
        ConfigError: For another meaning.
    """
    limits = robot.limits
    if semantics.control == ControlMode.END_EFFECTOR_DELTA:
        bound = [semantics.max_translation_m] * 3 + [semantics.max_rotation_rad] * 3
        low, high = [-number for number in bound], bound
    elif semantics.control == ControlMode.JOINT_POSITION:
        low, high = list(limits.lower), list(limits.upper)
    elif semantics.control.is_joint_space:
        period = 1.0 if semantics.control == ControlMode.JOINT_VELOCITY else 1.0 / rate_hz
        high = [speed * period for speed in limits.velocity]
        low = [-number for number in high]
    else:
        raise ConfigError(
            f"an environment's control is 'end_effector_delta' or one in joint space, got '{semantics.control}'"
        )
    return Box(np.array([*low, 0.0], np.float32), np.array([*high, 1.0], np.float32), dtype=np.float32)
