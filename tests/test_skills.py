"""Every registered skill, through the cores: the expert solves it, doing nothing or anything does not, a bag judges it
as it was judged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml

from roboxim_bringup.core_graph import CoreGraph, CoreTasks
from roboxim_bringup.task_choice import task_text
from roboxim_core.config import config_dir
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_core.models.library import ModelLibrary
from roboxim_core.policies import ActionChunk
from roboxim_policies.builtin import RandomPolicy, ZeroPolicy
from roboxim_recorder.bag import BagReader
from roboxim_tasks.skills import SKILLS

SKILL_NAMES = sorted(SKILLS)


def without_cameras(skill, **changes):
    data = yaml.safe_load(task_text(skill=skill))
    data.setdefault("reset", {})["cameras"] = {"names": []}
    return yaml.safe_dump(data | changes)


def run(folder, skill, index=0, policy=None, actor=None, *, changes=None, **config):
    with CoreGraph(folder, renderer="tiny", policy=policy) as cores:
        ports = cores.ports if actor is None else actor(cores.ports)
        text = without_cameras(skill, **(changes or {}))
        config = {"purpose": "test", "output_dir": str(folder), "run_seed": 5, "task_config": text, **config}
        return EpisodeRunner(ports, RunConfig(**config)).run_index(index)


@pytest.mark.parametrize("skill", SKILL_NAMES)
def test_the_expert_solves_it_at_its_first_try_and_the_bag_says_the_same(skill, tmp_path):
    result = run(tmp_path, skill, noise_translation_m=0.003, noise_rotation_rad=0.01)
    assert (result.outcome, result.recovered, result.reason) == ("success", False, ""), result
    judge = CoreTasks(ModelLibrary())
    bag = BagReader(tmp_path / result.bag)
    for tick in bag.ticks(cameras=()):
        again = judge.start(result.episode_id, bag.info.task, tick.state) if tick.seq == 0 else judge.judge(tick.state)
        assert again == tick.step.verdict
    assert again.success
    assert not next(bag.ticks(cameras=())).step.verdict.success


@pytest.mark.parametrize("policy", [ZeroPolicy, RandomPolicy])
@pytest.mark.parametrize("skill", SKILL_NAMES)
def test_nothing_and_anything_do_not_solve_it(skill, policy, tmp_path):
    result = run(tmp_path, skill, index=1, policy=policy(), keep="none", max_steps=25, settle_ticks=5)
    assert not result.success_ever
    assert result.reason


@pytest.mark.slow
@pytest.mark.parametrize("policy", [ZeroPolicy, RandomPolicy])
@pytest.mark.parametrize("skill", SKILL_NAMES)
def test_whole_episodes_of_nothing_and_anything_do_not_solve_it(skill, policy, tmp_path):
    results = [run(tmp_path, skill, index=index, policy=policy(), keep="none") for index in range(2, 7)]
    assert not any(result.success_ever for result in results)


@pytest.mark.parametrize("skill", SKILL_NAMES)
def test_it_ships_a_task_of_its_name(skill):
    assert (config_dir() / "tasks" / f"{skill}.yaml").is_file()


class Fumbling:
    """An expert whose first grasp does not close."""

    def __init__(self, actor):
        self._actor, self.missed = actor, 0

    def __getattr__(self, name):
        return getattr(self._actor, name)

    def act(self, window):
        chunk = self._actor.act(window)
        actions = np.array(chunk.actions)
        if actions[0, 6] == 0.0 and self.missed < 6 and chunk.phases != ("recovery",):
            actions[0, 6] = 1.0
            self.missed += 1
        return ActionChunk(actions=actions, done=chunk.done, phases=chunk.phases)


def test_a_second_grasp_succeeds_but_is_no_first_try(tmp_path):
    def fumbling(ports):
        return replace(ports, actor=Fumbling(ports.actor))

    result = run(tmp_path, "place_on", actor=fumbling)
    assert (result.outcome, result.recovered) == ("success", True), result
    assert BagReader(tmp_path / result.bag).result.recovered
