"""Scenes before they run: drawn tasks and their pictures."""
