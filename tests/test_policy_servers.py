"""An evaluation whose policy is served to all workers by one process is the evaluation with a policy in each worker."""

from __future__ import annotations

import os
import signal

import pytest
from planted_runs import recordings, repeatable_results

from roboxim_runs.evaluation.run import EvaluationConfig, evaluate
from roboxim_runs.events import EpisodeFinished, Notice
from roboxim_runs.executors import LocalExecutor

pytestmark = [pytest.mark.ros, pytest.mark.slow]

POLICY = """
import numpy as np

from roboxim_policies import BasePolicy


class Wandering(BasePolicy):
    \"\"\"Acts on everything that it may see.\"\"\"

    cameras = ("workspace",)
    window = 2
    horizon = 2

    def reset(self, start):
        self.random = np.random.default_rng(start.seed + len(start.instruction))

    def act(self, window):
        seen = [item.images["workspace"].mean() / 255 for item in window.observations]
        moved = self.random.normal(size=(2, 7)) * 0.003 + np.mean(seen) * 0.001
        moved[:, :3] += 0.01 * (0.4 - np.array(window.newest.proprio.tcp_position))
        moved[:, 6] = sum(window.pad_mask) % 2
        return moved
"""


@pytest.fixture
def run(tmp_path):
    (tmp_path / "wandering.py").write_text(POLICY)

    def run(name, **options):
        config = EvaluationConfig(
            policies=f"mine={tmp_path}/wandering.py:Wandering", out=tmp_path / name, episodes=4, max_steps=12,
            size=32, renderer="tiny", workers=2,
        )  # fmt: skip
        evaluate(config, **options)
        return tmp_path / name / "mine"

    return run


def same(one, other):
    assert recordings(one) == recordings(other)
    assert repeatable_results(one) == repeatable_results(other)


def test_a_served_policy_gives_the_bags_of_one_in_each_worker(run):
    server = LocalExecutor(1)
    served = run("served", servers=[server])
    assert not server.pids(), "the server ends with the evaluation"
    same(served, run("apart"))


def test_a_policy_server_that_dies_is_started_again_and_its_episodes_are_repeated(run):
    server, told, killed = LocalExecutor(1), [], []

    def kill(event):
        if isinstance(event, EpisodeFinished) and not killed:
            killed.extend(server.pids())
            os.kill(killed[0], signal.SIGKILL)
        if isinstance(event, Notice):
            told.append(event.text)

    served = run("served", servers=[server], on_event=kill)
    assert any("the server of policy 'mine'" in text and "starting it again" in text for text in told)
    same(served, run("apart"))
