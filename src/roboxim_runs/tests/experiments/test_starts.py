"""Checkpoints that trainings of an experiment begin with: found, required, and stated on the card as they are."""

import json
from dataclasses import replace

import numpy as np
import pytest

from roboxim_core.errors import ConfigError
from roboxim_core.proprioception import STATE_NAMES
from roboxim_eval.experiments.card import Attestation
from roboxim_policies.learning.checkpoint_file import FORMAT
from roboxim_runs.experiments.files import checked_design, load_experiment
from roboxim_runs.experiments.trained.starts import require_start, start_digests, start_of, with_start

OLD = Attestation(pretraining="octo", exposure="yes", recipe={"command": "roboxim train act"})
BROAD = {"skills": {"pick_up": 9}, "objects": {"cube": 9}, "pairs": {"pick_up cube": 9}, "pairs_of": "target"}


@pytest.fixture(scope="module")
def design():
    return checked_design("pretraining", load_experiment("pretraining", "laptop"))


def written(path, **description):
    content = {"format": FORMAT, "state_layout": list(STATE_NAMES), "digest": "abc", **description}
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, said=np.array(json.dumps(content)))
    return path


def stated(design, folder):
    found = with_start(OLD, design, folder)
    assert found.recipe == OLD.recipe
    return found.pretraining, found.exposure


def started(folder, pairs=None, **content):
    before = {"name": "broad", "exposure": {**BROAD, "pairs": pairs or BROAD["pairs"], **content}}
    written(folder / "checkpoint.npz", started_from={"digest": "abc", "step": 5, "pretraining": before})
    return folder


def test_a_start_is_found_in_the_arguments_of_own_trainers_alone(design):
    assert str(start_of(design, '--set a=1 --from "my runs/broad.npz"')) == "my runs/broad.npz"
    assert str(start_of(design, "--from=broad.npz")) == "broad.npz"
    assert start_of(design, "--set feature_dropout=1") is None
    for wrong in ("--from", '--from "broad.npz'):
        with pytest.raises(ConfigError, match="arguments of a training"):
            start_of(design, wrong)
    other = replace(design, trainer=replace(design.trainer, command="sh train.sh {dataset} {out} {seed}"))
    assert start_of(other, "--from broad.npz") is None


def test_a_missing_start_is_refused_before_anything_runs(design, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert start_digests(design) == {f"pretrained.{number}": "" for number in range(3)}
    require_start(design, "imagenet.0")
    with pytest.raises(ConfigError, match=r"conditions.pretrained: .*runs/pretrain/pretrain.npz.*roboxim pretrain"):
        require_start(design, "pretrained.0")
    written(tmp_path / "runs/pretrain/pretrain.npz")
    require_start(design, "pretrained.0")
    assert start_digests(design)["pretrained.2"] == "abc", "so that another pre-training is another input"


def test_random_weights_have_seen_nothing(design, tmp_path):
    written(tmp_path / "checkpoint.npz")
    assert stated(design, tmp_path) == ("none", "no")
    assert with_start(OLD, design, tmp_path / "elsewhere") == OLD, "what is attested holds"


@pytest.mark.parametrize(
    ("pairs", "content", "exposure"),
    [
        ({"pick_up soda_can": 9, "place_on cube": 9}, {}, "no"),
        ({"place_on soda_can": 1}, {}, "yes"),
        ({"pick_up+place_on cube": 3}, {"skills": {"pick_up+place_on": 3}, "objects": {"soda_can": 3}}, "unknown"),
        ({"pick_up+place_on cube": 3}, {"skills": {"pick_up+place_on": 3}, "objects": {"cube": 3}}, "no"),
    ],
)
def test_exposure_is_computed_from_what_was_demonstrated(design, tmp_path, pairs, content, exposure):
    assert stated(design, started(tmp_path, pairs, **content)) == ("broad, weights abc", exposure)


def test_a_start_of_unknown_content_is_unknown(design, tmp_path):
    written(tmp_path / "checkpoint.npz", started_from={"digest": "abc", "step": 5})
    assert stated(design, tmp_path) == ("weights abc", "unknown")


def test_the_same_pair_with_another_camera_may_be_another_cell(tmp_path):
    design = checked_design("camera_object", load_experiment("camera_object", "laptop"))
    known = start_of(design, "--from broad.npz")
    assert known is not None
    pairs = {f"pick_up {model}": 1 for model in design.config.factors["target"]}
    assert stated(design, started(tmp_path, pairs))[1] == "unknown"
    assert stated(design, started(tmp_path, {"place_on cube": 1}))[1] == "no"


def test_counts_of_an_earlier_version_say_nothing(design, tmp_path):
    assert stated(design, started(tmp_path, pairs_of=""))[1] == "unknown", "they named the plate of place_on"
