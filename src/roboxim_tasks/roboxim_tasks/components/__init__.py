"""Reset components: one file each, registered by name."""

from roboxim_tasks.components import cameras, distractors, lights, objects, robot, surfaces
from roboxim_tasks.components.base import (
    COMPONENTS,
    Constraint,
    NoConfig,
    RejectedError,
    ResetComponent,
    ResetContext,
    register,
)

__all__ = [
    "COMPONENTS",
    "Constraint",
    "NoConfig",
    "RejectedError",
    "ResetComponent",
    "ResetContext",
    "cameras",
    "distractors",
    "lights",
    "objects",
    "register",
    "robot",
    "surfaces",
]
