"""Benchmarks: several experiments and a score for each dimension that they vary. Plain values, no ROS."""
