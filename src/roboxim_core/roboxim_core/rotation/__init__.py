"""Rotations: single ones as quaternions, and the representations of actions and states."""
