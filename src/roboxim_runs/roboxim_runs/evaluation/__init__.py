"""Evaluations of policies: what is refused before, the run, its results and its report."""
