"""Skills, registered by name: each module of this folder holds one with its four sides, or shared helpers."""

import importlib
import pkgutil

from roboxim_tasks.skills.base import SKILLS, Assessment, Evaluator, Role, Skill, parameters_of, register

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")

__all__ = ["SKILLS", "Assessment", "Evaluator", "Role", "Skill", "parameters_of", "register"]
