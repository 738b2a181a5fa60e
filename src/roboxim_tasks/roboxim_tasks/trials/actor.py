"""Privileged policy that executes a trial."""

from __future__ import annotations

from roboxim_core.actions import ActionSemantics
from roboxim_core.errors import TaskError
from roboxim_core.kinematics import delta_between
from roboxim_core.models.library import ModelLibrary
from roboxim_core.policies import ActionChunk, EpisodeStart, ObservationWindow, PolicyDescription
from roboxim_tasks.demonstration.planning import PlannerPort
from roboxim_tasks.demonstration.solver import Solution, Solver
from roboxim_tasks.motion import ExpertScene
from roboxim_tasks.trials.base import Trial


class TrialActor:
    """Policy that plans a trial once, at its first request, and executes it without any correction.

    The planner verifies an honest way like the expert's motions. A cheat goes straight from stage to stage and may
    touch anything.
    """

    def __init__(self, trial: Trial, library: ModelLibrary, planner: PlannerPort) -> None:
        """Prepare to act.

        Args:
            trial: The trial to execute.
            library: Robots and objects.
            planner: Verifies the motions of honest ways.
        """
        self._trial = trial
        self._library = library
        self._solver = Solver(library, planner, direct=not trial.honest)
        self._start: EpisodeStart | None = None
        self._solution: Solution | None = None
        self._first_seq = 0

    def describe(self) -> PolicyDescription:
        """Return the policy's description."""
        return PolicyDescription(name=self._trial.name, semantics=ActionSemantics(), privileged=True)

    def reset(self, start: EpisodeStart) -> None:
        """Start an episode."""
        self._start, self._solution = start, None

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Return the delta to the next pose.

        Raises:
            TaskError: When the request lacks the episode's task, scene or state, which a privileged policy receives.
            PolicyError: When the arm can follow none of the trial's candidates.
        """
        state = window.newest.state
        if self._start is None or self._start.task is None or self._start.scene is None or state is None:
            raise TaskError("a trial needs task, scene and state; send them as to a privileged policy")
        view = ExpertScene(task=self._start.task, scene=self._start.scene, state=state, library=self._library)
        if self._solution is None:
            self._solution = self._solver.solve(view, self._trial.stages(view), self._start.seed)
            self._first_seq = state.seq
        reference = self._solution.reference
        step = min(state.seq - self._first_seq, len(reference) - 1)
        point = reference[step]
        return ActionChunk(
            actions=delta_between(view.pose_tcp, point.pose, point.opening)[None], done=step == len(reference) - 1
        )
