"""The user's folder, ``~``, in the paths of calls that no shell has expanded."""

from pathlib import Path

import pytest

from roboxim_core.errors import RoboximError
from roboxim_eval.answers.halving import HalvingConfig
from roboxim_policies.bc.config import BCConfig
from roboxim_policies.builtin import ReplayPolicy
from roboxim_runs.datasets.audit import audit_dataset
from roboxim_runs.datasets.corruption import corrupt
from roboxim_runs.datasets.export import export_dataset
from roboxim_runs.datasets.rewriting import convert_dataset
from roboxim_runs.episodes.rerendering import RerenderConfig, rerender
from roboxim_runs.evaluation import sweeping
from roboxim_runs.evaluation.run import EvaluationConfig, evaluate
from roboxim_runs.policies.specs import PolicySpec
from roboxim_runs.storage.folder import checked_path
from roboxim_runs.training import pretraining
from roboxim_runs.training.pretraining import PretrainConfig
from roboxim_runs.training.run import train_policy


@pytest.mark.parametrize(
    "call",
    [
        lambda path, out: export_dataset("rlds", path, out),
        lambda path, out: train_policy(path, out, BCConfig(steps=1)),
        lambda path, out: train_policy(path, out, start=path),
        lambda path, out: corrupt(path, out, "duplicate", 0.5),
        lambda path, out: convert_dataset(path, out, "hdf5"),
        lambda path, out: audit_dataset(path, out),
        lambda path, out: rerender(path, out, RerenderConfig()),
        lambda path, out: ReplayPolicy(path),
        lambda path, out: evaluate(
            EvaluationConfig(policies=PolicySpec(spec="bc", options={"checkpoint": path}), out=out)
        ),
    ],
)
def test_it_is_the_users_folder_and_no_folder_of_that_name(call, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RoboximError, match=f"{tmp_path}/missing"):
        call("~/missing", "~/out")
    assert not (tmp_path / "~").exists()
    assert checked_path("~/out") == tmp_path / "out"
    assert EvaluationConfig(policies="zero", out="~/out").out == tmp_path / "out"
    assert PretrainConfig(learning=BCConfig(), out="~").checkpoint_name == tmp_path.name


def _pretrain(out):
    pretraining.pretrain(PretrainConfig(learning=BCConfig(), out=out, episodes=1))


def _sweep(out):
    policies = [PolicySpec(spec="zero", name=name) for name in "ab"]
    sweeping.sweep(policies, EvaluationConfig(policies="zero", out=out), HalvingConfig())


@pytest.mark.parametrize(("call", "part"), [(_pretrain, "generate"), (_sweep, "evaluate")])
def test_the_parts_of_longer_runs_are_in_it(call, part, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)

    def made(config, **_):
        assert Path(config.out).parent == tmp_path / "out"
        raise RoboximError("enough")

    monkeypatch.setattr(pretraining if call is _pretrain else sweeping, part, made)
    with pytest.raises(RoboximError, match="enough"):
        call("~/out")


def test_an_export_names_its_dataset_as_it_was_given(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("roboxim_runs.datasets.export.export_bags", lambda form, sources, place, *_, **__: place)
    assert export_dataset("rlds", "runs/demos", "data/octo") == Path("data/octo"), "the command prints it"
