"""Trials: for each skill, cheats that its evaluator must refuse and honest ways that it must accept."""

import importlib
import pkgutil

from roboxim_tasks.trials.base import MIN_TRIALS, TRIALS, Trial, cheat, honest, missing_trials, trials_of

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")

__all__ = ["MIN_TRIALS", "TRIALS", "Trial", "cheat", "honest", "missing_trials", "trials_of"]
