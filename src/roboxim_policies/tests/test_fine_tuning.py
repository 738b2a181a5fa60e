"""A training may begin with a checkpoint: of the same family and shape, with its weights, words and normalisation."""

from dataclasses import replace

import numpy as np
import pytest
from made_up_demonstrations import CONFIG, data

from roboxim_core.errors import ConfigError, EvaluationError
from roboxim_policies.learning.checkpoint import load_checkpoint, policy_only
from roboxim_policies.learning.policy import LearnedPolicy
from roboxim_policies.learning.start import carried_statistics, carried_weights
from roboxim_policies.learning.train import Trainer, statistics

SHORT = replace(CONFIG, steps=4)


@pytest.fixture(scope="module")
def start(tmp_path_factory):
    folder = tmp_path_factory.mktemp("start")
    Trainer(data(4), SHORT, folder).run()
    return load_checkpoint(folder)


def reworded(demonstrations, old, new):
    """Return demonstrations in which a word of the vocabulary is another one."""
    words = tuple(new if word == old else word for word in demonstrations.vocabulary)
    assert sorted(words) == list(words)  # the indices stay
    return replace(demonstrations, vocabulary=words)


@pytest.mark.thorough
def test_it_begins_with_the_weights_of_the_checkpoint_and_names_it(start, tmp_path):
    trainer = Trainer(data(4), SHORT, tmp_path, start=start)
    assert np.array_equal(trainer._at[0][0], start.arrays[-1])
    trainer.run()
    tuned = load_checkpoint(tmp_path)
    assert tuned.started_from == {"digest": start.digest, "step": 4}
    assert tuned.digest != start.digest
    assert np.array_equal(tuned.stats.state_mean, start.stats.state_mean)
    assert LearnedPolicy(tmp_path).version == f"step 4, {tuned.digest}, fine-tuned from {start.digest}"


@pytest.mark.thorough
def test_an_interrupted_fine_tuning_continues_and_another_start_is_another_training(start, tmp_path):
    Trainer(data(4), SHORT, tmp_path / "whole", start=start).run()
    Trainer(data(4), SHORT, tmp_path / "parts", start=start).run(until=2)
    resumed = Trainer(data(4), SHORT, tmp_path / "parts", start=start)
    assert resumed.step == 2
    resumed.run()
    whole, parts = load_checkpoint(tmp_path / "whole"), load_checkpoint(tmp_path / "parts")
    assert all(np.array_equal(a, b) for a, b in zip(whole.arrays, parts.arrays, strict=True))
    with pytest.raises(ConfigError, match=r"is of another start \(--from\)"):
        Trainer(data(4), SHORT, tmp_path / "parts")


@pytest.mark.thorough
def test_a_packed_checkpoint_is_enough_and_its_exposure_is_handed_on(start, tmp_path):
    Trainer(data(4), SHORT, tmp_path / "base").run()
    packed = tmp_path / "packed.npz"
    packed.write_bytes(policy_only(tmp_path / "base", {"name": "mine", "exposure": {"episodes": 4}}))
    Trainer(data(4), SHORT, tmp_path / "tuned", start=load_checkpoint(packed)).run()
    told = load_checkpoint(tmp_path / "tuned").started_from
    assert told["pretraining"] == {"name": "mine", "exposure": {"episodes": 4}}


@pytest.mark.thorough
def test_words_that_both_know_keep_their_embeddings(start):
    other = reworded(data(4), "red", "scarlet")
    weights = carried_weights(start, SHORT, other)
    changed = np.flatnonzero(np.asarray(weights) != start.arrays[-1])
    assert len(changed) == SHORT.word_size  # of the one word that is new


@pytest.mark.thorough
def test_a_motion_that_the_checkpoint_never_saw_has_the_scale_of_the_data(start):
    shown = data(4)
    shown.actions[:, 2] = 0.01
    shown.actions[:, 1] = 0.005
    own = statistics(shown)
    assert start.stats.motion_scale[1:3].tolist() == [0.0, 0.0]
    carried = carried_statistics(start, own)
    assert carried.motion_scale[2] == own.motion_scale[2] > 0
    x = start.stats.motion_scale[0]
    assert carried.motion_scale[:2].tolist() == [x, x], "the network turns these vectors, so they share a scale"


@pytest.mark.thorough
def test_another_shape_family_camera_or_meaning_is_refused_by_name(start, tmp_path):
    with pytest.raises(ConfigError, match=r"another shape \(channels: 8 stored, 16 requested\)"):
        Trainer(data(4), replace(SHORT, channels=16), tmp_path, start=start)
    with pytest.raises(ConfigError, match="chunk: 4 stored, 6 requested"):
        Trainer(data(4), replace(SHORT, chunk=6), tmp_path, start=start)
    from roboxim_policies.act.config import ACTConfig

    with pytest.raises(ConfigError, match="is of 'act', and the checkpoint that it should begin with of 'bc'"):
        Trainer(data(4), ACTConfig(steps=4), tmp_path, start=start)
    one = data(4)
    del one.images["wrist"]
    with pytest.raises(ConfigError, match=r"sees the cameras workspace \(32 px\), wrist \(16 px\), and the training w"):
        Trainer(one, SHORT, tmp_path, start=start)
    faster = replace(data(4), semantics=replace(start.semantics, rate_hz=20.0))
    with pytest.raises(EvaluationError, match="rate_hz"):
        Trainer(faster, SHORT, tmp_path, start=start)
