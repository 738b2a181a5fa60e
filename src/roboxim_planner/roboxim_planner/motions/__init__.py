"""Paths, their time laws, and the verification of the result."""
