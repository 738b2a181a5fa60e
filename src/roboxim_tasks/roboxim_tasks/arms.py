"""What a task needs of an arm and its gripper, checked when the task is loaded.

An arm of five joints points its tool down at any place and yaw in reach, or leans it within the arm's plane. A gripper
with one moving jaw holds, but does not push evenly. Skills and objects that need more are refused by name; otherwise
every reset would fail.
"""

from __future__ import annotations

from collections.abc import Iterator

from roboxim_core.errors import ConfigError
from roboxim_core.kinematics.arm import ArmKinematics
from roboxim_core.models.description import ObjectModel, RobotModel
from roboxim_core.models.library import ModelLibrary
from roboxim_tasks.motion import RELEASE_CLEARANCE_M, points_down, shifted
from roboxim_tasks.reach import follows
from roboxim_tasks.roles import Role
from roboxim_tasks.script import APPROACH_M
from roboxim_tasks.sequences.skill import Sequence, skill_of
from roboxim_tasks.skills import SKILLS, Skill
from roboxim_tasks.task_config import ObjectConfig, TaskConfig


def skill_refusal(skill: Skill, robot: RobotModel) -> str:
    """Return what an arm lacks for a skill, or an empty text."""
    joints = len(robot.joint_names)
    if skill.rotations > robot.rotations:
        return (
            f"{skill.name} leans the tool to any side, which takes {skill.rotations} rotations beside the position; "
            f"'{robot.id}' has {joints} joints and {robot.rotations} rotations"
        )
    if skill.moving_fingers > len(robot.gripper.joint_names):
        return f"{skill.name} relies on two fingers that move alike; the gripper of '{robot.id}' has one moving jaw"
    return ""


def check_skills(config: TaskConfig, robot: RobotModel) -> None:
    """Check that an arm can perform a task's skill, or each of its steps.

    Raises:
        ConfigError: When it cannot; says what the skill needs and which skills the arm performs.
    """
    skill = skill_of(config)
    for one in skill.skills if isinstance(skill, Sequence) else (skill,):
        if refusal := skill_refusal(one, robot):
            able = ", ".join(name for name in sorted(SKILLS) if not skill_refusal(SKILLS[name], robot))
            raise ConfigError(f"{refusal}. Its skills are {able}; take one of these, or an arm of six joints or more")


def object_refusal(model: ObjectModel, robot: RobotModel) -> str:
    """Return why an arm cannot grasp an object that stands or lies as usual, or an empty text.

    Non-obvious: only arms of fewer than three rotations and grippers with one moving jaw are checked. For the others
    a reset finds out, since they have more than one way to each object.
    """
    if robot.rotations == 3 and not robot.gripper.one_jaw:
        return ""
    grasps = [grasp for grasp in model.grasps if robot.rotations == 3 or points_down(grasp.pose)]
    if not grasps:
        return f"no grasp of the {model.name} has the tool pointing down, and '{robot.id}' leans it in one plane only"
    narrowest, widest = min(grasp.width_m for grasp in grasps), robot.gripper.max_opening_m - RELEASE_CLEARANCE_M
    if robot.gripper.one_jaw and narrowest > widest:
        return (
            f"the {model.name} is {1000 * narrowest:.0f} mm wide where it is grasped, and the jaw of '{robot.id}' "
            f"grasps and releases what is up to {1000 * widest:.0f} mm wide"
        )
    if robot.start:
        arm = ArmKinematics(robot)
        home = arm.fk(robot.home)
        highest = min(model.rest_height + grasp.pose.position[2] for grasp in grasps) + APPROACH_M
        if not follows(arm, shifted(home, highest - home.position[2])):
            return (
                f"'{robot.id}' approaches the {model.name} from {1000 * highest:.0f} mm above the table, where its "
                "tool does not point down"
            )
    return ""


def check_grasped(role: Role, objects: ObjectConfig, robot: RobotModel, library: ModelLibrary) -> None:
    """Check that an arm can grasp every model of a role, in each of its sizes.

    Raises:
        ConfigError: On the first model that it cannot; names those of the role that it can.
    """
    if not _grasped(role):
        return
    for name in map(str, objects.models.values):
        for model in _sizes(name, objects, library):
            if refusal := object_refusal(model, robot):
                able = [i for i in library.object_ids if role.suits(library.object(i))]
                able = [i for i in able if not object_refusal(library.object(i), robot)]
                raise ConfigError(f"models: {refusal}; it grasps {', '.join(sorted(able))}")


def _sizes(name: str, objects: ObjectConfig, library: ModelLibrary) -> Iterator[ObjectModel]:
    yield library.object(name)
    known = library.object_modifiers(name)
    for kind in ("size", "scale"):
        if kind in objects.modifiers and kind in known:
            for value in objects.modifiers[kind].ends:
                yield library.object(name, {kind: value})


def _grasped(role: Role) -> bool:
    return role.affordance == "graspable" or any(map(_grasped, getattr(role, "of", ())))
