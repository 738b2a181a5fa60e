"""Known answers: the expert's actions, said in each convention and understood by it, succeed as the expert's own do."""

import numpy as np
import pytest

pytest.importorskip("rclpy")

from roboxim_bringup.core_graph import CoreGraph
from roboxim_bringup.cores import CorePlanner
from roboxim_core.actions import ActionContext, ActionSemantics
from roboxim_core.config_folders import config_names
from roboxim_core.conventions import decode_actions, from_actions, load_convention
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_core.kinematics import ArmKinematics
from roboxim_core.models.library import ModelLibrary
from roboxim_core.policies import ActionChunk
from roboxim_policies import BasePolicy
from roboxim_runs.episodes.task_choice import task_text
from roboxim_tasks.demonstration.expert import Expert

EPISODES = 1
CONFIG = RunConfig(run_seed=11, purpose="eval", task_config=task_text("pick_cube"), cameras=(), output_dir="")


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

    def reset(self, start):
        self.scene = start.scene
        self.states, self.labels = [], []
        self.expert.reset(start)

    def act(self, window):
        answer = self.expert.act(window)
        self.states.append(window.newest.state)
        self.labels.append(answer.actions[0])
        rows = decode_actions(self.convention, self.numbers([self.states[-1]], answer.actions))
        return ActionChunk(actions=rows.astype(np.float32), done=answer.done, phases=answer.phases)

    def numbers(self, states, labels):
        """Return the convention's numbers for actions, each with the state before it."""
        track = [ActionContext.of(state, self.scene.robot.pose, self.arm) for state in states]
        source = ActionSemantics(rate_hz=self.scene.control_rate_hz)
        return from_actions(self.convention, labels, track, source=source).astype(np.float32)


class Recorded(BasePolicy):
    """An episode's numbers, answered in chunks as long as the convention's, as a server would."""

    def __init__(self, convention, numbers):
        self.convention, self.numbers = convention, numbers
        self.semantics = convention.semantics
        self.gripper = convention.action.gripper.rule
        self.horizon = convention.chunking.horizon
        self.chunking = convention.chunking.execution

    def act(self, window):
        first = min(window.seq, len(self.numbers) - 1)
        return decode_actions(self.convention, self.numbers[first : first + self.horizon]).astype(np.float32)


@pytest.mark.slow
@pytest.mark.parametrize("name", config_names("conventions"))
def test_the_expert_succeeds_through_every_convention(name):
    convention = load_convention(name)
    policy = SaidInAConvention(convention)
    with CoreGraph("unused", renderer="tiny", policy=policy) as graph:
        runner = EpisodeRunner(graph.ports, CONFIG)
        results = [runner.run_index(index) for index in range(EPISODES)]
    assert policy.scene.control_rate_hz == (convention.rate_hz or 10.0)
    assert [(r.outcome, r.message, r.clipped) for r in results] == [("success", "", 0)] * EPISODES
    # The last episode once more, converted as a whole and answered in chunks. Each delta to the measured state meets
    # the state that it was made for, so the same episode comes out.
    numbers = policy.numbers(policy.states, np.array(policy.labels))
    with CoreGraph("unused", renderer="tiny", policy=Recorded(convention, numbers)) as graph:
        again = EpisodeRunner(graph.ports, CONFIG).run_index(EPISODES - 1)
    assert (again.outcome, again.message, again.steps) == ("success", "", results[-1].steps)
