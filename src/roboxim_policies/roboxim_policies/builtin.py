"""The shipped policies ``zero``, ``random``, ``replay``; registration of the trained families and remote policies.

``zero`` and ``random`` are baselines for every evaluation; ``replay`` repeats recorded actions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from roboxim_core.actions import (
    ACTION_SIZE,
    ANY_RATE,
    ActionArray,
    ActionSemantics,
    ControlMode,
    check_chunk,
    hold_action,
)
from roboxim_core.errors import ConfigError, ErrorCode, InvalidRequestError, one_of
from roboxim_core.policies import ActionChunk, EpisodeStart, ObservationWindow, Policy
from roboxim_core.user_folders import expanded
from roboxim_policies.base import POLICIES, BasePolicy
from roboxim_policies.learning.families import FAMILIES
from roboxim_policies.recorded_actions import load_actions

DISTRIBUTIONS = ("gaussian", "uniform")


@POLICIES.register("zero")
class ZeroPolicy(BasePolicy):
    """A policy that holds still with an open gripper, at any rate."""

    name = "zero"
    any_thread = True
    semantics = ActionSemantics(rate_hz=ANY_RATE)

    def act(self, window: ObservationWindow) -> ActionArray:
        """Return the hold action with an open gripper."""
        return hold_action(1.0)


@POLICIES.register("random")
class RandomPolicy(BasePolicy):
    """A policy that draws every action at random within the action limits, from the episode's seed, at any rate.

    The gripper switches between open and closed with probability 0.1 per tick, so that it stays closed long enough to
    grasp something.
    """

    name = "random"
    semantics = ActionSemantics(rate_hz=ANY_RATE)

    def __init__(self, *, distribution: str = "gaussian", scale: float = 0.5) -> None:
        """Choose the distribution.

        Args:
            distribution: ``gaussian`` (standard deviation ``scale`` times the limit, per axis) or ``uniform`` (within
                ``scale`` times the limit, per axis); longer vectors are shortened to the limit.
            scale: Fraction of the limit, 0..1.

        Raises:
            ConfigError: On an unknown distribution or a scale outside 0..1.
        """
        if distribution not in DISTRIBUTIONS:
            raise ConfigError(f"unknown distribution '{distribution}'; {one_of(DISTRIBUTIONS, distribution)}")
        if not 0.0 <= scale <= 1.0:
            raise ConfigError(f"scale is the fraction of the action limits, 0..1, got {scale}")
        self._distribution, self._scale = distribution, scale
        self._rng = np.random.default_rng(0)
        self._gripper = 1.0

    def reset(self, start: EpisodeStart) -> None:
        """Start the episode's random stream."""
        self._rng = np.random.default_rng(start.seed)
        self._gripper = 1.0

    def act(self, window: ObservationWindow) -> ActionArray:
        """Draw an action."""
        if self._rng.random() < 0.1:
            self._gripper = 1.0 - self._gripper
        translation = self._draw(self.semantics.max_translation_m)
        rotation = self._draw(self.semantics.max_rotation_rad)
        return np.array([*translation, *rotation, self._gripper], np.float32)

    def _draw(self, limit: float) -> npt.NDArray[np.float64]:
        draw = self._rng.normal(size=3) if self._distribution == "gaussian" else self._rng.uniform(-1, 1, 3)
        draw *= self._scale * limit
        return np.asarray(draw * min(1.0, 0.999 * limit / max(float(np.linalg.norm(draw)), 1e-12)))


@POLICIES.register("replay")
class ReplayPolicy(BasePolicy):
    """A policy that repeats recorded actions, then holds still.

    An episode that is replayed from its restored scene at the recorded control rate repeats exactly.
    """

    name = "replay"

    def __init__(
        self,
        source: str | Path | None = None,
        *,
        actions: Sequence[Sequence[float]] | npt.NDArray[np.float32] | None = None,
        episode: int = 0,
        control: str = "",
    ) -> None:
        """Load the actions.

        Args:
            source: A ``.npz`` or ``.json`` file of actions, a recorded bag (``.mcap`` or its folder: the executed
                actions), or a dataset of any registered format (the labels of one episode).
            actions: The actions themselves, shape (T, 7), instead of a source.
            episode: Number of the episode in a dataset, through all of its splits.
            control: ``joint_position``, ``joint_velocity`` or ``joint_delta``: repeat a bag's commanded joints this way
                instead of its actions; empty: its actions.

        Raises:
            ConfigError: When neither or both are given, the source contains no actions, or the control mode is unknown.
        """
        if (source is None) == (actions is None):
            raise ConfigError("replay needs either a source (.npz, .json, .mcap, dataset) or actions")
        if source is not None:
            mode = _joint_control(control) if control else None
            self._actions, self.semantics = load_actions(expanded(source), episode=episode, control=mode)
            self.version = f"{Path(source).name}#{episode}"
        else:
            self._actions, self.semantics = _checked(actions), ActionSemantics()

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Return the action of the window's tick; after the last one, return a hold action with ``done``."""
        if window.seq >= len(self._actions):
            last = self._actions[-1:].copy()
            if self.semantics.control.is_relative:
                last[:, :-1] = 0.0
            return ActionChunk(actions=last, done=True)
        return ActionChunk(
            actions=self._actions[window.seq : window.seq + 1], done=window.seq + 1 == len(self._actions)
        )


def _joint_control(name: str) -> ControlMode:
    modes = [mode for mode in ControlMode if mode.is_joint_space]
    if name not in modes:
        raise ConfigError(f"control must be a mode of joint space, got '{name}'; {one_of(modes, name)}")
    return ControlMode(name)


def _checked(actions: npt.ArrayLike | None) -> ActionArray:
    try:
        return check_chunk(np.empty((0, ACTION_SIZE)) if actions is None else actions)
    except InvalidRequestError as error:
        raise ConfigError(f"recorded {error}", ErrorCode.INVALID_CONFIG) from None


def _learned(family: str) -> Callable[..., Policy]:
    """Return what loads a trained policy of a family."""

    def load(checkpoint: str | Path, *, execute: int = 0) -> Policy:
        from roboxim_policies.learning.policy import LearnedPolicy

        return LearnedPolicy(checkpoint, execute=execute, family=family)

    load.__name__ = load.__qualname__ = f"{family}_policy"
    load.__doc__ = f"""Load a trained policy of the family {family}; imports JAX.

    Args:
        checkpoint: Checkpoint file or the training's folder.
        execute: Actions executed per request; 0: the checkpoint's configuration.

    Raises:
        ConfigError: When the checkpoint is missing, damaged, of another version or of another family.
        UnavailableError: When the family needs ``roboxim[pretrained]``, which is not installed.
    """
    return load


for _family in FAMILIES:
    POLICIES.register(_family)(_learned(_family))
