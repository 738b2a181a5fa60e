"""Converts the actions of a dataset back to those that the simulator executes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from roboxim_core.actions import ActionArray, ActionContext, ActionSemantics, ActionTransform
from roboxim_core.actions.gripper import GripperSwitch
from roboxim_core.actions.lag import MotionLag
from roboxim_core.conventions import Convention, load_convention, to_actions
from roboxim_core.errors import InvalidRequestError
from roboxim_core.specs import SceneSpec
from roboxim_core.state import StateRecord
from roboxim_datasets.dataset import CONVENTION_FILE
from roboxim_datasets.episode import Episode

Decode = Callable[[npt.NDArray[np.float32], StateRecord], ActionArray]
"""Returns the action to execute after a state, for an action of the dataset."""


def dataset_convention(folder: Path) -> Convention | None:
    """Return the convention beside a dataset, in the numbers that the dataset holds; None: there is none.

    A dataset holds actions that are not normalised: trainers normalise them by the dataset's own statistics.

    Raises:
        ConfigError: When the file is not a convention.
    """
    file = folder / CONVENTION_FILE
    if not file.is_file():
        return None
    convention = load_convention(str(file))
    return replace(convention, action=replace(convention.action, normalisation=None))


class ActionDecoder:
    """Decodes the actions of one episode."""

    def __init__(self, episode: Episode, scene: SceneSpec, convention: Convention | None) -> None:
        """Prepare the conversion.

        Args:
            episode: The episode. Its semantics say what its actions mean; None: the convention does.
            scene: The recorded scene.
            convention: The convention beside the dataset.

        Raises:
            InvalidRequestError: When nothing says what the actions mean.
        """
        semantics = episode.semantics
        if semantics is None and convention is None:
            raise InvalidRequestError("the dataset does not say what its actions mean")
        declared = semantics or (convention.semantics if convention else ActionSemantics())
        self.rate_hz = declared.rate_hz or episode.fps or scene.control_rate_hz
        """Control rate of the actions [Hz]."""
        self.semantics = replace(declared, rate_hz=self.rate_hz)
        """Meaning of the actions."""
        self.executed = self.semantics.executed(self.rate_hz)
        """Meaning of the actions that the simulator executes."""
        self._base = scene.robot.pose
        self._convention = None if semantics is not None else convention

    def start(self) -> Decode:
        """Return the conversion of one pass through the episode; a gripper's rule begins anew."""
        if self._convention is not None:
            convention = replace(self._convention, rate_hz=self.rate_hz)
            action = convention.action
            return partial(self._by_convention, convention, GripperSwitch(action.gripper.rule), MotionLag(action.lag))
        if self.semantics.differing(self.executed):
            return partial(self._by_transform, ActionTransform.between(self.semantics, self.executed))
        return lambda action, state: np.asarray(action, np.float32)

    def _context(self, state: StateRecord) -> ActionContext:
        return ActionContext.of(state, self._base)

    def _by_transform(
        self, transform: ActionTransform, action: npt.NDArray[np.float32], state: StateRecord
    ) -> ActionArray:
        return np.asarray(transform.apply(action, self._context(state)), np.float32)

    def _by_convention(
        self,
        convention: Convention,
        gripper: GripperSwitch,
        lag: MotionLag,
        action: npt.NDArray[np.float32],
        state: StateRecord,
    ) -> ActionArray:
        return np.asarray(to_actions(convention, action, self._context(state), gripper, lag)[0], np.float32)
