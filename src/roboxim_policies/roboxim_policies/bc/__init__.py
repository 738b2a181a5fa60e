"""Behaviour cloning: a small network from random weights, see `roboxim_policies.learning` for all else."""
