"""The one episode loop, for generating and for evaluating alike, over small ports.

``generate`` is this loop with the expert as actor and "keep if successful"; ``evaluate`` is it with a policy and "keep
all". The ports are served by ROS clients in the evaluator node and by the cores themselves in tests and in the
benchmark of the graph's overhead; the loop cannot tell the difference.

A tick is: observe, act, tick the sim, judge, and wait until the recorder has the tick. A policy's fault fails the
episode by reason; a fault of the simulator or the recorder is raised and halts the run.
"""

from roboxim_core.episode.ports import ActorPort, JudgePort, Ports, RecorderPort, ScenePort, SimPort
from roboxim_core.episode.records import KEEP_RULES, Draw, EpisodeInfo, EpisodeResult, EpisodeStep, RunConfig
from roboxim_core.episode.runner import EpisodeRunner, configure_scene, episode_id

__all__ = [
    "KEEP_RULES",
    "ActorPort",
    "Draw",
    "EpisodeInfo",
    "EpisodeResult",
    "EpisodeRunner",
    "EpisodeStep",
    "JudgePort",
    "Ports",
    "RecorderPort",
    "RunConfig",
    "ScenePort",
    "SimPort",
    "configure_scene",
    "episode_id",
]
