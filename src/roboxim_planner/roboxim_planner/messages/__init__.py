"""Conversions between messages and the planner's values."""
