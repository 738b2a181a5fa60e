"""RoboXim as an environment of other programs, which supply one action per call.

`EpisodeSession` runs the episode loop step by step over the rooms' cores, in one process without nodes. The Gymnasium
environment and the vla-eval benchmark are thin adapters of it. An episode has the same scene, limits and verdict as
with ``evaluate``.
"""
