"""The host of the episode loop, experiments, statistics, reports, and the evaluator node."""
