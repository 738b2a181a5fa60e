"""RoboXim inside other programs: episodes whose actions come from outside, one call per action.

`EpisodeSession` is the episode loop turned inside out, over the rooms' cores: no nodes, one process. The Gymnasium
environment and the vla-eval benchmark are two thin adapters of it. An episode there has the scene, the limits and the
verdict that ``evaluate`` gives.
"""
