"""Forward and inverse kinematics of an arm, and the controllers that convert actions to joint targets."""

from roboxim_core.kinematics.arm import ArmKinematics, Arms, IkResult
from roboxim_core.kinematics.controller import Controller, ControllerState, ControlStep
from roboxim_core.kinematics.delta import DeltaController, delta_between
from roboxim_core.kinematics.joints import JointController

__all__ = [
    "ArmKinematics",
    "Arms",
    "ControlStep",
    "Controller",
    "ControllerState",
    "DeltaController",
    "IkResult",
    "JointController",
    "delta_between",
]
