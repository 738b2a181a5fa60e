"""Skills: one file each, with its four sides; registered by name."""

from roboxim_tasks.skills import pick_up
from roboxim_tasks.skills.base import SKILLS, Assessment, Evaluator, Role, Skill, parameters_of, register

__all__ = ["SKILLS", "Assessment", "Evaluator", "Role", "Skill", "parameters_of", "pick_up", "register"]
