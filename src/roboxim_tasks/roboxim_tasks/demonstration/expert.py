"""The expert: a skill's executor behind the policy interface.

A scene is planned once. At its first request the expert verifies the reset's solution of the drawn scene in the settled
scene, and replans only if that fails. It then answers each request with the delta from the *commanded* pose to the
reference's next pose, so that injected noise is corrected and never accumulates.

The expert monitors its grasp:

- If the grasp differs a little from the plan, or the lifted object sags, the expert replans the rest from the object's
  true pose in the hand. This costs no tick.
- If the hand is empty, the expert opens it, withdraws and tries again. It marks those actions as ``recovery``, so that
  the episode counts as recovered and not as a first-try success.
"""

from __future__ import annotations

from dataclasses import replace

from roboxim_core.actions import ANY_RATE, ActionSemantics
from roboxim_core.errors import ErrorCode, PolicyError, TaskError
from roboxim_core.kinematics import delta_between
from roboxim_core.models.library import ModelLibrary
from roboxim_core.policies import RECOVERY, ActionChunk, EpisodeStart, ObservationWindow, PolicyDescription
from roboxim_core.poses import distance
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_core.state import StateRecord
from roboxim_tasks.demonstration.planning import PlannerPort
from roboxim_tasks.demonstration.reference import SpeedConfig
from roboxim_tasks.demonstration.solvable import Solvability
from roboxim_tasks.demonstration.solver import Solution, Solver
from roboxim_tasks.motion import ROBOT, ExpertScene, Stage, with_poses
from roboxim_tasks.sequences.progress import Progress
from roboxim_tasks.sequences.steps import steps_of
from roboxim_tasks.skills import SKILLS

MAX_RECOVERIES = 2
HELD_TOLERANCE_M = 0.003
HELD_TOLERANCE_RAD = 0.035
DONE_WAIT_S = 2.0
"""Time at the end of a step after which the expert repeats an unfinished step [s]."""
SAG_TOLERANCE_M, SAG_TOLERANCE_RAD = 0.010, 0.06
"""Largest shift [m] and rotation [rad] of a lifted object in the hand that need no replanning."""


class Expert:
    """A privileged policy that solves any registered skill. One episode at a time; not thread-safe.

    Non-obvious: the motion is chosen in the first `act`, because only then is the settled state known. If that is not
    at tick 0, another actor has acted so far, and the expert continues from there, with the object in the gripper.
    """

    def __init__(
        self,
        library: ModelLibrary,
        planner: PlannerPort,
        config: SpeedConfig | None = None,
        *,
        direct: bool = False,
        solvability: Solvability | None = None,
    ) -> None:
        """Make an expert.

        Args:
            library: Robots and objects.
            planner: Verifies and finds motions.
            config: Speeds; none: the default.
            direct: Whether to go straight from stage to stage without the planner; the baseline for scenes with a
                blocked path.
            solvability: Solver of drawn scenes, with the same speeds. Sharing the resets' solver avoids planning a
                scene twice and does not change the expert's actions. None: a new one.
        """
        self._library = library
        self._solver = Solver(library, planner, config, direct=direct)
        self._solvability = solvability or Solvability(library, planner, config)
        self._direct = direct
        self._start: EpisodeStart | None = None
        self._solution: Solution | None = None
        self._first_seq = 0
        self._recoveries = 0
        self._steps: tuple[TaskSpec, ...] = ()
        self._number = 0
        """Number of the step at hand, from 0."""
        self._scene = SceneSpec()
        """The scene, with its objects where they were at the begin of the step at hand."""
        self._progress: Progress | None = None

    def describe(self) -> PolicyDescription:
        """Return the expert's description."""
        return PolicyDescription(
            name="direct_expert" if self._direct else "expert",
            semantics=ActionSemantics(rate_hz=ANY_RATE),
            privileged=True,
            version="1",
        )

    def reset(self, start: EpisodeStart) -> None:
        """Start an episode.

        Raises:
            TaskError: With code ``NO_EXPERT`` when the request lacks task or scene, or the skill is unknown.
        """
        if start.task is None or start.scene is None:
            raise TaskError(
                "the expert needs the task and the scene; send them as to a privileged policy", ErrorCode.NO_EXPERT
            )
        steps = steps_of(start.task)
        if unknown := [step.skill for step in steps if step.skill not in SKILLS]:
            raise TaskError(
                f"no expert for skill '{unknown[0]}'; expected one of: {', '.join(SKILLS)}", ErrorCode.NO_EXPERT
            )
        self._start, self._solution, self._recoveries = start, None, 0
        self._steps, self._number, self._progress, self._scene = steps, 0, None, start.scene

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Return the delta to the reference's next pose.

        Raises:
            TaskError: When no episode was started, or the observation has no state.
            PolicyError: When no candidate motion passes verification.
        """
        state = window.newest.state
        if self._start is None or self._start.episode_id != window.episode_id:
            raise TaskError(f"the expert was not reset for episode '{window.episode_id}'", ErrorCode.UNKNOWN_EPISODE)
        if state is None:
            raise TaskError("the expert needs the state record in the observation; it is a privileged policy")
        assert self._start.task is not None
        view = ExpertScene(
            task=self._start.task, scene=self._scene, state=state, library=self._library, direct=self._direct
        )
        if len(self._steps) > 1:
            view = self._go_on(view)
        if self._solution is None:
            self._solution, self._first_seq = self._plan_first(view), state.seq
        elif self._recoveries < MAX_RECOVERIES:
            self._correct_grasp(view, self._solution)
        reference = self._solution.reference
        step = self._step(state)
        point = reference[step]
        return ActionChunk(
            actions=delta_between(view.pose_tcp, point.pose, point.opening)[None],
            done=step == len(reference) - 1 and self._number == len(self._steps) - 1,
            phases=(RECOVERY if self._recoveries else point.phase,),
        )

    def _go_on(self, view: ExpertScene) -> ExpertScene:
        """Return the scene of the step at hand, and plan the next step once the one before is done.

        Non-obvious: the expert waits at the end of a step until the step's evaluator says that it is done, e.g. until
        an object lies still. If it still is not after `DONE_WAIT_S`, the expert does the step again.
        """
        state = view.state
        self._progress = self._progress or Progress(view.task, state)
        self._progress.assess(state)
        step = replace(view, task=self._steps[self._number])
        if self._solution is None or self._number == len(self._steps) - 1:
            return step if self._solution is not None else view
        waited = (state.seq - self._first_seq - len(self._solution.reference) + 1) / view.scene.control_rate_hz
        if waited < 0:
            return step
        if self._progress.done[self._number]:
            self._number += 1
            last, self._scene = self._solution.stages[-1], with_poses(view.scene, state)
            step = replace(
                view, task=self._steps[self._number], scene=self._scene, held=last.held, lifted=bool(last.held)
            )
            self._solution, self._first_seq = self._plan(step), state.seq
        elif waited > DONE_WAIT_S and self._recoveries < MAX_RECOVERIES:
            self._recoveries += 1
            self._solution, self._first_seq = self._plan(replace(step, recovering=True)), state.seq
        return step

    def _step(self, state: StateRecord) -> int:
        assert self._solution is not None
        return min(max(state.seq - self._first_seq, 0), len(self._solution.reference) - 1)

    def _plan_first(self, view: ExpertScene) -> Solution:
        """Return the drawn scene's solution if it is valid in the settled scene, else plan again.

        Args:
            view: The scene, with the whole task.
        """
        assert self._start is not None
        first = replace(view, task=self._steps[0])
        if view.state.seq > 0:
            return self._plan(_taken_over(first))
        if self._direct:
            return self._plan(first)
        try:
            drawn = self._solvability.solution(view.task, view.scene, self._start.seed)
        except PolicyError:
            return self._plan(first)
        return self._plan(first) if self._solver.mismatch(first, drawn) else drawn

    def _plan(self, view: ExpertScene) -> Solution:
        assert self._start is not None
        return self._solver.solve(view, SKILLS[view.task.skill].stages(view), self._start.seed)

    def _correct_grasp(self, view: ExpertScene, solution: Solution) -> None:
        """Replan if the gripper's contents differ from the plan."""
        step = self._step(view.state)
        now, before = (solution.stages[solution.reference[i].stage] for i in (step, max(step - 1, 0)))
        if not now.held:
            return
        if not _touched(view.state, now.held):
            self._recoveries += 1
            view = replace(view, recovering=True)
        elif before.lifts and not now.lifts:
            if not _held_elsewhere(view, now, SAG_TOLERANCE_M, SAG_TOLERANCE_RAD):
                return
            view = replace(view, held=now.held, lifted=True)
        elif before.held or not _held_elsewhere(view, now, HELD_TOLERANCE_M, HELD_TOLERANCE_RAD):
            return
        else:
            view = replace(view, held=now.held)
        try:
            self._solution, self._first_seq = self._plan(view), view.state.seq
        except PolicyError:
            if view.recovering:
                raise


def _taken_over(view: ExpertScene) -> ExpertScene:
    """Return the scene that another actor has left, with the object in the gripper."""
    for entity in view.state.entities:
        pressing = {
            contact.link_b if contact.body_a == entity.name else contact.link_a
            for contact in view.state.contacts_between(ROBOT, entity.name)
            if contact.force_last > 0.0
        }
        if len(pressing) > 1:
            return replace(view, held=entity.name)
    return replace(view, recovering=True)


def _touched(state: StateRecord, entity: str) -> bool:
    return any(contact.force_max > 0.0 for contact in state.contacts_between(ROBOT, entity))


def _held_elsewhere(view: ExpertScene, stage: Stage, most_m: float, most_rad: float) -> bool:
    measured = view.in_base(view.state.robot.pose_tcp_measured).inverse() @ view.pose_of(stage.held)
    shift_m, angle_rad = distance(measured, stage.held_in_tcp)
    return shift_m > most_m or angle_rad > most_rad
