"""Solvability of drawn scenes: plan every stage before the simulation starts."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

from roboxim_core.errors import PolicyError
from roboxim_core.kinematics import ArmKinematics
from roboxim_core.models.library import ModelLibrary
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_core.state import EntityState, RobotState, StateRecord
from roboxim_tasks.demonstration.chain import solve_all
from roboxim_tasks.demonstration.planning import PlannerPort
from roboxim_tasks.demonstration.reference import SpeedConfig
from roboxim_tasks.demonstration.solver import NoMotionError, Solution, Solver
from roboxim_tasks.motion import ExpertScene
from roboxim_tasks.roles import task_distractors
from roboxim_tasks.sequences.skill import skill_of

CONSTRAINT = "solvable"
"""Name of the constraint for messages and statistics."""
KEPT_SOLUTIONS = 4
"""Number of solutions kept from the reset to the expert's first action; a task node serves one episode at a time."""


class Solvability:
    """Solver of scenes as they were drawn, before they are simulated. Not thread-safe (kinematics).

    Non-obvious: a solution is a function of task, scene, seed and speeds. The newest ones are cached, so that the
    expert reuses the solution that the reset found. An expert without that cache computes the same solution again.
    """

    def __init__(self, library: ModelLibrary, planner: PlannerPort, speeds: SpeedConfig | None = None) -> None:
        """Make a solver of scenes.

        Args:
            library: Robots and objects.
            planner: Verifies and finds motions.
            speeds: The expert's speeds; none: the default.
        """
        self._library = library
        self._solver = Solver(library, planner, speeds)
        self._direct = Solver(library, planner, speeds, direct=True)
        self._kept: deque[tuple[tuple[TaskSpec, SceneSpec, int], Solution]] = deque(maxlen=KEPT_SOLUTIONS)

    def solution(self, task: TaskSpec, scene: SceneSpec, seed: int) -> Solution:
        """Return the motion that solves a scene, with every object where it was drawn.

        Of a task of several steps it is the first step's; the others are planned too, each from the predicted end of
        the previous one, so a scene with an unsolvable later step is refused.

        Args:
            task: The task; the record of what was drawn is ignored.
            scene: Its scene; the cameras are ignored.
            seed: Seed of the planner's detours.

        Raises:
            PolicyError: When no candidate of the skill has a collision-free plan for every stage.
            RoboximError: When the planner does not answer.
        """
        request = replace(task, drawn={}), replace(scene, cameras=()), seed
        for known, solution in self._kept:
            if known == request:
                return solution
        solution, *_ = solve_all(self._solver, self._view(task, scene), seed)
        self._kept.append((request, solution))
        return solution

    def holds(self, task: TaskSpec, scene: SceneSpec, seed: int) -> bool:
        """Return whether a scene has a solution; see `refusal`."""
        return self.refusal(task, scene, seed) is None

    def refusal(self, task: TaskSpec, scene: SceneSpec, seed: int) -> str | None:
        """Return why a scene has no solution, with a number; none: it has one.

        Args:
            task: The task.
            scene: Its scene, with the objects at rest.
            seed: Seed of the planner's detours.

        Raises:
            RoboximError: When the planner does not answer.
        """
        try:
            self.solution(task, scene, seed)
        except NoMotionError as error:
            return error.cause
        except PolicyError as error:
            return str(error)
        return None

    def way_blocked(self, task: TaskSpec, scene: SceneSpec) -> bool:
        """Return whether straight lines from stage to stage solve a task without the distractors but not with them.

        Args:
            task: The task.
            scene: Its scene.

        Raises:
            RoboximError: When the planner does not answer.
        """
        names = {thing.entity for thing in task_distractors(task)}
        alone = replace(scene, entities=tuple(entity for entity in scene.entities if entity.name not in names))
        view = replace(self._view(task, alone), direct=True)
        try:
            straight = self._direct.solve(view, skill_of(task).stages(view), 0)
        except PolicyError:
            return False
        if self._direct.obstruction(view, straight):
            return False
        return bool(self._direct.obstruction(self._view(task, scene), straight))

    def _view(self, task: TaskSpec, scene: SceneSpec) -> ExpertScene:
        state = state_at_rest(scene, self._solver.arms[scene.robot.model])
        return ExpertScene(task=task, scene=scene, state=state, library=self._library)


def state_at_rest(scene: SceneSpec, arm: ArmKinematics) -> StateRecord:
    """Return the initial state of a scene, on the assumption that nothing moves while it settles.

    The episode id is empty, because the state is not a revision of a simulated scene.
    """
    pose_tcp = scene.robot.pose @ arm.fk(scene.robot.joint_positions)
    robot = RobotState(
        joint_names=tuple(arm.model.joint_names),
        joint_positions=scene.robot.joint_positions,
        joint_velocities=(0.0,) * len(scene.robot.joint_positions),
        joint_commands=scene.robot.joint_positions,
        pose_tcp_measured=pose_tcp,
        pose_tcp_commanded=pose_tcp,
        gripper_opening=scene.robot.gripper_opening,
        gripper_command=scene.robot.gripper_opening,
    )
    entities = tuple(
        EntityState(
            name=entity.name,
            pose=entity.pose,
            joint_names=tuple(entity.joint_positions),
            joint_positions=tuple(entity.joint_positions.values()),
        )
        for entity in scene.entities
    )
    return StateRecord(episode_id="", seq=0, stamp_ns=0, robot=robot, entities=entities)
