"""Reset component ``robot``: the arm's initial joint positions, or the end effector's pose in a volume."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from roboxim_core.errors import ConfigError
from roboxim_core.kinematics.arm import ArmKinematics, IkResult
from roboxim_core.poses import Array, Pose
from roboxim_core.specs import SceneSpec
from roboxim_tasks.choices import Choice, VectorChoice
from roboxim_tasks.components.base import ResetComponent, ResetContext, register
from roboxim_tasks.sampling.rejection import RejectedError

LIMIT_MARGIN_RAD = 0.05


@dataclass(frozen=True, kw_only=True)
class RobotResetConfig:
    """Initial configuration of the arm."""

    position: VectorChoice = VectorChoice(lower=(0.41, -0.06, 0.26), upper=(0.53, 0.06, 0.38))
    """Position of the tool centre point in the robot's base [m]."""
    yaw_rad: Choice = Choice(lower=0.0, upper=0.0)
    """Rotation of the downward-pointing tool about the vertical [rad]; 0: the gripper opens along y."""
    joints: VectorChoice | None = None
    """Arm joint positions, instead of a position and yaw [rad]."""
    gripper_opening: Choice = Choice(values=(1.0,))
    """1 = open, 0 = closed."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: When a position is not three numbers, or a value is no number or out of range.
        """
        self.position.require_size(3, "position")
        self.yaw_rad.require_numbers("yaw_rad")
        self.gripper_opening.require_numbers("gripper_opening", 0.0, 1.0)


@register
class RobotReset(ResetComponent):
    """Starts the arm at drawn joint positions, or with the tool pointing down in a volume."""

    name = "robot"
    Config = RobotResetConfig

    def reset(self, scene: SceneSpec, context: ResetContext) -> SceneSpec:
        """Draw until the arm reaches the pose.

        Raises:
            RejectedError: When no draw is reachable.
            ConfigError: When configured joints do not fit the arm.
        """
        from scipy.spatial.transform import Rotation

        rng, index, arm = context.rng(self.name), context.index, context.arm
        opening = self.config.gripper_opening.draw_number(rng, index)
        context.record("robot.gripper_opening", self.config.gripper_opening, opening)
        if self.config.joints is not None:
            self.config.joints.require_size(len(arm.lower), "reset.robot.joints")
            joints = self.config.joints.draw(rng, index)
            context.record("robot.joints", self.config.joints, joints)
            if not arm.within_limits(joints):
                raise ConfigError(f"reset.robot.joints {joints.tolist()} are beyond the limits of '{arm.model.id}'")
            return _with_joints(scene, joints.tolist(), opening)
        starts = _reachable_box(self.config.position, arm.model.start)
        for _ in range(context.config.max_draws):
            position = starts.draw(rng, index)
            yaw = self.config.yaw_rad.draw_number(rng, index)
            rotation = Rotation.from_euler("z", yaw) * Rotation.from_euler("x", 180, degrees=True)
            found = arm.ik_near(Pose.from_arrays(position, rotation), arm.model.home)
            if found.converged and arm.within_limits(found.joints, LIMIT_MARGIN_RAD):
                context.record("robot.position", starts, position)
                context.record("robot.yaw_rad", self.config.yaw_rad, yaw)
                return _with_joints(scene, found.joints.tolist(), opening)
        raise RejectedError("robot_start_reachable", _unreached(arm, position, yaw, found))


def _reachable_box(wanted: VectorChoice, own: tuple[float, ...]) -> VectorChoice:
    """Return the part of a box that is inside the start of an arm, see `RobotModel.start`; empty: the arm has none."""
    if not own or wanted.lower is None or wanted.upper is None:
        return wanted
    lower, upper = [], []
    for low, high, least, greatest in zip(wanted.lower, wanted.upper, own[:3], own[3:], strict=True):
        inside = max(low, least), min(high, greatest)
        lower.append(inside[0] if inside[0] <= inside[1] else least)
        upper.append(inside[1] if inside[0] <= inside[1] else greatest)
    return VectorChoice(lower=tuple(lower), upper=tuple(upper))


def _unreached(arm: ArmKinematics, position: Array, yaw: float, found: IkResult) -> str:
    """Return how far from a start the arm stays."""
    home = arm.fk(arm.model.home).position
    place, at_home = (", ".join(f"{x:.2f}" for x in point) for point in (position, home))
    if found.converged:
        short = f"reaches it only within {LIMIT_MARGIN_RAD} rad of a joint's limit"
    else:
        turned = np.degrees(found.rotation_error_rad)
        short = f"stays {100 * found.position_error_m:.1f} cm and {turned:.0f} degrees from it"
    return (
        f"'{arm.model.id}' {short}: reset.robot.position ({place}) in its base, tool down, yaw {yaw:.2f} rad; at home "
        f"its tool is at ({at_home}): give a position near that, another reset.robot.yaw_rad, or reset.robot.joints"
    )


def _with_joints(scene: SceneSpec, joints: list[float], opening: float) -> SceneSpec:
    robot = replace(scene.robot, joint_positions=tuple(joints), gripper_opening=opening)
    return replace(scene, robot=robot)
