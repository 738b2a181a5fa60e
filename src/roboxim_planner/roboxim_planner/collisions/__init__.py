"""Collision checks of states, edges and sweeps."""
