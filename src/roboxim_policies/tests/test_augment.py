"""Augmented pictures and words differ from the recorded ones as configured, and in nothing else."""

from dataclasses import fields, replace

import jax.numpy as jnp
import numpy as np
import pytest
from made_up_demonstrations import CONFIG, data

from roboxim_core.config import to_json
from roboxim_core.errors import ConfigError
from roboxim_policies.bc.config import BCConfig
from roboxim_policies.learning.augment import PATCH_RADII, SHADOW, augmentation, kept_words, seen, without_augmentation
from roboxim_policies.learning.config import RANGES
from roboxim_policies.learning.families import FAMILIES, config_class
from roboxim_policies.learning.train import Trainer
from roboxim_policies.rt1s.config import RT1SConfig

STILL = BCConfig(brightness=0.0)
SIDE, COUNT = 48, 64
RNG = np.random.default_rng(0)
PICTURES = RNG.uniform(size=(COUNT, SIDE, SIDE, 3)).astype(np.float32)


def shown(step: int = 0, base: BCConfig = STILL, **changes) -> np.ndarray:
    """Return the pictures as a training step shows them, in 0..1."""
    config = replace(base, **changes)
    draws = augmentation(config, ("workspace",), step, COUNT)
    return np.asarray(seen(jnp.asarray(PICTURES), "workspace", draws, config)) + 0.5


def test_without_augmentation_a_picture_is_shown_as_it_is():
    assert shown() == pytest.approx(PICTURES, abs=1e-6)
    changed = replace(STILL, color_mix=0.5, overlay=0.5, patches=3, word_dropout=0.5, shift_px=2)
    assert without_augmentation(changed) == without_augmentation(STILL)


def test_a_patch_has_one_hue_and_a_shadow_and_changes_nothing_beside_them():
    share = (np.abs(shown(patches=3) - PICTURES).max(-1) > 1e-6).mean((1, 2))
    assert (share == 0).sum() in range(3, 40), "about a quarter of the pictures have none"
    assert 0.01 < share.mean() < 0.1
    one = shown(patches=1)
    found = 0
    for changed, picture in zip(one, PICTURES, strict=True):
        shadow = np.abs(changed - SHADOW * picture).max(-1) < 1e-6
        patch = (np.abs(changed - picture).max(-1) > 1e-6) & ~shadow
        hues = changed[patch] / np.linalg.norm(changed[patch], axis=1, keepdims=True)
        assert np.abs(hues - hues[:1]).max(initial=0.0) < 1e-4
        assert patch.mean() < np.pi * max(PATCH_RADII) ** 2 + 0.01
        found += patch.any() and shadow.any()
    assert found > 10
    assert not np.array_equal(one, shown(1, patches=1)), "each step draws anew"
    assert np.array_equal(one, shown(patches=1)), "a step is drawn again as it was"


def test_an_overlay_is_smooth_and_no_heavier_than_configured():
    added = shown(overlay=0.4) - PICTURES
    weight = 1 - np.array([np.polyfit(p.ravel(), (p + a).ravel(), 1)[0] for p, a in zip(PICTURES, added, strict=True)])
    assert weight.min() < 0.05
    assert 0.3 < weight.max() < 0.43
    field = added + weight[:, None, None, None] * PICTURES  # weight times the field
    assert np.abs(np.diff(field, axis=1)).max() < 0.4 / 6 + 0.02


def test_mixed_colours_are_a_linear_map_of_the_recorded_ones():
    mixed = shown(color_mix=0.3)
    for after, before in zip(mixed[:8], PICTURES[:8], strict=True):
        inside = ((after > 1e-6) & (after < 1 - 1e-6)).all(-1)
        inputs = np.column_stack([before[inside], np.ones(inside.sum())])
        found, *_ = np.linalg.lstsq(inputs, after[inside], rcond=None)
        assert inputs @ found == pytest.approx(after[inside], abs=1e-4)
        assert np.abs(found[:3] - np.eye(3)).max() < 0.15 + 1e-3


def test_frames_of_one_window_have_one_look():
    config = RT1SConfig(history=3, patches=2, overlay=0.5, color_mix=0.5)
    draws = augmentation(config, ("workspace",), 0, 12)
    for name in ("mix", "cast", "overlay", "weight", "patch/center", "patch/color"):
        windows = np.asarray(draws[f"workspace/{name}"]).reshape(4, 3, -1)
        assert (windows == windows[:, :1]).all(), name
        assert not (windows[0] == windows[1]).all(), name


def test_words_are_left_out_as_often_as_configured():
    assert kept_words(STILL, 0, (500, 4)) == {}
    kept = kept_words(replace(STILL, word_dropout=0.3), 0, (500, 4))["words"]
    assert 0.65 < np.asarray(kept).mean() < 0.75


def test_trainings_without_augmentation_keep_their_identity():
    names = ("color_mix", "overlay", "patches", "word_dropout")
    assert not any(name in to_json(config()) for name in names for config in (BCConfig, RT1SConfig))
    assert all(name in to_json(BCConfig(**{name: 1 if name == "patches" else 0.5})) for name in names)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"overlay": 1.1}, "overlay must be 0..1, got 1.1"), ({"word_dropout": -0.1}, "word_dropout must be 0..1"),
        ({"color_mix": 1.1}, "color_mix must be 0..1"), ({"patches": 33}, "patches must be 0..32"),
        ({"shift_px": -1}, "shift_px must be 0..64"), ({"seed": -1}, "seed must be 0..4294967295, got -1"),
        ({"retry": 7.0}, "retry must be 0..1"), ({"weight_decay": -5.0}, "weight_decay must be 0..1"),
        ({"image_sizes": {}}, "image_sizes must name at least one camera"),
        ({"brightness": -3.0}, "brightness must be 0..1"), ({"steps": 0}, "steps must be >= 1, got 0"),
    ],
)  # fmt: skip
def test_a_strength_out_of_range_is_named(changes, said):
    with pytest.raises(ConfigError, match=said):
        BCConfig(**changes)


@pytest.mark.parametrize("family", FAMILIES)
def test_every_number_of_a_family_has_a_range(family):
    checked = {"ema_decay", "film", "image_sizes", "learning_rate", "wordings"}
    assert {field.name for field in fields(config_class(family))} <= RANGES.keys() | checked


def poisoned(trainer: Trainer) -> Trainer:
    (weights, *others), step, chosen = trainer._at
    trainer._at = (weights * np.inf, *others), step, chosen
    return trainer


@pytest.mark.thorough
def test_a_training_that_diverges_says_so_and_keeps_the_checkpoint_before(tmp_path):
    checkpoint = Trainer(data(), CONFIG, tmp_path / "old").run(until=4)
    before = checkpoint.read_bytes()
    said = "has diverged: the loss or .* not finite at step 10; .* is as it was after an earlier step.*below 0.003"
    with pytest.raises(ConfigError, match=said):
        poisoned(Trainer(data(), CONFIG, tmp_path / "old")).run()
    assert checkpoint.read_bytes() == before
    with pytest.raises(ConfigError, match="at step 10; no checkpoint was written"):
        poisoned(Trainer(data(), CONFIG, tmp_path / "new")).run()
    assert not (tmp_path / "new").exists()


def test_a_family_that_reads_sentences_refuses_to_leave_out_words():
    with pytest.raises(ConfigError, match="word_dropout must be 0: this family reads whole sentences"):
        RT1SConfig(word_dropout=0.1)


@pytest.mark.thorough
def test_the_first_batch_shows_samples_before_and_after_augmentation(tmp_path):
    recorded = {tuple(image.ravel()) for image in data().images["workspace"]}
    still = Trainer(data(), replace(CONFIG, brightness=0.0), tmp_path / "still").first_batch(6)
    patched = Trainer(data(), replace(CONFIG, brightness=0.0, patches=8), tmp_path / "patched").first_batch(6)
    before, after = (np.asarray(each) for each in still["workspace"])
    assert before.shape == (6, 32, 32, 3)
    assert {tuple((255 * each).round().astype(np.uint8).ravel()) for each in before} <= recorded
    assert after == pytest.approx(before, abs=1e-6)
    assert np.array_equal(np.asarray(patched["workspace"][0]), before)
    assert np.abs(np.asarray(patched["workspace"][1]) - before).max() > 0.1
    assert not (tmp_path / "still").exists()
