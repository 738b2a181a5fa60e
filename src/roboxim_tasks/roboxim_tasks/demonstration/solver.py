"""Search of a skill's candidates for a collision-free motion; the verified joint path is the executed one.

A candidate's stages become a reference of commanded poses. The delta controller rolls the reference out, and the
planner checks the resulting joint path stage by stage. A blocked stage that is marked as free gets a planned detour.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from roboxim_core.actions import ActionSemantics
from roboxim_core.errors import PlannerError, PolicyError
from roboxim_core.kinematics import Arms, ControllerState, DeltaController, delta_between
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Array, Pose, distance
from roboxim_core.surroundings import Surroundings
from roboxim_tasks.demonstration.planning import PlannerPort
from roboxim_tasks.demonstration.reference import Leg, ReferencePoint, SpeedConfig, make_reference
from roboxim_tasks.motion import GRIPPER, TABLE, ExpertScene, Stage
from roboxim_tasks.roles import task_distractors

MAX_TRACKING_ERROR_M = 2e-3
MAX_TURN_ERROR_RAD = 0.02
"""Largest rotation from a stage's goal at its end, for an arm whose tool turns in fewer than three directions [rad]."""
PLANNED_VIA_STEP_M = 0.02
MAX_CANDIDATES = 48
CLEARANCE_M = 0.004
"""Clearance of a motion from distractors, and of the arm from everything [m].

It covers deviations from the verified path by noise and the controller's lag.
"""
START_TOLERANCE_RAD = 1e-6
SETTLED_TOLERANCE_M, SETTLED_TOLERANCE_RAD = 1e-3, 0.01
"""Largest settling movement of an object with which the solution of the drawn scene stays valid."""


@dataclass(frozen=True, kw_only=True)
class Solution:
    """A verified motion."""

    stages: tuple[Stage, ...]
    """The candidate."""
    reference: list[ReferencePoint]
    """Commanded pose of each tick, from the one after the scene's."""
    path: Array
    """Joint path of the delta controller that follows it, shape (ticks + 1, joints), start included [rad]."""
    refused: tuple[str, ...]
    """Reasons for which better candidates were refused."""


@dataclass(frozen=True, kw_only=True)
class _Blocked:
    """Reason for which a candidate is refused."""

    stage: int
    reason: str
    cause: str = ""
    """The reason with its number, for people; empty: the reason."""


@dataclass(frozen=True, kw_only=True)
class _Rolled:
    """A verified first part of a candidate."""

    pose: Pose
    """Reference pose at its end."""
    state: ControllerState
    """State of the controller at its end."""
    reference: tuple[ReferencePoint, ...] = ()
    path: tuple[tuple[float, ...], ...] = ()


_Cache = dict[tuple[Stage, ...], _Rolled | _Blocked]


class NoMotionError(PolicyError):
    """No candidate of a skill has a feasible motion."""

    cause = ""
    """Why the candidate that came furthest was refused, e.g. ``grasp: 12 mm short of (0.250, 0.100, 0.020)``."""


class Solver:
    """Search for the first feasible candidate. Not thread-safe (kinematics)."""

    def __init__(
        self,
        library: ModelLibrary,
        planner: PlannerPort,
        config: SpeedConfig | None = None,
        *,
        direct: bool = False,
    ) -> None:
        """Make a solver.

        Args:
            library: Robots and objects.
            planner: Verifies and finds motions.
            config: Speeds; none: the default.
            direct: Whether to go straight from stage to stage without the planner: the solver then takes the first
                candidate that the arm can follow.
        """
        self._planner = planner
        self._direct = direct
        self._config = config or SpeedConfig()
        self.arms = Arms(library)
        """Kinematics by robot."""

    def solve(self, view: ExpertScene, candidates: Iterable[tuple[Stage, ...]], seed: int) -> Solution:
        """Return the first feasible candidate.

        Non-obvious: stages that candidates share at their beginning, up to a standstill of the arm, are rolled out and
        verified once. A candidate that begins with stages at which an earlier one was refused is skipped.

        Args:
            view: The present scene.
            candidates: Stages, best first; taken lazily.
            seed: Seed of the planner's detours.

        Raises:
            NoMotionError: When no candidate is feasible; lists the reasons.
        """
        reasons: list[str] = []
        furthest, cause = -1, ""
        dead_ends: set[tuple[Stage, ...]] = set()
        cache: _Cache = {}
        tried = 0
        for stages in candidates:
            if any(stages[:end] in dead_ends for end in range(1, len(stages) + 1)):
                continue
            if tried == MAX_CANDIDATES:
                break
            tried += 1
            result = self._try(view, stages, seed, cache)
            if isinstance(result, _Blocked):
                dead_ends.add(stages[: result.stage + 1])
                if result.stage > furthest:
                    furthest, cause = result.stage, f"{stages[result.stage].name}: {result.cause or result.reason}"
                reasons.append(f"{stages[result.stage].name}: {result.reason}")
                continue
            return Solution(
                stages=stages, reference=list(result.reference), path=np.array(result.path), refused=tuple(reasons)
            )
        error = NoMotionError(
            f"the expert finds no motion for '{view.task.instruction}'; "
            f"candidates refused: {'; '.join(dict.fromkeys(reasons)) or '(none)'}"
        )
        error.cause = cause
        raise error

    def obstruction(self, view: ExpertScene, solution: Solution, clearance_m: float = 0.0) -> str:
        """Return the planner's objection to a solution, e.g. of a direct solver, or an empty text.

        Args:
            view: The present scene.
            solution: The solution.
            clearance_m: Clearance of the motion from distractors, and of the arm from everything [m].

        Raises:
            RoboximError: When the planner does not answer.
        """
        path = [tuple(row) for row in solution.path]
        blocked = self._verify(view, solution.stages, solution.reference, path, clearance_m)
        return f"{solution.stages[blocked.stage].name}: {blocked.reason}" if blocked else ""

    def mismatch(self, view: ExpertScene, solution: Solution) -> str:
        """Return why the solution of a drawn scene is invalid in the settled one, or an empty text.

        Args:
            view: The settled scene.
            solution: The solution of the same scene as drawn.

        Raises:
            RoboximError: When the planner does not answer.
        """
        commands = view.state.robot.joint_commands
        if len(commands) != solution.path.shape[1] or np.abs(solution.path[0] - commands).max() > START_TOLERANCE_RAD:
            return "the arm starts elsewhere"
        for entity in view.scene.entities:
            state = view.state.entity(entity.name)
            joints = dict(zip(state.joint_names, state.joint_positions, strict=True))
            shift_m, angle_rad = distance(entity.pose, state.pose)
            slid = max((abs(joints[name] - q) for name, q in entity.joint_positions.items()), default=0.0)
            if max(shift_m, slid) > SETTLED_TOLERANCE_M or angle_rad > SETTLED_TOLERANCE_RAD:
                return f"{entity.name} has moved"
        return self.obstruction(view, solution, CLEARANCE_M)

    def _try(self, view: ExpertScene, stages: tuple[Stage, ...], seed: int, cache: _Cache) -> _Rolled | _Blocked:
        """Roll out and verify a candidate, one run of stages between standstills after the other."""
        controller = DeltaController(
            self.arms[view.scene.robot.model],
            workspace=view.scene.workspace,
            pose_base_in_world=view.scene.robot.pose,
            semantics=ActionSemantics(rate_hz=view.scene.control_rate_hz),
        )
        start = controller.start(view.state.robot.joint_commands, view.state.robot.gripper_command)
        rolled: _Rolled | _Blocked = _Rolled(pose=view.pose_tcp, state=start, path=(start.joints,))
        begin = 0
        while begin < len(stages):
            assert isinstance(rolled, _Rolled)
            end = begin + 1
            if stages[begin].pose is not None:
                while end < len(stages) and stages[end].pose is not None:
                    end += 1
            key = stages[:end]
            if key not in cache:
                cache[key] = self._extend(view, controller, rolled, stages[begin:end], begin, seed)
            rolled = cache[key]
            if isinstance(rolled, _Blocked):
                return rolled
            begin = end
        return rolled

    def _extend(
        self,
        view: ExpertScene,
        controller: DeltaController,
        before: _Rolled,
        stages: Sequence[Stage],
        first: int,
        seed: int,
    ) -> _Rolled | _Blocked:
        """Add a run of stages, with a planned detour where a free stage is blocked."""
        legs = [Leg(stage=stage) for stage in stages]
        while True:
            points = make_reference(before.pose, legs, self._config, view.scene.control_rate_hz)
            state, path, blocked = _roll_out(controller, before.state, points)
            if not self._direct:
                blocked = self._verify(view, stages, points, path, CLEARANCE_M) or blocked
            if blocked is None:
                return _Rolled(
                    pose=points[-1].pose if points else before.pose,
                    state=state,
                    reference=before.reference + tuple(replace(p, stage=p.stage + first) for p in points),
                    path=(*before.path, *path[1:]),
                )
            leg = legs[blocked.stage]
            refused = replace(blocked, stage=blocked.stage + first)
            if self._direct or not leg.stage.free or leg.via:
                return refused
            tick = next(i for i, point in enumerate(points) if point.stage == blocked.stage)
            try:
                via = self._detour(view, leg.stage, np.array(path[tick]), seed)
            except PlannerError as error:
                return replace(refused, reason=f"{blocked.reason}; {error}")
            legs[blocked.stage] = replace(leg, via=via)

    def _verify(
        self,
        view: ExpertScene,
        stages: Sequence[Stage],
        points: Sequence[ReferencePoint],
        path: Sequence[tuple[float, ...]],
        clearance_m: float = 0.0,
    ) -> _Blocked | None:
        """Check the rolled-out path of each moving stage, and its clearance."""
        period_s = 1.0 / view.scene.control_rate_hz
        for index, stage in enumerate(stages):
            ticks = [i for i, point in enumerate(points) if point.stage == index]
            if stage.pose is None or not ticks or ticks[-1] + 2 > len(path):
                continue
            joints = np.array(path[ticks[0] : ticks[-1] + 2])
            around = _around(view, stage)
            problem = self._planner.check_path(joints, period_s, around)
            if not problem and clearance_m and (wider := _with_clearance(view, around, clearance_m)):
                problem = self._planner.check_path(joints, period_s, wider)
            if problem:
                return _Blocked(stage=index, reason=problem)
        return None

    def _detour(self, view: ExpertScene, stage: Stage, joints: Array, seed: int) -> tuple[Pose, ...]:
        assert stage.pose is not None
        arm = self.arms[view.scene.robot.model]
        goal = view.scene.robot.pose @ stage.pose
        poses = [arm.fk(row) for row in self._planner.plan_to_pose(joints, goal, _around(view, stage), seed)]
        kept = [poses[0]]
        for pose in poses[1:-1]:
            if np.linalg.norm(np.subtract(pose.position, kept[-1].position)) >= PLANNED_VIA_STEP_M:
                kept.append(pose)
        return tuple(kept[1:])


def _roll_out(
    controller: DeltaController, state: ControllerState, points: Sequence[ReferencePoint]
) -> tuple[ControllerState, list[tuple[float, ...]], _Blocked | None]:
    """Return the controller's last state, its joint path along a reference, and where it cannot follow."""
    path = [state.joints]
    for number, point in enumerate(points):
        step = controller.step(state, delta_between(state.pose, point.pose, point.opening))
        state = step.state
        path.append(state.joints)
        off, turned = distance(state.pose, point.pose)
        if turned > MAX_TURN_ERROR_RAD and [p.stage for p in points[number : number + 2]] != [point.stage] * 2:
            reason = f"the tool stays {turned:.2f} rad from the rotation wanted at {_short(point.pose)}"
            return state, path, _Blocked(stage=point.stage, reason=reason)
        if step.clipped or step.left_workspace or step.unreached or off > MAX_TRACKING_ERROR_M:
            word = "left_workspace" if step.left_workspace else "clipped" if step.clipped else "unreachable"
            place = _short(point.pose)
            outcome = {
                "left_workspace": f"the motion leaves the workspace at {place}",
                "clipped": f"a step is too large at {place}",
                "unreachable": f"{1000.0 * off:.0f} mm short of {place}",
            }
            return state, path, _Blocked(stage=point.stage, reason=f"{word} at {place}", cause=outcome[word])
    return state, path, None


def _around(view: ExpertScene, stage: Stage) -> Surroundings:
    return Surroundings(
        scene=view.scene,
        state=view.state,
        opening=stage.opening,
        held=stage.held,
        held_in_tcp=stage.held_in_tcp,
        touching=stage.touching,
        moved=stage.moved,
    )


def _with_clearance(view: ExpertScene, around: Surroundings, clearance_m: float) -> Surroundings | None:
    """Return surroundings in which everything keeps clear of distractors, and the arm of all objects.

    The hand and the held object may come close to the objects of the task. Return none if a small deviation of the arm
    would disturb nothing, and after a failed try, when the gripper may be next to a distractor.
    """
    distractors = {thing.entity for thing in task_distractors(view.task)}
    if view.recovering or not (distractors or any(entity.fixed for entity in view.scene.entities)):
        return None
    others = (TABLE, *(entity.name for entity in view.scene.entities if entity.name not in distractors))
    close = (GRIPPER, around.held) if around.held else (GRIPPER,)
    may_touch = tuple((part, name) for part in close for name in others if part != name)
    return replace(around, touching=around.touching + may_touch, padding_m=clearance_m)


def _short(pose: Pose) -> str:
    return "({:.3f}, {:.3f}, {:.3f})".format(*pose.position)
