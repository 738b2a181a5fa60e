"""Draws of tasks and scenes."""
