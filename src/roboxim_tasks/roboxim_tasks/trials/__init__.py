"""Trials: for each skill, cheats that its evaluator must refuse and honest ways that it must accept."""

from roboxim_core.registry import import_modules
from roboxim_tasks.trials.base import MIN_TRIALS, TRIALS, Trial, cheat, honest, missing_trials, trials_of

import_modules(__name__, __path__)

__all__ = ["MIN_TRIALS", "TRIALS", "Trial", "cheat", "honest", "missing_trials", "trials_of"]
