"""Experiments: definition, plan, stages, proofs, card, report; their pure parts are in `roboxim_eval.experiments`."""
