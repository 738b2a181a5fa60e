"""Collision-checked, time-optimal motions, and the planner node."""
