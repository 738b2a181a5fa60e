"""Answers that no success rate gives: explain a failure, compare two policies, mine regions of failure."""
