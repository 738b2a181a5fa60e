"""A replay names the first tick that differs, and gives the sim back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from roboxim_core.errors import ErrorCode, SimError
from roboxim_core.poses import Pose
from roboxim_recorder.bag import BagReader
from roboxim_recorder.replay import replay


class FakeSim:
    """Answers the recorded states, but another one at a given tick."""

    def __init__(self, episode, wrong_at=None):
        self.episode, self.wrong_at, self.released = episode, wrong_at, []

    def load(self, episode_id, scene, semantics):
        assert semantics == self.episode.info.semantics
        assert scene == self.episode.scene
        return self.state(0)

    def tick(self, episode_id, seq, action):
        assert action.dtype == np.float32
        assert tuple(action.tolist()) == self.episode.label(seq)
        return self.state(seq)

    def state(self, seq):
        state = self.episode.state(seq)
        if seq != self.wrong_at:
            return state
        entities = (replace(state.entities[0], pose=Pose(position=(0.5, 0.003, 0.02))),)
        return replace(state, entities=entities, state_hash="f" * 32)

    def release(self, episode_id):
        self.released.append(episode_id)


def test_the_same_states_are_the_same(tmp_path, fake):
    sim = FakeSim(fake())
    seen = []
    report = replay(BagReader(fake().record(tmp_path)), sim, episode_id="mine", on_tick=seen.append)
    assert report.same
    assert (report.ticks, len(seen), sim.released) == (8, 8, ["mine"])


def test_the_first_diverging_tick_is_named(tmp_path, fake):
    report = replay(BagReader(fake().record(tmp_path)), FakeSim(fake(), wrong_at=3))
    assert (report.diverged_at, report.ticks, report.replayed_hash) == (3, 4, "f" * 32)
    assert report.difference == "target is 3 mm and 0 rad away"


def test_a_refusal_of_the_sim_still_gives_it_back(tmp_path, fake):
    sim = FakeSim(fake())

    def refuse(*_):
        raise SimError("held by another", ErrorCode.LEASE_HELD)

    sim.load = refuse
    with pytest.raises(SimError, match="held by another"):
        replay(BagReader(fake().record(tmp_path)), sim)
    assert sim.released == ["demo-0-00000-0"]
