"""Runs trials of evaluators through the cores, without cameras: an episode costs about a second."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from roboxim_bringup.core_graph import CoreGraph
from roboxim_bringup.cores import CorePlanner
from roboxim_core.closing import Closing
from roboxim_core.episode import Draw, EpisodeRunner, RunConfig
from roboxim_core.errors import RoboximError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.seeds import SeedPath
from roboxim_tasks.trials import Trial
from roboxim_tasks.trials.actor import TrialActor

MAX_STEPS = 700
"""Longest trial; slow strategies take long."""
TRIES = 5
"""Largest number of scenes drawn for an episode until the arm can execute the trial."""


@dataclass(frozen=True, kw_only=True)
class TrialOutcome:
    """One episode of a trial."""

    trial: str
    """``<skill>/<name>``."""
    index: int
    """Number of the scene."""
    as_expected: bool
    """Whether an honest strategy succeeded, or a cheat failed at every tick."""
    reason: str
    """The last verdict's reason, or the error's; empty: success."""
    message: str = ""
    """Message of the error; empty without one."""

    def plain(self) -> dict[str, Any]:
        """Return the outcome as plain data."""
        return asdict(self)


class _Draws:
    """The scene port, which draws each scene once for all trials with the same configuration."""

    def __init__(self, scenes: Any) -> None:
        self._scenes = scenes
        self._known: dict[tuple[SeedPath, str], Draw | RoboximError] = {}

    def draw(self, seed: SeedPath, task_config: str) -> Draw:
        key = seed, task_config
        if key not in self._known:
            try:
                self._known[key] = self._scenes.draw(seed, task_config)
            except RoboximError as error:
                self._known[key] = error
        found = self._known[key]
        if isinstance(found, RoboximError):
            raise found
        return found


class TrialRuns(Closing):
    """Runs episodes of trials. A context manager; belongs to the thread that made it."""

    def __init__(self) -> None:
        """Make the cores."""
        self._library = ModelLibrary()
        self._cores = CoreGraph(Path(), renderer="tiny")
        self._planner = CorePlanner(self._library)
        self._scenes = _Draws(self._cores.ports.scenes)

    def close(self) -> None:
        """Free everything."""
        self._cores.close()

    def run(self, trial: Trial, index: int) -> TrialOutcome:
        """Run a trial in a scene.

        Non-obvious: a scene is drawn so that the expert can solve it; the arm may be unable to execute another strategy
        there. Then another scene of the same index is tried, as for an episode whose reset is infeasible.
        """
        ports = replace(self._cores.ports, scenes=self._scenes, actor=TrialActor(trial, self._library, self._planner))
        config = RunConfig(purpose="test", keep="none", max_steps=MAX_STEPS, task_config=trial.config())
        runner = EpisodeRunner(ports, config)
        for attempt in range(TRIES):
            seed = SeedPath(run_seed=config.run_seed, purpose=config.purpose, index=index, attempt=attempt)
            result = runner.run_attempt(seed)
            if result.outcome != "error":
                break
        succeeded = result.outcome == "success"
        as_expected = succeeded if trial.honest else result.outcome == "failure" and not result.success_ever
        reason = "" if succeeded else result.verdict.reason or result.reason
        return TrialOutcome(
            trial=f"{trial.skill}/{trial.name}", index=index, as_expected=as_expected, reason=reason,
            message=result.message,
        )  # fmt: skip
