"""Scenes of an experiment's evaluations."""
