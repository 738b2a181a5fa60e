"""Reset components, registered by name: each module of this folder holds one."""

import importlib
import pkgutil

from roboxim_tasks.components.base import (
    COMPONENTS,
    Constraint,
    NoConfig,
    ResetComponent,
    ResetContext,
    register,
)

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")

__all__ = [
    "COMPONENTS",
    "Constraint",
    "NoConfig",
    "ResetComponent",
    "ResetContext",
    "register",
]
