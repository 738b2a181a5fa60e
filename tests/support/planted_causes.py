"""Policies with planted causes and defects: to test explanations, hand-overs and mining with.

`FailsWhere` is the expert, which gives up where conditions of the scene hold. `Defective` is the expert with one defect
of its gripper.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scene_measures import MEASURES, scene_measures

from roboxim_core.actions import hold_action
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.models.library import ModelLibrary
from roboxim_core.policies import ActionChunk, EpisodeStart, ObservationWindow
from roboxim_runs.policies.planted import PlantedPolicy

Condition = Mapping[str, Any]
"""Measure to a value, or to its lower and upper bound; holds if all of them do."""


class FailsWhere(PlantedPolicy):
    """The expert, which gives up where any of its conditions holds."""

    name = "fails_where"

    def __init__(self, *, conditions: Sequence[Condition] = (), **options: Any) -> None:
        """Plant the conditions.

        Args:
            conditions: Each is a mapping of measures, see `scene_measures`, e.g.
                ``[{distractors: [1, 9]}, {x: [0.3, 0.4], light: [0, 1.5]}]``: fails with a distractor, and also where
                the object is near and the light is dim.
            options: Those of `PlantedPolicy`.

        Raises:
            ConfigError: When a measure is unknown.
        """
        super().__init__(**options)
        for name in {name for condition in conditions for name in condition}:
            if name not in MEASURES:
                raise ConfigError(f"unknown measure '{name}'; {one_of(MEASURES, name)}")
        self._conditions = tuple(conditions)
        self._fails = False
        self._models = ModelLibrary()

    def reset(self, start: EpisodeStart) -> None:
        """Look whether a condition holds.

        Raises:
            TaskError: When the request lacks task or scene.
        """
        super().reset(start)
        assert start.task is not None
        assert start.scene is not None
        found = scene_measures(start.task, start.scene, self._models)
        self._fails = any(all(_holds(found.get(k), v) for k, v in one.items()) for one in self._conditions)

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Return the expert's action, or give up."""
        if self._fails:
            return ActionChunk(actions=hold_action(1.0)[None], done=True)
        return super().act(window)


def _holds(found: float | str | None, wanted: Any) -> bool:
    if found is None:
        return False
    if isinstance(wanted, list | tuple):
        return isinstance(found, float) and float(wanted[0]) <= found <= float(wanted[1])
    return bool(found == wanted)


DEFECTS = ("late_grasp", "early_release")
LATE_TICKS = 6
"""Ticks by which a late grasp closes after it should."""
RELEASE_M = (0.01, 0.03)
"""How far an object has been lifted where an early release opens the gripper [m]."""


class Defective(PlantedPolicy):
    """The expert with a defect of its gripper: it closes late or opens while it lifts, and does not try again.

    The defect belongs to a moment. A late grasp is that of a gripper which this policy closes itself, an early release
    that of an object just off the table: whoever takes over later has neither.
    """

    name = "defective"

    def __init__(self, *, defect: str = "late_grasp", **options: Any) -> None:
        """Plant the defect.

        Args:
            defect: ``late_grasp`` or ``early_release``.
            options: Those of `PlantedPolicy`.

        Raises:
            ConfigError: When the defect is unknown.
        """
        super().__init__(**options)
        if defect not in DEFECTS:
            raise ConfigError(f"unknown defect '{defect}'; {one_of(DEFECTS, defect)}")
        self._defect = defect
        self._heights: dict[str, float] = {}
        self._forget()

    def _forget(self) -> None:
        self._late = 0
        self._was_open = False
        self._over = False

    def reset(self, start: EpisodeStart) -> None:
        """Start an episode without the defect having shown.

        Raises:
            TaskError: When the request lacks task or scene.
        """
        super().reset(start)
        assert start.scene is not None
        self._heights = {entity.name: entity.pose.position[2] for entity in start.scene.entities}
        self._forget()

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Return the expert's action with the defect; give up once it has shown."""
        if self._over:
            return ActionChunk(actions=hold_action(1.0)[None], done=True)
        chunk = super().act(window)
        closing = bool(chunk.actions[0][-1] < 0.5)
        self._was_open = self._was_open or not closing
        if closing and self._defect == "late_grasp" and self._was_open:
            self._late += 1
            self._over = self._late == LATE_TICKS
            return _opened(chunk)
        if closing and self._defect == "early_release" and self._just_lifted(window):
            self._over = True
            return _opened(chunk)
        return chunk

    def _just_lifted(self, window: ObservationWindow) -> bool:
        state = window.newest.state
        assert state is not None
        low, high = RELEASE_M
        return any(low < entity.pose.position[2] - self._heights[entity.name] < high for entity in state.entities)


def _opened(chunk: ActionChunk) -> ActionChunk:
    actions = np.array(chunk.actions, np.float32)
    actions[:, -1] = 1.0
    return replace(chunk, actions=actions)
