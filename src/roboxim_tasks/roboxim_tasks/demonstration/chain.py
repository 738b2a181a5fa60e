"""Plans of a sequence before it runs: each step from the state that the plan of the step before predicts."""

from __future__ import annotations

from dataclasses import replace

from roboxim_core.errors import PolicyError
from roboxim_core.kinematics import ArmKinematics
from roboxim_tasks.demonstration.solver import NoMotionError, Solution, Solver
from roboxim_tasks.motion import ExpertScene, with_poses
from roboxim_tasks.sequences.steps import steps_of
from roboxim_tasks.skills import SKILLS


def solve_all(solver: Solver, view: ExpertScene, seed: int) -> tuple[Solution, ...]:
    """Return the motion of every step of a task, each planned from the predicted end of the one before.

    Args:
        solver: Search for motions.
        view: The scene before the first step.
        seed: Seed of the planner's detours.

    Raises:
        NoMotionError: When a step has no feasible motion; names the step.
    """
    solutions: list[Solution] = []
    steps = steps_of(view.task)
    for number, step in enumerate(steps, start=1):
        now = replace(view, task=step)
        try:
            solutions.append(solver.solve(now, SKILLS[step.skill].stages(now), seed))
        except NoMotionError as error:
            if len(steps) == 1:
                raise
            again = NoMotionError(f"step {number} of '{view.task.instruction}': {error}")
            again.cause = f"step {number}, {error.cause}"
            raise again from None
        if number < len(steps):
            view = after(view, solutions[-1], solver.arms[view.scene.robot.model])
    return tuple(solutions)


def after(view: ExpertScene, solution: Solution, arm: ArmKinematics) -> ExpertScene:
    """Return the scene that a motion leaves if everything goes as planned: its objects, the arm, what the hand holds.

    Args:
        view: The scene before the motion.
        solution: The motion.
        arm: Kinematics of the scene's robot.

    Raises:
        PolicyError: When the motion has no stage.
    """
    if not solution.stages:
        raise PolicyError("a motion without stages leaves nothing behind")
    last = solution.stages[-1]
    joints = tuple(float(value) for value in solution.path[-1])
    tcp = view.scene.robot.pose @ arm.fk(joints)
    robot = replace(
        view.state.robot, joint_positions=joints, joint_commands=joints, pose_tcp_measured=tcp,
        pose_tcp_commanded=tcp, gripper_opening=last.opening, gripper_command=last.opening,
    )  # fmt: skip
    moved = {entity.name: entity for entity in last.moved}
    if last.held:
        moved[last.held] = replace(view.state.entity(last.held), pose=tcp @ last.held_in_tcp)
    entities = tuple(moved.get(entity.name, entity) for entity in view.state.entities)
    state = replace(view.state, robot=robot, entities=entities)
    scene = with_poses(view.scene, state)
    return replace(view, scene=scene, state=state, held=last.held, lifted=bool(last.held))
