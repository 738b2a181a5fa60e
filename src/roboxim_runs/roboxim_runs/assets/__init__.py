"""Checks and pictures of objects."""
