"""Inputs and results of an experiment's trainings: exports, policies, servers of checkpoints."""
