"""Several motions as one request: approach, grasp, retreat.

A free motion to a pose has many goal configurations, and most failures of a grasp depend on the choice among them: from
some, the following straight lines end at a joint limit or in a collision; from others, they succeed. The planner
therefore first follows the lines from every candidate, nearest first. It searches a free motion only to a candidate
from which all lines succeed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ErrorCode, InvalidRequestError, PlannerError, one_of
from roboxim_core.poses import Pose
from roboxim_planner.checks import no_watch
from roboxim_planner.motions.paths import Watch
from roboxim_planner.pipeline import MotionOptions, Plan, Planner
from roboxim_planner.scene import AllowedContact, PlanningScene

Array = npt.NDArray[np.float64]
KINDS = ("pose", "joints", "cartesian")
_OF_THE_START = (ErrorCode.START_IN_COLLISION, ErrorCode.START_OUTSIDE_LIMITS)
"""Errors that no other goal configuration avoids."""


@dataclass(frozen=True, kw_only=True)
class StageGoal:
    """A goal that may depend on the pose at which the stage begins."""

    pose: Pose
    """The goal."""
    frame: str = "world"
    """``world``, or ``tcp``: the TCP at the start of the stage."""
    relative: bool = False
    """In ``world`` only: the pose is a displacement of the TCP; position added, rotation applied about the TCP."""

    def resolve(self, pose_tcp: Pose) -> Pose:
        """Return the goal in the world for a stage that begins with the TCP at a pose in the world."""
        from scipy.spatial.transform import Rotation

        if self.frame == "tcp":
            return pose_tcp @ self.pose
        if not self.relative:
            return self.pose
        moved = np.add(pose_tcp.position, self.pose.position)
        return Pose.from_arrays(moved, self.pose.rotation * Rotation.from_quat(pose_tcp.quat_xyzw))


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One motion of a sequence, and the changes of the scene before it."""

    kind: str
    """``pose``: free motion to any of the goals; ``joints``; ``cartesian``: straight lines through all of them."""
    name: str = ""
    """Name, for messages."""
    goals: tuple[StageGoal, ...] = ()
    """Goals of the kinds ``pose`` and ``cartesian``."""
    joints: tuple[float, ...] = ()
    """Goal of the kind ``joints`` [rad]."""
    min_fraction: float = 1.0
    """For ``cartesian``: smallest fraction that counts as success, 0..1."""
    ignore_collisions: bool = False
    """Of ``cartesian``."""
    attach: tuple[str, ...] = ()
    """Bodies that the gripper holds from this stage on."""
    detach: tuple[str, ...] = ()
    """Held bodies that are released before this stage."""
    gripper_opening: float | None = None
    """Opening of the gripper from this stage on, 1 = open; none: unchanged."""
    allowed: tuple[AllowedContact, ...] = ()
    """Pairs that may touch in this stage."""
    options: MotionOptions | None = None
    """Options of this stage; none: the sequence's."""

    def __post_init__(self) -> None:
        """Check that the stage has the goal that its kind needs.

        Raises:
            InvalidRequestError: On an unknown kind or a missing goal.
        """
        if self.kind not in KINDS:
            raise InvalidRequestError(f"unknown kind of stage '{self.kind}'; {one_of(KINDS, self.kind)}")
        if self.kind == "joints" and not self.joints:
            raise InvalidRequestError(f"stage '{self.name}' of kind joints needs joint positions")
        if self.kind != "joints" and not self.goals:
            raise InvalidRequestError(f"stage '{self.name}' of kind {self.kind} needs at least one goal")

    def enter(self, scene: PlanningScene, pose_tcp: Pose) -> tuple[PlanningScene, PlanningScene]:
        """Return the scene of this stage, and the scene after it, for the next stage.

        Args:
            scene: The scene that the stage before left.
            pose_tcp: The TCP in the world at the start.
        """
        for name in self.detach:
            scene = scene.release(name, pose_tcp)
        for name in self.attach:
            scene = scene.attach(name, pose_tcp)
        if self.gripper_opening is not None:
            scene = scene.with_opening(self.gripper_opening)
        return scene.with_contacts(self.allowed), scene


@dataclass(frozen=True, kw_only=True)
class SequenceConfig:
    """Budget of the search over candidates."""

    configurations: int = 400
    """Goal configurations of a pose stage that are tried, nearest first."""
    wide_configurations: int = 2
    """Goal configurations from which lines are searched widely if the plain lines fail from all; see `plan_line`."""
    motions: int = 6
    """Free motions tried to configurations from which the following lines succeed."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SequencePlan:
    """Verified motions, each beginning where the one before ends."""

    plans: tuple[Plan, ...]
    """One per stage."""
    goal_indices: tuple[int, ...]
    """Index of the goal that each pose stage reached; -1 for the other kinds."""


def plan_sequence(
    planner: Planner,
    scene: PlanningScene,
    start: npt.ArrayLike,
    stages: Sequence[Stage],
    options: MotionOptions | None = None,
    watch: Watch = no_watch,
    *,
    entered: Callable[[int], None] = lambda _: None,
    config: SequenceConfig | None = None,
) -> SequencePlan:
    """Plan motions one after the other, each reaching a goal from which the later ones succeed.

    Args:
        planner: The planner.
        scene: Obstacles at the start.
        start: Arm configuration at the start, shape (dof,) [rad].
        stages: The motions, at least one.
        options: Limits, padding, seed; none: the defaults.
        watch: Called regularly; ends the request by raising.
        entered: Called with the index of the stage that is being planned.
        config: Budget; none: the default.

    Raises:
        PlannerError: If no sequence is found; the message names the failed stage, the reason, and the number of
        configurations tried.
        InvalidRequestError: On malformed input.
    """
    if not stages:
        raise InvalidRequestError("a sequence needs at least one stage")
    search = _Search(planner, list(stages), options or MotionOptions(), watch, entered, config or SequenceConfig())
    begin = planner.robot.check_joints(start, what="start")
    steps = search.solve(0, begin, scene)
    if steps is None:
        raise search.failure()
    return SequencePlan(plans=tuple(s.plan for s in steps), goal_indices=tuple(s.goal_index for s in steps))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Step:
    plan: Plan
    scene: PlanningScene
    goal_index: int = -1


class _Search:
    """Depth-first search over the goals of free motions; stores the error of the furthest stage that failed."""

    def __init__(
        self,
        planner: Planner,
        stages: list[Stage],
        options: MotionOptions,
        watch: Watch,
        entered: Callable[[int], None],
        config: SequenceConfig,
    ) -> None:
        self._planner, self._stages, self._options = planner, stages, options
        self._watch, self._entered, self._config = watch, entered, config
        self._worst: tuple[int, PlannerError] | None = None
        self._tried: dict[int, int] = {}
        self._last = ErrorCode.OK

    def solve(self, k: int, at: Array, scene: PlanningScene) -> list[_Step] | None:
        """Return the steps from stage k on, or none."""
        if k == len(self._stages):
            return []
        if self._stages[k].kind == "cartesian":
            steps = self._lines(k, at, scene, wide=True)
            return None if steps is None else self._continue(k, steps)
        return self._free(k, at, scene)

    def _continue(self, k: int, steps: list[_Step]) -> list[_Step] | None:
        rest = self.solve(k + len(steps), steps[-1].plan.end, steps[-1].scene)
        return None if rest is None else [*steps, *rest]

    def _free(self, k: int, at: Array, scene: PlanningScene) -> list[_Step] | None:
        stage, here, left = self._enter(k, at, scene)
        options = stage.options or self._options
        if k == len(self._stages) - 1 and stage.kind == "pose":
            targets = [goal.resolve(self._tcp(at, scene)) for goal in stage.goals]
            with self._storing_error(k):
                plan = self._planner.plan_to_pose(here, at, targets, options, self._watch)
                return [_Step(plan=plan, scene=left, goal_index=plan.goal_index)]
            return None
        candidates = self._candidates(k, stage, at, here, options)
        self._tried[k] = self._tried.get(k, 0) + len(candidates)
        lines_follow = k + 1 < len(self._stages) and self._stages[k + 1].kind == "cartesian"
        wider = candidates[: self._config.wide_configurations] if lines_follow else []
        motions = 0
        for number, (index, goal) in enumerate([*candidates, *wider]):
            following = self._lines(k + 1, goal, left, wide=number >= len(candidates))
            if following is None:
                continue
            motions += 1
            self._entered(k)
            motion: Plan | None = None
            with self._storing_error(k):
                motion = self._planner.plan_to_joints(here, at, goal, options, self._watch)
            if motion is not None:
                found = self._continue(k, [_Step(plan=motion, scene=left, goal_index=index), *following])
                if found is not None:
                    return found
            elif self._last in _OF_THE_START:
                break
            if motions >= self._config.motions:
                break
        return None

    def _candidates(
        self, k: int, stage: Stage, at: Array, scene: PlanningScene, options: MotionOptions
    ) -> list[tuple[int, Array]]:
        """Return goal configurations, nearest first, each with the number of its goal."""
        found: list[tuple[int, Array]] = []
        if stage.kind == "joints":
            joints = self._planner.robot.check_joints(stage.joints, what=f"stage '{stage.name}'")
            with self._storing_error(k):
                found.append((-1, self._planner.check_goal(scene, joints, options)))
            return found
        for index, goal in enumerate(stage.goals):
            self._watch("goals", index)
            target = goal.resolve(self._tcp(at, scene))
            with self._storing_error(k):
                solutions = self._planner.inverse_kinematics(
                    target, at, scene=scene, count=self._config.configurations, seed=options.seed
                )
                found += [(index, q) for q in solutions]
        found.sort(key=lambda pair: float(np.abs(pair[1] - at).max()))
        return found[: self._config.configurations]

    def _lines(self, k: int, at: Array, scene: PlanningScene, *, wide: bool) -> list[_Step] | None:
        """Return the steps of the straight-line stages from k on up to the next free motion, or none."""
        steps: list[_Step] = []
        while k < len(self._stages) and self._stages[k].kind == "cartesian":
            stage, here, left = self._enter(k, at, scene)
            tcp = self._tcp(at, scene)
            targets = [goal.resolve(tcp) for goal in stage.goals]
            plan: Plan | None = None
            with self._storing_error(k):
                plan = self._planner.plan_cartesian(
                    here,
                    at,
                    targets,
                    stage.options or self._options,
                    min_fraction=stage.min_fraction,
                    ignore_collisions=stage.ignore_collisions,
                    wide=wide,
                    watch=self._watch,
                )
            if plan is None:
                return None
            steps.append(_Step(plan=plan, scene=left))
            k, at, scene = k + 1, plan.end, left
        return steps

    def _enter(self, k: int, at: Array, scene: PlanningScene) -> tuple[Stage, PlanningScene, PlanningScene]:
        self._entered(k)
        stage = self._stages[k]
        return stage, *stage.enter(scene, self._tcp(at, scene))

    def _tcp(self, at: Array, scene: PlanningScene) -> Pose:
        return scene.robot_pose @ self._planner.robot.fk(at)

    @contextmanager
    def _storing_error(self, k: int) -> Iterator[None]:
        """Store a planner's error in stage k instead of raising it."""
        try:
            yield
        except PlannerError as error:
            self._last = error.code
            if self._worst is None or k > self._worst[0]:
                self._worst = (k, error)

    def failure(self) -> PlannerError:
        """Return the error of the furthest stage that failed."""
        if self._worst is None:
            return PlannerError("no sequence found")
        k, error = self._worst
        name = self._stages[k].name or str(k + 1)
        before = max((n for n in self._tried if n < k), default=None)
        message = f"stage '{name}' ({k + 1} of {len(self._stages)}): {error}"
        if before is not None:
            chosen = self._stages[before].name or str(before + 1)
            message += f"; {self._tried[before]} goal configuration(s) of stage '{chosen}' tried"
        return PlannerError(message, ErrorCode(error.code))
