"""Known answers: the expert's actions, said in each convention and understood by it, succeed as the expert's own do."""

import numpy as np
import pytest

pytest.importorskip("rclpy")

from roboxim_bringup.core_graph import CoreGraph
from roboxim_bringup.cores import CorePlanner
from roboxim_bringup.task_choice import task_text
from roboxim_core.actions import ActionSemantics
from roboxim_core.actions.rows import ArmTrack
from roboxim_core.config_folders import config_names
from roboxim_core.conventions import decode_actions, from_actions, load_convention
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_core.kinematics import ArmKinematics
from roboxim_core.models.library import ModelLibrary
from roboxim_core.policies import ActionChunk
from roboxim_policies import BasePolicy
from roboxim_tasks.expert import Expert

EPISODES = 2


class SaidInAConvention(BasePolicy):
    """The expert, each of whose actions becomes the convention's numbers, as float32, and back."""

    privileged = True

    def __init__(self, convention):
        library = ModelLibrary()
        self.convention = convention
        self.expert = Expert(library, CorePlanner(library))
        self.arm = ArmKinematics(library.robot("panda"))
        self.semantics = convention.semantics
        self.gripper = convention.action.gripper.rule
        self.outside = 0

    def reset(self, start):
        self.scene = start.scene
        self.expert.reset(start)

    def act(self, window):
        answer = self.expert.act(window)
        track = ArmTrack.of([window.newest.state], self.scene.robot.pose, self.arm)
        source = ActionSemantics(rate_hz=self.scene.control_rate_hz)
        raw = from_actions(self.convention, answer.actions, track, source=source).astype(np.float32)
        return ActionChunk(
            actions=decode_actions(self.convention, raw).astype(np.float32), done=answer.done, phases=answer.phases
        )


@pytest.mark.slow
@pytest.mark.parametrize("name", config_names("conventions"))
def test_the_expert_succeeds_through_every_convention(name):
    policy = SaidInAConvention(load_convention(name))
    config = RunConfig(run_seed=11, purpose="eval", task_config=task_text("pick_cube"), cameras=(), output_dir="")
    with CoreGraph("unused", renderer="tiny", policy=policy) as graph:
        runner = EpisodeRunner(graph.ports, config)
        results = [runner.run_index(index) for index in range(EPISODES)]
    rate = policy.convention.rate_hz or 10.0
    assert policy.scene.control_rate_hz == rate
    assert [(r.outcome, r.reason, r.message) for r in results] == [("success", "", "")] * EPISODES
    print(name, [(r.steps, r.clipped) for r in results])
