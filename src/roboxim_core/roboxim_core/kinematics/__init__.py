"""Forward and inverse kinematics of an arm, and the controllers that convert actions to joint targets."""

from roboxim_core.kinematics.arm import ArmKinematics, Arms
from roboxim_core.kinematics.controller import Controller, ControllerState
from roboxim_core.kinematics.delta import DeltaController, delta_between
from roboxim_core.kinematics.joints import JointController

__all__ = [
    "ArmKinematics",
    "Arms",
    "Controller",
    "ControllerState",
    "DeltaController",
    "JointController",
    "delta_between",
]
