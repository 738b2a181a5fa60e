r"""The expert with planted abilities: a policy whose true results are known, to test experiments with.

It solves an episode of a cell with a stated probability. Otherwise it carries out another instruction, or gives up. It
may also ignore the instruction and do something that the scene allows::

    roboxim experiment run FILE --trainer external --out runs/planted \
        --policy leave_out=roboxim_runs.policies.planted:PlantedPolicy --option leave_out.rate=0.8
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from roboxim_bringup.cores import CorePlanner
from roboxim_core.actions import ANY_RATE, ActionSemantics, hold_action
from roboxim_core.errors import ConfigError, PolicyError, TaskError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.policies import ActionChunk, EpisodeStart, ObservationWindow
from roboxim_core.seeds import CELL
from roboxim_core.specs import TaskSpec
from roboxim_policies.base import BasePolicy
from roboxim_tasks.demonstration.expert import Expert
from roboxim_tasks.meaning import asks_for_same, read_instruction


class PlantedPolicy(BasePolicy):
    """The expert with a set success rate. Privileged, since the expert is."""

    name = "planted"
    privileged = True
    semantics = ActionSemantics(rate_hz=ANY_RATE)

    def __init__(
        self,
        *,
        rate: float = 1.0,
        rates: Mapping[str, float] | None = None,
        instead: Mapping[str, str] | None = None,
        words: bool = True,
        known: Sequence[str] = (),
        salt: int = 0,
    ) -> None:
        """Plant the abilities.

        Args:
            rate: Probability to solve an episode.
            rates: Cell to its own probability.
            instead: Cell to the instruction that is carried out in the other episodes; cells that are left out give up.
            words: Whether the policy does what the instruction says. Without words, or with an empty instruction, it
                carries out one of ``known`` at random among those that the scene allows.
            known: Instructions of the training.
            salt: Further seed; policies with other salts solve other scenes.

        Raises:
            ConfigError: When a probability is not from 0 to 1.
        """
        for name, value in {"rate": rate, **(rates or {})}.items():
            if not 0.0 <= value <= 1.0:
                raise ConfigError(f"the probability '{name}' must be from 0 to 1, got {value:g}")
        self._rate, self._rates, self._instead = rate, dict(rates or {}), dict(instead or {})
        self._words, self._known, self._salt = words, tuple(known), salt
        self._library = ModelLibrary()
        self._expert = Expert(self._library, CorePlanner(self._library))
        self._task: TaskSpec | None = None
        self._substitutes = False

    def reset(self, start: EpisodeStart) -> None:
        """Choose what to carry out.

        Raises:
            TaskError: When the request lacks task or scene.
        """
        if start.task is None or start.scene is None:
            raise TaskError("the planted policy needs the task and the scene; send them as to a privileged policy")
        rng = np.random.default_rng([start.seed, self._salt])
        cell = start.task.drawn.get(CELL, "")
        solves = rng.random() < self._rates.get(cell, self._rate)
        wanted = self._meant(start, rng)
        if not solves:
            wanted = self._first(self._instead.get(cell, ""), start)
        self._task = wanted
        self._substitutes = wanted is not start.task
        if wanted is not None:
            self._expert.reset(replace(start, task=wanted))

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Return the expert's action; hold still and finish if there is nothing to do.

        Raises:
            PolicyError: When the expert finds no motion for the episode's own task.
        """
        give_up = ActionChunk(actions=hold_action(1.0)[None], done=True)
        if self._task is None:
            return give_up
        try:
            return self._expert.act(window)
        except PolicyError:
            if self._substitutes:
                return give_up
            raise

    def _meant(self, start: EpisodeStart, rng: np.random.Generator) -> TaskSpec | None:
        """Return the task that the policy takes the episode's to be; none: it knows nothing to do in the scene."""
        assert start.task is not None
        if self._words and start.instruction == start.task.instruction:
            return start.task
        if self._words and start.instruction:
            return self._first(start.instruction, start)
        allowed = [task for text in self._known if (task := self._first(text, start)) is not None]
        return allowed[int(rng.integers(len(allowed)))] if allowed else None

    def _first(self, text: str, start: EpisodeStart) -> TaskSpec | None:
        """Return a task that an instruction may ask for in the scene; none: the scene allows none."""
        assert start.task is not None
        assert start.scene is not None
        if not text:
            return None
        tasks = read_instruction(text, start.scene, self._library).tasks
        same = (task for task in tasks if asks_for_same(task, start.task))
        return start.task if next(same, None) is not None else next(iter(tasks), None)
