"""Conventions: the requests to a policy, and the meaning of its answers.

A convention is a file of ``config/conventions``, or of the user's folders: ``load_convention("libero")``. It holds only
numbers: no wire, no ROS. `roboxim_core.conventions.convention` explains the conversions.
"""

from roboxim_core.conventions.convention import (
    Chunking,
    Convention,
    decode_actions,
    from_actions,
    joined_answer,
    load_convention,
    observe,
    to_actions,
)
from roboxim_core.conventions.gripper import GripperOutput
from roboxim_core.conventions.images import ImageInput, Layout, Resize
from roboxim_core.conventions.outputs import ActionOutput
from roboxim_core.conventions.response import ControllerResponse
from roboxim_core.conventions.states import ArmReadings, StateField, StateInput, StatePart

__all__ = [
    "ActionOutput",
    "ArmReadings",
    "Chunking",
    "ControllerResponse",
    "Convention",
    "GripperOutput",
    "ImageInput",
    "Layout",
    "Resize",
    "StateField",
    "StateInput",
    "StatePart",
    "decode_actions",
    "from_actions",
    "joined_answer",
    "load_convention",
    "observe",
    "to_actions",
]
