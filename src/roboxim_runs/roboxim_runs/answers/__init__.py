"""Answers beyond success rates: explain a failure, compare two policies, mine regions of failure."""
