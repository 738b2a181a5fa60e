"""Pick up an object.

Randomisation: which object and colour; where it lies and at what yaw; where the end effector starts; distractors that
do not fit the instruction.

Success: the object is more than ``lift_m`` above where it lay, pressed by at least two links of the robot, off the
table, for ``hold_s`` without a break.

Non-obvious: heights are measured from tick 0, so a task is never solved at its start. Force is that of the tick's last
physics step, so a finger that only brushed the object within the tick does not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from roboxim_core.errors import ConfigError
from roboxim_core.poses import Pose, distance
from roboxim_core.specs import EntitySpec, SceneSpec, TaskSpec
from roboxim_core.state import StateRecord
from roboxim_tasks.components import Constraint, ResetContext
from roboxim_tasks.motion import GRIPPER, TABLE, ExpertScene, Stage, grasp_poses, retreated, shifted
from roboxim_tasks.skills.base import Assessment, Evaluator, Skill, parameters_of, register

APPROACH_M = 0.10
LIFT_M = 0.12
START_CLEARANCE_M = 0.08
LIMIT_MARGIN_RAD = 0.03
FALLEN_M = 0.1


@dataclass(frozen=True, kw_only=True)
class PickUpParameters:
    """Thresholds of success."""

    lift_m: float = 0.05
    """Height above where the object lay [m]."""
    finger_force_n: float = 0.05
    """Normal force of each finger [N]."""
    hold_s: float = 0.5
    """How long it must stay lifted [s]."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: When a threshold makes no sense.
        """
        if not 0 < self.lift_m <= 0.1 or self.finger_force_n < 0 or self.hold_s < 0:
            raise ConfigError(f"needs 0 < lift_m <= 0.1, finger_force_n >= 0 and hold_s >= 0, got {self}")


class PickUpEvaluator:
    """Folds ticks into assessments."""

    def __init__(self, task: TaskSpec, initial: StateRecord) -> None:
        """Remember where everything lay."""
        self._parameters: PickUpParameters = parameters_of(task, PickUpParameters)
        self.hold_s = self._parameters.hold_s
        self._target = task.objects["target"].entity
        self._heights = {entity.name: entity.pose.position[2] for entity in initial.entities}

    def assess(self, state: StateRecord) -> Assessment:
        """Assess one tick."""
        lifts = {name: state.entity(name).pose.position[2] - height for name, height in self._heights.items()}
        lift = lifts.pop(self._target)
        forces: dict[str, float] = {}
        for contact in state.contacts_between("robot", self._target):
            link = contact.link_a if contact.body_a == "robot" else contact.link_b
            forces[link] = max(forces.get(link, 0.0), contact.force_last)
        pressing = sum(force > self._parameters.finger_force_n for force in forces.values())
        on_table = any(contact.force_last > 0.0 for contact in state.contacts_between(self._target, TABLE))
        others = max(lifts.values(), default=0.0)
        problems = {
            "fell_off_table": lift < -FALLEN_M,
            "wrong_object_lifted": others > self._parameters.lift_m,
            "not_grasped": pressing < 2,
            "not_lifted": lift <= self._parameters.lift_m,
            "touches_table": on_table,
        }
        reason = next((name for name, holds in problems.items() if holds), "")
        return Assessment(
            solved=not reason,
            failed=problems["fell_off_table"],
            reason=reason,
            predicates={
                "lift_m": lift,
                "pressing_links": float(pressing),
                "on_table": float(on_table),
                "other_lift_m": others,
            },
        )


@register
class PickUp(Skill):
    """Generator, resetter, executor and evaluator of ``pick_up``."""

    name = "pick_up"
    roles = ("target",)
    templates = ("Pick up the {target}",)
    max_steps = 100
    Parameters = PickUpParameters

    def constraints(self, context: ResetContext) -> Sequence[Constraint]:
        """The arm reaches one grasp from above to lifted, and does not start at an object."""
        entity = context.task.objects["target"].entity

        def reachable(scene: SceneSpec) -> bool:
            spec = scene.entity(entity)
            home = context.arm.fk(context.arm.model.home)
            pose_object = scene.robot.pose.inverse() @ spec.pose
            grasps = grasp_poses(context.library.entity_model(spec), pose_object, home)
            return any(_reaches(context, grasp) for grasp in grasps)

        def clear(scene: SceneSpec) -> bool:
            tcp = scene.robot.pose @ context.arm.fk(scene.robot.joint_positions)
            return all(_apart(context, tcp, other) for other in scene.entities)

        return (Constraint(name="target_reachable", holds=reachable), Constraint(name="start_clear", holds=clear))

    def stages(self, scene: ExpertScene) -> Sequence[tuple[Stage, ...]]:
        """Go above the object, down, close, up; one candidate per grasp, least rotation first."""
        entity = scene.task.objects["target"].entity
        pose_object = scene.pose_of(entity)
        grasp_touches = ((GRIPPER, entity),)
        lift_touches = ((entity, TABLE),)
        candidates = []
        for grasp in grasp_poses(scene.model_of(entity), pose_object, scene.pose_tcp):
            held_in_tcp = grasp.inverse() @ pose_object
            candidates.append(
                (
                    Stage(name="approach", pose=retreated(grasp, APPROACH_M), free=True),
                    Stage(name="descend", pose=grasp, speed=0.6, touching=grasp_touches),
                    Stage(name="close", opening=0.0, duration_s=0.3),
                    Stage(
                        name="lift", pose=shifted(grasp, LIFT_M), opening=0.0, speed=0.6,
                        held=entity, held_in_tcp=held_in_tcp, touching=lift_touches,
                    ),
                    Stage(name="hold", opening=0.0, duration_s=1.0),
                )
            )  # fmt: skip
        return candidates

    def evaluator(self, task: TaskSpec, initial: StateRecord) -> Evaluator:
        """Return the fold of success."""
        return PickUpEvaluator(task, initial)


def _reaches(context: ResetContext, grasp: Pose) -> bool:
    joints = np.array(context.arm.model.home)
    for pose in (retreated(grasp, APPROACH_M), grasp, shifted(grasp, LIFT_M)):
        found = context.arm.ik_near(pose, joints)
        if not found.converged or not context.arm.within_limits(found.joints, LIMIT_MARGIN_RAD):
            return False
        joints = found.joints
    return True


def _apart(context: ResetContext, tcp: Pose, entity: EntitySpec) -> bool:
    radius = float(np.linalg.norm(context.library.entity_model(entity).size)) / 2
    return distance(tcp, entity.pose)[0] > radius + START_CLEARANCE_M
