"""Forward and inverse kinematics of an arm, and the delta controller that converts actions to joint targets."""

from roboxim_core.kinematics.arm import ArmKinematics, IkResult
from roboxim_core.kinematics.delta import ControllerState, DeltaController, DeltaStep, delta_between

__all__ = ["ArmKinematics", "ControllerState", "DeltaController", "DeltaStep", "IkResult", "delta_between"]
