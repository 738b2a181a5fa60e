"""Held-out demonstrations choose the weights, and end a training that no longer gets better on them."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from made_up_demonstrations import CONFIG, data, episode

from roboxim_core.actions import ActionSemantics
from roboxim_core.errors import ConfigError
from roboxim_core.vision.images import resized
from roboxim_policies.learning import data as reading_of
from roboxim_policies.learning.checkpoint import Checkpoint, load_checkpoint, policy_only
from roboxim_policies.learning.data import Reading, _view
from roboxim_policies.learning.policy import LearnedPolicy
from roboxim_policies.learning.train import Trainer

HELD = replace(CONFIG, steps=40, checkpoint_every=10, held_out=4)


@pytest.fixture(scope="module")
def reading():
    rng = np.random.default_rng(0)
    episodes = [episode(rng, ("red", "blue")[i % 2]) for i in range(12)]
    sizes = {"workspace": (32, 32), "wrist": (16, 16)}
    return Reading(episodes=episodes, camera_sizes=sizes, semantics=ActionSemantics(), robot="panda")


def trainer(reading, config, folder):
    train, held_out = reading.split(config.held_out, config.seed)
    return Trainer(train, config, folder, held_out=held_out)


def test_episodes_are_trained_on_or_held_out(reading):
    train, held_out = reading.split(4, seed=0)
    assert (train.episodes, held_out.episodes) == (8, 4)
    assert held_out.vocabulary == train.vocabulary
    everything = np.concatenate([train.actions, held_out.actions])
    assert np.allclose(np.sort(everything[:, 0]), np.sort(reading.assemble().actions[:, 0]))
    with pytest.raises(ConfigError, match="12 demonstrations in all"):
        reading.split(12, seed=0)


@pytest.mark.thorough
def test_the_policy_has_the_weights_with_the_lowest_held_out_loss_also_after_an_interruption(reading, tmp_path):
    whole = trainer(reading, HELD, tmp_path / "whole")
    losses = {}
    judged = whole._held_out.loss

    def noted(weights):
        step = whole.step + 1  # the step is done when its comparison is
        losses[step] = judged(weights), np.asarray(weights)
        return losses[step][0] if step != 20 else -1.0  # as if step 20 were best

    whole._held_out.loss = noted
    whole.run()
    assert sorted(losses) == [10, 20, 30, 40]
    found = load_checkpoint(tmp_path / "whole")
    assert (found.chosen.step, found.chosen.checks, found.chosen.since, found.step) == (20, 4, 2, 40)
    assert np.array_equal(found.arrays[-1], losses[20][1])
    assert (
        "step 20 (lowest loss on 4 held-out demonstrations, of 4 checks)" in LearnedPolicy(tmp_path / "whole").version
    )
    assert len(policy_only(tmp_path / "whole")) < (tmp_path / "whole" / "checkpoint.npz").stat().st_size / 3

    straight = trainer(reading, HELD, tmp_path / "straight")
    straight.run()
    trainer(reading, HELD, tmp_path / "parts").run(until=15)
    resumed = trainer(reading, HELD, tmp_path / "parts")
    resumed.run()
    assert resumed.chosen == straight.chosen
    assert load_checkpoint(tmp_path / "parts").digest == load_checkpoint(tmp_path / "straight").digest


@pytest.mark.thorough
def test_a_training_ends_when_the_held_out_loss_stops_to_fall(reading, tmp_path):
    config = replace(HELD, patience=2)
    training = trainer(reading, config, tmp_path)
    rising = iter(range(100))
    training._held_out.loss = lambda weights: float(next(rising))
    training.run()
    assert (training.step, training.chosen.step, training.done) == (30, 10, True)
    assert trainer(reading, config, tmp_path).done  # and stays ended


@pytest.mark.thorough
def test_a_training_that_ends_before_the_first_comparison_saves_its_average_not_its_first_weights(reading, tmp_path):
    config = replace(HELD, steps=20, checkpoint_every=20)
    trainer(reading, config, tmp_path / "held").run(until=5)
    whole, held = trainer(reading, config, tmp_path / "whole"), load_checkpoint(tmp_path / "held")
    assert held.chosen is None
    assert np.array_equal(held.arrays[-1], held.arrays[-2])
    assert not np.array_equal(held.arrays[-1], np.asarray(whole._at[0][0])), "the weights as they were drawn"
    assert LearnedPolicy(tmp_path / "held").version.startswith("step 5, ")


@pytest.mark.thorough
def test_an_interruption_at_a_comparison_loses_no_comparison(reading, tmp_path):
    straight = trainer(reading, HELD, tmp_path / "straight")
    straight.run()
    parts = trainer(reading, HELD, tmp_path / "parts")

    def interrupted(weights):
        raise KeyboardInterrupt

    parts._held_out.loss = interrupted
    with pytest.raises(KeyboardInterrupt):
        parts.run()
    resumed = trainer(reading, HELD, tmp_path / "parts")
    resumed.run()
    assert (resumed.chosen, resumed.chosen.checks) == (straight.chosen, 4)
    ends = [load_checkpoint(tmp_path / name) for name in ("parts", "straight")]
    assert all(np.array_equal(a, b) for a, b in zip(*(end.arrays for end in ends), strict=True))


@pytest.mark.thorough
def test_a_held_out_loss_that_is_not_finite_chooses_no_weights(reading, tmp_path):
    training = trainer(reading, HELD, tmp_path)
    training.run(until=10)
    before = (tmp_path / "checkpoint.npz").read_bytes()
    training._held_out.loss = lambda weights: float("nan")
    with pytest.raises(ConfigError, match="diverged: the loss or the weights are not finite at step 20"):
        training.run()
    assert (tmp_path / "checkpoint.npz").read_bytes() == before


def test_held_out_demonstrations_and_their_comparisons_belong_to_the_identity(reading):
    train, held_out = reading.split(4, seed=0)
    identity = Checkpoint.identity_of(HELD, train, None, held_out)
    moved = replace(held_out, actions=held_out.actions + 1)
    assert Checkpoint.identity_of(HELD, train, None, moved) != identity
    assert Checkpoint.identity_of(replace(HELD, checkpoint_every=20), train, None, held_out) != identity


def test_a_wrong_choice_is_refused(reading, tmp_path):
    with pytest.raises(ConfigError, match="patience needs held_out"):
        replace(CONFIG, patience=3)
    with pytest.raises(ConfigError, match="held_out is 4, and there are no such episodes"):
        Trainer(data(4), HELD, tmp_path)


def test_a_number_that_is_not_finite_is_named_before_the_training(monkeypatch):
    """The training would diverge, and advise another learning rate."""
    rng = np.random.default_rng(0)
    shown = [episode(rng, "red"), episode(rng, "blue")]
    shown[1].actions[3, 2] = np.nan

    def read(demonstration):
        frames = demonstration.images["workspace"]
        steps = [
            SimpleNamespace(images={"workspace": frame}, proprio=proprio, action=action)
            for frame, proprio, action in zip(frames, demonstration.proprio, demonstration.actions, strict=True)
        ]
        return SimpleNamespace(
            picker=lambda names: lambda step: step.proprio, steps=lambda cameras: iter(steps), robot="panda",
            metadata={}, instruction=demonstration.instruction, semantics=ActionSemantics(),
        )  # fmt: skip

    camera = SimpleNamespace(width=32, height=32)
    dataset = SimpleNamespace(
        splits={"train": 2}, features=SimpleNamespace(cameras={"workspace": camera}),
        episodes=lambda split: iter(map(read, shown)),
    )  # fmt: skip
    monkeypatch.setattr(reading_of, "open_dataset", lambda path: dataset)
    monkeypatch.setattr(reading_of, "require_semantics", lambda episode, path: episode.semantics)
    with pytest.raises(ConfigError, match="set: episode 1 .*: component 2 of the action of step 3 is nan"):
        reading_of.read_demonstrations(Path("set"), image_sizes={"workspace": 16}, limit=2)
    shown[1].actions[3, 2] = 0.0
    found = reading_of.read_demonstrations(Path("set"), image_sizes={"workspace": 16}, limit=2)
    together = found.assemble().images["workspace"]
    expected = [resized(frame, 16, 16) for each in shown for frame in each.images["workspace"]]
    assert len(found.episodes) == 2
    assert np.array_equal(together, expected)
    assert all(np.shares_memory(each.images["workspace"], together) for each in found.episodes)
    assert isinstance(together, np.memmap), "demonstrations take disk space, not memory"
    shown[1] = replace(shown[1], images={"workspace": []}, proprio=[], actions=[])
    with pytest.raises(ConfigError, match="set: episode 1 of split 'train' has no steps; export"):
        reading_of.read_demonstrations(Path("set"), image_sizes={"workspace": 16}, limit=2)


def test_demonstrations_say_from_where_their_cameras_looked():
    drawn = {"camera.workspace": "whole_left", "target": "apple"}
    told = SimpleNamespace(metadata={"task": json.dumps({"drawn": drawn})})
    assert [_view(told, camera) for camera in ("workspace", "wrist")] == ["whole_left", "wrist"]
    for other in ({}, {"task": "pick up"}, {"task": "[]"}):
        assert _view(SimpleNamespace(metadata=other), "workspace") == ""
