"""Forward kinematics of articulated objects; needs no mesh library."""

from __future__ import annotations

import numpy as np

from roboxim_core.errors import ConfigError
from roboxim_core.models.description import JointModel, ObjectModel
from roboxim_core.poses import IDENTITY, Pose


def object_link_poses(model: ObjectModel, joint_positions: dict[str, float]) -> dict[str, Pose]:
    """Return the pose of each link in the object's base, by link name.

    Args:
        model: The object.
        joint_positions: Joint name to position [m or rad]; those left out are 0.
    """
    return link_poses(model.links[0].name, model.joints, joint_positions)


def link_poses(base: str, joints: tuple[JointModel, ...], joint_positions: dict[str, float]) -> dict[str, Pose]:
    """Return the pose of each link in the base link, by link name.

    Raises:
        ConfigError: When the joints do not form a tree.
    """
    poses = {base: IDENTITY}
    pending = list(joints)
    while pending:
        ready = [joint for joint in pending if joint.parent in poses]
        if not ready:
            raise ConfigError(f"the joints {[j.name for j in pending]} do not lead to the base '{base}'")
        for joint in ready:
            poses[joint.child] = (
                poses[joint.parent] @ joint.pose @ joint_motion(joint, joint_positions.get(joint.name, 0.0))
            )
            pending.remove(joint)
    return poses


def joint_motion(joint: JointModel, position: float) -> Pose:
    """Return the pose of a joint's child in the joint's frame at a position [m or rad]."""
    from scipy.spatial.transform import Rotation

    axis = np.asarray(joint.axis)
    if joint.kind == "prismatic":
        return Pose.from_arrays(axis * position)
    return Pose.from_arrays(np.zeros(3), Rotation.from_rotvec(axis * position))
