"""Reset components, registered by name: each module of this folder holds one."""

from roboxim_core.registry import import_modules
from roboxim_tasks.components.base import (
    COMPONENTS,
    Constraint,
    NoConfig,
    ResetComponent,
    ResetContext,
    register,
)

import_modules(__name__, __path__)

__all__ = [
    "COMPONENTS",
    "Constraint",
    "NoConfig",
    "ResetComponent",
    "ResetContext",
    "register",
]
