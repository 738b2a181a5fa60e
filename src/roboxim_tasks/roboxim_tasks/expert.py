"""The expert: a skill's executor behind the policy interface (thesis 4.2.3).

It plans once, at its first request: candidate stages from the skill, a reference of commanded poses, the joint path
that the delta controller makes of it, and the planner's word that this very path is free. What is verified is what is
executed. Each answer is the delta from the *commanded* pose to the reference's next pose, so injected noise is
corrected and never accumulates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from roboxim_core.actions import ActionSemantics
from roboxim_core.errors import ErrorCode, PlannerError, PolicyError, TaskError
from roboxim_core.kinematics import ArmKinematics, DeltaController, delta_between
from roboxim_core.models.library import ModelLibrary
from roboxim_core.policies import ActionChunk, EpisodeStart, ObservationWindow, PolicyDescription
from roboxim_core.poses import Array, Pose
from roboxim_core.state import StateRecord
from roboxim_tasks.motion import ExpertScene, Stage
from roboxim_tasks.planning import PlannerPort, Surroundings
from roboxim_tasks.reference import Leg, ReferencePoint, SpeedConfig, make_reference
from roboxim_tasks.skills import SKILLS

MAX_TRACKING_ERROR_M = 2e-3
PLANNED_VIA_STEP_M = 0.02


@dataclass(frozen=True, kw_only=True)
class _Blocked:
    """Why a candidate does not hold."""

    stage: int
    reason: str


class Expert:
    """A privileged policy that solves any registered skill. One episode at a time; not thread-safe.

    Non-obvious: planning happens in the first `act`, because only then is the settled state known.
    """

    def __init__(
        self, library: ModelLibrary, planner: PlannerPort, config: SpeedConfig | None = None, rate_hz: float = 10.0
    ) -> None:
        """Make an expert.

        Args:
            library: Robots and objects.
            planner: Verifies and finds motions.
            config: Speeds; none: the default.
            rate_hz: Control rate that it declares [Hz].
        """
        self._library = library
        self._planner = planner
        self._config = config or SpeedConfig()
        self._rate_hz = rate_hz
        self._arms: dict[str, ArmKinematics] = {}
        self._start: EpisodeStart | None = None
        self._reference: list[ReferencePoint] | None = None
        self._first_seq = 0

    def describe(self) -> PolicyDescription:
        """Say what the expert is."""
        return PolicyDescription(
            name="expert", semantics=ActionSemantics(rate_hz=self._rate_hz), privileged=True, version="1"
        )

    def reset(self, start: EpisodeStart) -> None:
        """Take up an episode.

        Raises:
            TaskError: With code ``NO_EXPERT`` when no task or scene comes with it, or the skill is unknown.
        """
        if start.task is None or start.scene is None:
            raise TaskError(
                "the expert needs the task and the scene; send them as to a privileged policy", ErrorCode.NO_EXPERT
            )
        if start.task.skill not in SKILLS:
            raise TaskError(
                f"no expert for skill '{start.task.skill}'; expected one of: {', '.join(SKILLS)}", ErrorCode.NO_EXPERT
            )
        self._start, self._reference = start, None

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Return the delta to the reference's next pose.

        Raises:
            TaskError: When no episode was started, or the observation has no state.
            PolicyError: When no candidate motion holds.
        """
        state = window.newest.state
        if self._start is None or self._start.episode_id != window.episode_id:
            raise TaskError(f"the expert was not reset for episode '{window.episode_id}'", ErrorCode.UNKNOWN_EPISODE)
        if state is None:
            raise TaskError("the expert needs the state record in the observation; it is a privileged policy")
        if self._reference is None:
            self._reference, self._first_seq = self._plan(self._start, state), state.seq
        assert self._start.scene is not None
        commanded = self._start.scene.robot.pose.inverse() @ state.robot.pose_tcp_commanded
        step = min(max(state.seq - self._first_seq, 0), len(self._reference) - 1)
        point = self._reference[step]
        return ActionChunk(
            actions=delta_between(commanded, point.pose, point.opening)[None],
            done=step == len(self._reference) - 1,
            phases=(point.phase,),
        )

    def _plan(self, start: EpisodeStart, state: StateRecord) -> list[ReferencePoint]:
        assert start.task is not None
        assert start.scene is not None
        view = ExpertScene(task=start.task, scene=start.scene, state=state, library=self._library)
        reasons = []
        for stages in SKILLS[start.task.skill].stages(view):
            result = self._try(view, stages, start.seed)
            if isinstance(result, list):
                return result
            reasons.append(f"{stages[result.stage].name}: {result.reason}")
        raise PolicyError(
            f"the expert finds no motion for '{start.task.instruction}'; "
            f"candidates refused: {'; '.join(dict.fromkeys(reasons)) or '(none)'}"
        )

    def _try(self, view: ExpertScene, stages: Sequence[Stage], seed: int) -> list[ReferencePoint] | _Blocked:
        """Make a candidate's reference and verify it, with a planned way around what blocks a free stage."""
        legs = [Leg(stage=stage) for stage in stages]
        while True:
            reference = make_reference(view.pose_tcp, legs, self._config, view.scene.control_rate_hz)
            path, blocked = self._roll_out(view, reference)
            blocked = blocked or self._verify(view, stages, reference, path)
            if blocked is None:
                return reference
            leg = legs[blocked.stage]
            if not leg.stage.free or leg.via:
                return blocked
            first = next(i for i, point in enumerate(reference) if point.stage == blocked.stage)
            try:
                via = self._detour(view, leg.stage, path[first], seed)
            except PlannerError as error:
                return replace(blocked, reason=f"{blocked.reason}; {error}")
            legs[blocked.stage] = replace(leg, via=via)

    def _roll_out(self, view: ExpertScene, reference: Sequence[ReferencePoint]) -> tuple[Array, _Blocked | None]:
        """Return the joint path that the delta controller makes of a reference, the start included."""
        controller = DeltaController(
            self._arm(view.scene.robot.model),
            workspace=view.scene.workspace,
            pose_base_in_world=view.scene.robot.pose,
            semantics=ActionSemantics(rate_hz=view.scene.control_rate_hz),
        )
        state = controller.start(view.state.robot.joint_commands, view.state.robot.gripper_command)
        path = [state.joints]
        for point in reference:
            step = controller.step(state, delta_between(state.pose, point.pose, point.opening))
            state = step.state
            path.append(state.joints)
            off = float(np.linalg.norm(np.subtract(state.pose.position, point.pose.position)))
            if step.clipped or step.left_workspace or step.unreached or off > MAX_TRACKING_ERROR_M:
                word = "left_workspace" if step.left_workspace else "clipped" if step.clipped else "unreachable"
                return np.array(path), _Blocked(stage=point.stage, reason=f"{word} at {_short(point.pose)}")
        return np.array(path), None

    def _verify(
        self, view: ExpertScene, stages: Sequence[Stage], reference: Sequence[ReferencePoint], path: Array
    ) -> _Blocked | None:
        period_s = 1.0 / view.scene.control_rate_hz
        for index, stage in enumerate(stages):
            ticks = [i for i, point in enumerate(reference) if point.stage == index]
            if stage.pose is None or not ticks:
                continue
            problem = self._planner.check_path(path[ticks[0] : ticks[-1] + 2], period_s, _around(view, stage))
            if problem:
                return _Blocked(stage=index, reason=problem)
        return None

    def _detour(self, view: ExpertScene, stage: Stage, joints: Array, seed: int) -> tuple[Pose, ...]:
        assert stage.pose is not None
        arm = self._arm(view.scene.robot.model)
        goal = view.scene.robot.pose @ stage.pose
        poses = [arm.fk(row) for row in self._planner.plan_to_pose(joints, goal, _around(view, stage), seed)]
        kept = [poses[0]]
        for pose in poses[1:-1]:
            if np.linalg.norm(np.subtract(pose.position, kept[-1].position)) >= PLANNED_VIA_STEP_M:
                kept.append(pose)
        return tuple(kept[1:])

    def _arm(self, model: str) -> ArmKinematics:
        if model not in self._arms:
            self._arms[model] = ArmKinematics(self._library.robot(model))
        return self._arms[model]


def _around(view: ExpertScene, stage: Stage) -> Surroundings:
    return Surroundings(
        scene=view.scene,
        state=view.state,
        opening=stage.opening,
        held=stage.held,
        held_in_tcp=stage.held_in_tcp,
        touching=stage.touching,
    )


def _short(pose: Pose) -> str:
    return "({:.3f}, {:.3f}, {:.3f})".format(*pose.position)
