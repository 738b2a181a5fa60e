"""The episode loop, shared by generation and evaluation, over small ports.

``generate`` runs this loop with the expert as actor and keeps successful episodes; ``evaluate`` runs it with a policy
and keeps all. ROS clients implement the ports in the evaluator node. In tests and in the benchmark of the graph's
overhead the cores implement them directly.

A tick has five steps: observe, act, tick the sim, judge, and wait until the recorder has the tick. A policy fault
fails the episode with a reason; a fault of the simulator or the recorder is raised and halts the run.
"""

from roboxim_core.episode.ports import ActorPort, Ports, RecorderPort, SimPort
from roboxim_core.episode.records import Draw, EpisodeInfo, EpisodeResult, EpisodeStep, RunConfig
from roboxim_core.episode.runner import EpisodeRunner, configure_scene, episode_id, executed_semantics

__all__ = [
    "ActorPort",
    "Draw",
    "EpisodeInfo",
    "EpisodeResult",
    "EpisodeRunner",
    "EpisodeStep",
    "Ports",
    "RecorderPort",
    "RunConfig",
    "SimPort",
    "configure_scene",
    "episode_id",
    "executed_semantics",
]
