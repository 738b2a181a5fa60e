"""Trainings resume exactly after an interruption, and never leave an incomplete checkpoint."""

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest
from made_up_demonstrations import COLORS, CONFIG, data, episode, first_action

from roboxim_core.errors import ConfigError
from roboxim_policies.learning.checkpoint import Checkpoint, load_checkpoint, policy_only
from roboxim_policies.learning.policy import LearnedPolicy
from roboxim_policies.learning.train import Trainer


@pytest.mark.thorough
def test_an_interrupted_training_ends_in_the_same_bits(trained, tmp_path):
    class Interrupt(KeyboardInterrupt):
        pass

    def interrupt(report):
        if report.step >= 30:
            raise Interrupt

    with pytest.raises(Interrupt):
        Trainer(data(), CONFIG, tmp_path).run(interrupt)
    resumed = Trainer(data(), CONFIG, tmp_path)
    assert resumed.step == 30
    resumed.run()
    whole, parts = load_checkpoint(trained[0]), load_checkpoint(tmp_path)
    assert whole.digest == parts.digest
    assert all(np.array_equal(a, b) for a, b in zip(whole.arrays, parts.arrays, strict=True))


@pytest.mark.thorough
def test_another_configuration_or_data_set_is_not_resumed(trained):
    with pytest.raises(ConfigError, match=r"of another configuration \(seed: 0 stored, 1 requested\); choose"):
        Trainer(data(), replace(CONFIG, seed=1), trained[0])
    with pytest.raises(ConfigError, match="of another dataset; choose"):
        Trainer(data(20), CONFIG, trained[0])
    with pytest.raises(ConfigError, match="exists"):
        Trainer(data(), CONFIG, trained[0], resume=False)


def test_every_label_and_picture_belongs_to_the_identity_of_a_training():
    known = data(6)
    identity = Checkpoint.identity_of(CONFIG, known)
    assert Checkpoint.identity_of(replace(CONFIG, checkpoint_every=7), data(6)) == identity
    others = {0: 1, 1: 0}  # two instructions change places: the same words, the same number of each
    corrected = np.vectorize(others.get)(known.instruction).astype(known.instruction.dtype)
    words = np.stack([known.words[np.flatnonzero(known.instruction == number)[0]] for number in corrected])
    images = {name: pictures.copy() for name, pictures in known.images.items()}
    images["workspace"][17, 3, 3] += 1
    for changed in (
        replace(known, instruction=corrected, words=words), replace(known, images=images),
        replace(known, instructions=tuple(text.replace("cube", "block") for text in known.instructions)),
    ):  # fmt: skip
        assert Checkpoint.identity_of(CONFIG, changed) != identity


@pytest.mark.thorough
def test_a_checkpoint_of_the_earlier_format_acts_and_is_not_continued(trained, tmp_path):
    with np.load(trained[0] / "checkpoint.npz") as archive:
        arrays = dict(archive)
    arrays["said"] = np.array(json.dumps(json.loads(str(arrays["said"])) | {"format": 5}))
    np.savez(tmp_path / "checkpoint.npz", **arrays)
    shown = episode(np.random.default_rng(3), "red")
    policies = LearnedPolicy(trained[0]), LearnedPolicy(tmp_path)
    assert np.array_equal(*(first_action(policy, shown, shown.instruction) for policy in policies))
    with pytest.raises(ConfigError, match="its policy acts, and its training cannot be continued.*another output"):
        Trainer(data(), CONFIG, tmp_path)


@pytest.mark.thorough
def test_a_failed_write_leaves_the_old_checkpoint_whole(trained, tmp_path, monkeypatch):
    trainer = Trainer(data(), CONFIG, tmp_path)
    trainer.run(until=10)
    before = (tmp_path / "checkpoint.npz").read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("roboxim_policies.learning.checkpoint.os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        trainer.run(until=20)
    assert (tmp_path / "checkpoint.npz").read_bytes() == before
    assert load_checkpoint(tmp_path).step == 10


@pytest.mark.thorough
def test_a_damaged_checkpoint_is_refused_by_name(trained, tmp_path):
    whole = (trained[0] / "checkpoint.npz").read_bytes()
    (tmp_path / "half.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ConfigError, match=r"half\.npz"):
        LearnedPolicy(tmp_path / "half.npz")
    with pytest.raises(ConfigError, match="roboxim train bc"):
        LearnedPolicy(tmp_path / "absent")


@pytest.mark.thorough
def test_a_copy_without_the_state_of_the_training_acts_the_same(trained, tmp_path):
    whole = trained[0] / "checkpoint.npz"
    short = tmp_path / "checkpoint.npz"
    short.write_bytes(policy_only(whole))
    assert short.stat().st_size < whole.stat().st_size / 3
    one, other = load_checkpoint(whole), load_checkpoint(tmp_path)
    assert not np.array_equal(one.arrays[0], one.arrays[-1]), "the weights are not their average"
    assert [array.tolist() for array in other.arrays] == [one.arrays[-1].tolist()]
    assert (one.original_sha256, other.original_sha256) == ("", hashlib.sha256(whole.read_bytes()).hexdigest())
    assert (other.step, other.identity, other.digest, other.robot) == (300, one.identity, one.digest, "panda")
    policies = LearnedPolicy(whole), LearnedPolicy(tmp_path)
    assert policies[0].describe() == policies[1].describe()
    rng = np.random.default_rng(3)
    for color in COLORS:
        shown = episode(rng, color)
        answers = [first_action(policy, shown, shown.instruction) for policy in policies]
        assert np.array_equal(*answers)
    assert policy_only(trained[0]) == short.read_bytes(), "the folder gives the same bytes"
    with pytest.raises(ConfigError, match="has the averaged weights only already"):
        policy_only(short)


@pytest.mark.thorough
@pytest.mark.parametrize(("steps", "said"), [(300, "has all its steps"), (10, "cannot continue")])
def test_no_training_continues_from_such_a_copy(trained, tmp_path, steps, said):
    whole = Trainer(data(), CONFIG, tmp_path / "whole").run(until=steps) if steps < CONFIG.steps else trained[0]
    short = tmp_path / "checkpoint.npz"
    before = policy_only(whole)
    short.write_bytes(before)
    text = (
        f"averaged weights only, after {steps} of 300 steps: .*experiment pack.*; the training {said}.*choose another"
    )
    with pytest.raises(ConfigError, match=text):
        Trainer(data(), CONFIG, tmp_path)
    with pytest.raises(ConfigError, match="of another configuration"):
        Trainer(data(), replace(CONFIG, seed=1), tmp_path)
    assert short.read_bytes() == before


@pytest.mark.thorough
def test_weights_that_are_not_those_of_the_description_are_not_copied(trained, tmp_path):
    with np.load(trained[0] / "checkpoint.npz") as archive:
        content = dict(archive)
    content[max(content.keys() - {"said"})] += 1.0
    np.savez(tmp_path / "checkpoint.npz", **content)
    with pytest.raises(ConfigError, match="is damaged: the hash of its averaged weights differs"):
        policy_only(tmp_path)
    np.savez(tmp_path / "checkpoint.npz", said=content["said"])
    with pytest.raises(ConfigError, match="it has no weights"):
        load_checkpoint(tmp_path)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("changed", "said"),
    [({"step": "x"}, "step: expected a whole number"), ({"stats": {"state_mean": [1.0]}}, "stats must have the len"),
     ({"vocabulary": 1}, "vocabulary: expected a list"), ({"word_count": -1}, "word_count, .* must be >= 1"),
     ({"camera_sizes": {"workspace": [1]}}, "camera_sizes.workspace: expected 2 values, got 1"),
     ({"input_sizes": {}}, "input_sizes must name the cameras"), ({"empty_below": None}, "empty_below: expected a num"),
     ({"state_layout": None}, "trained on proprioception None"), ({"chosen": {}}, "chosen.step: required key")],
)  # fmt: skip
def test_a_wrong_description_of_a_checkpoint_is_refused_by_its_field(trained, tmp_path, changed, said):
    with np.load(trained[0] / "checkpoint.npz") as archive:
        arrays = dict(archive)
    arrays["said"] = np.array(json.dumps(json.loads(str(arrays["said"])) | changed))
    np.savez(tmp_path / "wrong.npz", **arrays)
    with pytest.raises(ConfigError, match=rf"wrong\.npz.*{said}"):
        load_checkpoint(tmp_path / "wrong.npz")


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("changed", "said"),
    [({"format": 1}, r"old\.npz was trained on proprioception of the old layout.*train again"),
     ({"format": 2}, r"old\.npz holds the earlier network.*train again"),
     ({"state_layout": ["x", "y"]}, r"trained on proprioception \['x', 'y'\]")],
)  # fmt: skip
def test_a_checkpoint_of_another_proprioception_is_refused_by_name(trained, tmp_path, changed, said):
    with np.load(trained[0] / "checkpoint.npz") as archive:
        arrays = dict(archive)
    arrays["said"] = np.array(json.dumps(json.loads(str(arrays["said"])) | changed))
    np.savez(tmp_path / "old.npz", **arrays)
    with pytest.raises(ConfigError, match=said):
        LearnedPolicy(tmp_path / "old.npz")
