"""Evaluations of policies: checks before the start, the run, its results and its report."""
