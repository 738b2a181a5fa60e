"""Skills, registered by name: each module of this folder holds one with its four sides, or shared helpers."""

import importlib
import pkgutil

from roboxim_tasks.skills.base import SKILLS, Assessment, Evaluator, Role, Skill, parameters_of, register
from roboxim_tasks.skills.from_file import load_named_by_environment

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")

load_named_by_environment()

__all__ = ["SKILLS", "Assessment", "Evaluator", "Role", "Skill", "parameters_of", "register"]
