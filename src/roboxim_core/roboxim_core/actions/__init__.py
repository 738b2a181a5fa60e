"""Actions: their meaning (`semantics`), conversion (`transforms`), validation (`chunks`) and execution (`chunking`).

The default meaning: end-effector delta in the robot's base frame, ``[dx, dy, dz, droll, dpitch, dyaw, gripper]``, where
droll, dpitch, dyaw are the extrinsic XYZ Euler angles of ``R_next R_commanded^T`` and the gripper is absolute,
1 = open, 0 = closed, linear in the total opening. A run refuses mismatching semantics before the first step.
"""

from roboxim_core.actions.chunking import ActionPlan, Chunking, Ensemble, LateRows
from roboxim_core.actions.chunks import ACTION_SIZE, ActionArray, check_chunk, hold_action
from roboxim_core.actions.gripper import GripperRule, GripperSwitch
from roboxim_core.actions.lag import MotionLag
from roboxim_core.actions.semantics import (
    ActionSemantics,
    ControlMode,
    DeltaBase,
    GripperConvention,
    ReferenceFrame,
)
from roboxim_core.actions.transforms import ActionContext, ActionTransform, Kinematics
from roboxim_core.rates import ANY_RATE
from roboxim_core.rotation.representations import RotationRepresentation

__all__ = [
    "ACTION_SIZE",
    "ANY_RATE",
    "ActionArray",
    "ActionContext",
    "ActionPlan",
    "ActionSemantics",
    "ActionTransform",
    "Chunking",
    "ControlMode",
    "DeltaBase",
    "Ensemble",
    "GripperConvention",
    "GripperRule",
    "GripperSwitch",
    "Kinematics",
    "LateRows",
    "MotionLag",
    "ReferenceFrame",
    "RotationRepresentation",
    "check_chunk",
    "hold_action",
]
