"""Skills, registered by name: each module of this folder holds one with its four sides, or shared helpers."""

from roboxim_core.registry import import_modules
from roboxim_tasks.skills.base import SKILLS, Assessment, Evaluator, Role, Skill, parameters_of, register
from roboxim_tasks.skills.from_file import load_named_by_environment

import_modules(__name__, __path__)

load_named_by_environment()

__all__ = ["SKILLS", "Assessment", "Evaluator", "Role", "Skill", "parameters_of", "register"]
