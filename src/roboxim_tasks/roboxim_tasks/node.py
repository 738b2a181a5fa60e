"""The task node: draw episodes, judge them, and serve the expert as a policy."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from rclpy.context import Context
from roboxim_interfaces.msg import SceneSpec as SceneSpecMsg
from roboxim_interfaces.msg import TaskSpec as TaskSpecMsg
from roboxim_interfaces.msg import Verdict as VerdictMsg
from roboxim_interfaces.srv import GenerateEpisode, Judge

from roboxim_core.errors import ErrorCode, InvalidRequestError, RoboximError, TaskError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.policy_guard import GuardedPolicy
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import TaskSpec
from roboxim_core.state import StateRecord
from roboxim_core.verdicts import Verdict
from roboxim_ros.messages.conversions import from_msg, to_msg
from roboxim_ros.node import RoboximNode, parameter
from roboxim_ros.policy_service import PolicyService
from roboxim_tasks.config import DEFAULT_TASK, TaskMix, load_task_config, parse_task_config
from roboxim_tasks.demonstration.expert import Expert
from roboxim_tasks.demonstration.reference import SpeedConfig
from roboxim_tasks.demonstration.solvable import Solvability
from roboxim_tasks.judging import Judge as TaskJudge
from roboxim_tasks.ports import PlannerClient, SegmentationClient
from roboxim_tasks.sampling.episodes import EpisodeGenerator
from roboxim_tasks.sampling.visible import Visibility
from roboxim_tasks.task_config import TaskConfig

MAX_JUDGES = 16
"""Number of episodes judged at a time; the least recently used one is dropped first."""


@dataclass(frozen=True, kw_only=True)
class TaskNodeConfig:
    """Parameters of the task node."""

    task: str = parameter(
        DEFAULT_TASK, "default task of requests without a configuration: a name in config/tasks, or a file"
    )
    """Default task."""
    max_tcp_speed_m_s: float = parameter(SpeedConfig.max_tcp_speed_m_s, "largest tcp speed [m/s]", 0.01, 2.0)
    """Speed of the expert."""
    max_tcp_rot_speed_rad_s: float = parameter(
        SpeedConfig.max_tcp_rot_speed_rad_s, "largest angular speed of the tool [rad/s]", 0.05, 6.0
    )
    """Angular speed of the expert."""
    smoothing_s: float = parameter(
        SpeedConfig.smoothing_s, "time that the expert takes to reach its speed [s]", 0.0, 2.0
    )
    """Smoothing of the expert."""
    solvable: bool = parameter(True, "whether to refuse scenes that the planner cannot solve; needs the planner")
    """Whether every scene is planned before it is returned."""
    visible: bool = parameter(
        True, "whether to refuse scenes whose fixed cameras do not see the named objects; needs the sim"
    )
    """Whether the visibility in every scene with cameras is checked before it is returned."""
    visible_renderer: str = parameter("raster", "renderer of the visibility check; another one may refuse other scenes")
    """Renderer that looks."""
    render_timeout_s: float = parameter(120.0, "longest wait for an image [s]", 0.1, 600.0)
    """Longest wait for the simulator's answer."""
    direct: bool = parameter(
        False, "whether the expert goes straight from stage to stage and ignores obstacles; a baseline for comparisons"
    )
    """Whether the expert goes without detours and verification."""
    planner_timeout_s: float = parameter(120.0, "longest wait for the planner [s]", 0.1, 600.0)
    """Longest wait for the planner's answer."""


class TaskNode(RoboximNode):
    """Node that serves ``tasks/*``, and the expert as a policy under ``expert/*``."""

    def __init__(self, *, context: Context, namespace: str = "", parameters: dict[str, Any] | None = None) -> None:
        """Make the node; see `RoboximNode`.

        Raises:
            ConfigError: When a parameter or the default task is invalid.
        """
        super().__init__("tasks", context=context, namespace=namespace, parameters=parameters)
        self.config = self.declare_config(TaskNodeConfig)
        self._default_task = load_task_config(self.config.task)
        self._parse = lru_cache(maxsize=16)(parse_task_config)
        self._library = ModelLibrary()
        self._judges: OrderedDict[str, TaskJudge] = OrderedDict()
        self._judging = threading.Lock()
        speeds = SpeedConfig(
            max_tcp_speed_m_s=self.config.max_tcp_speed_m_s,
            max_tcp_rot_speed_rad_s=self.config.max_tcp_rot_speed_rad_s,
            smoothing_s=self.config.smoothing_s,
        )
        planner = PlannerClient(self.clients_of_node, self.config.planner_timeout_s)
        solvability = Solvability(self._library, planner, speeds)
        segmentation = SegmentationClient(
            self.clients_of_node, self.config.visible_renderer, self.config.render_timeout_s
        )
        visibility = Visibility(segmentation) if self.config.visible else None
        self._generator = EpisodeGenerator(self._library, solvability if self.config.solvable else None, visibility)
        self._expert = Expert(self._library, planner, speeds, direct=self.config.direct, solvability=solvability)
        self.serve(GenerateEpisode, "tasks/generate_episode", self._on_generate)
        self.serve(Judge, "tasks/judge", self._on_judge)
        self.offer("tasks/judge", self.judge, inline=True)
        guard = GuardedPolicy(
            self._expert, log=lambda text: self.get_logger().error(text), named_errors=(RoboximError,)
        )
        PolicyService(self, guard, "expert")

    def _task_config(self, text: str) -> TaskConfig | TaskMix:
        return self._parse(text) if text.strip() else self._default_task

    def _on_generate(self, request: GenerateEpisode.Request, response: GenerateEpisode.Response) -> None:
        seed = SeedPath(
            run_seed=int(request.run_seed),
            purpose=request.purpose,
            index=int(request.index),
            attempt=int(request.attempt),
        )
        draw = self._generator.draw(seed, self._task_config(request.task_config))
        response.task = to_msg(draw.task, TaskSpecMsg)
        response.scene = to_msg(draw.scene, SceneSpecMsg)
        response.max_steps = draw.max_steps
        response.task_config_json = draw.config_json

    def _on_judge(self, request: Judge.Request, response: Judge.Response) -> None:
        task = from_msg(request.task[0], TaskSpec) if request.task else None
        verdict = self.judge(request.episode_id, from_msg(request.state, StateRecord), task)
        response.verdict = to_msg(verdict, VerdictMsg)

    def judge(self, episode_id: str, state: StateRecord, task: TaskSpec | None = None) -> Verdict:
        """Judge the next tick of an episode; may be called from any thread.

        Args:
            episode_id: The episode.
            state: The tick's state.
            task: The task, with tick 0; it starts the episode.

        Raises:
            InvalidRequestError: When the state belongs to another episode.
            TaskError: ``UNKNOWN_EPISODE`` when the episode was not started.
        """
        with self._judging:
            return self._judge(episode_id, state, task)

    def _judge(self, episode_id: str, state: StateRecord, task: TaskSpec | None) -> Verdict:
        if state.episode_id != episode_id:
            raise InvalidRequestError(f"the state belongs to episode '{state.episode_id}', not '{episode_id}'")
        if task is not None:
            judge = TaskJudge(task)
            verdict = judge.start(state)
            self._judges[episode_id] = judge
            if len(self._judges) > MAX_JUDGES:
                self._judges.popitem(last=False)
            return verdict
        if episode_id not in self._judges:
            raise TaskError(
                f"no episode '{episode_id}' is being judged; start with tick 0 and the task",
                ErrorCode.UNKNOWN_EPISODE,
            )
        self._judges.move_to_end(episode_id)
        return self._judges[episode_id].step(state)
