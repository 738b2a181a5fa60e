"""Trainings: in this process, or as commands side by side, here or on workers."""
