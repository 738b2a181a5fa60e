"""Tasks of several steps: a sequence is a skill that is made of others, and a task of one skill has one step."""

from roboxim_tasks.sequences.skill import Sequence, skill_of
from roboxim_tasks.sequences.steps import MAX_STEPS, ORDERS, is_sequence, steps_of, words_of

__all__ = ["MAX_STEPS", "ORDERS", "Sequence", "is_sequence", "skill_of", "steps_of", "words_of"]
