"""The user's folder, ``~``, in the paths of calls that no shell has expanded."""

import pytest

from roboxim_core.errors import RoboximError
from roboxim_policies.bc.config import BCConfig
from roboxim_runs.datasets.corruption import corrupt
from roboxim_runs.datasets.export import export_dataset
from roboxim_runs.storage.folder import checked_path
from roboxim_runs.training.run import train_policy


@pytest.mark.parametrize(
    "call",
    [
        lambda path, out: export_dataset("rlds", path, out),
        lambda path, out: train_policy(path, out, BCConfig(steps=1)),
        lambda path, out: corrupt(path, out, "duplicate", 0.5),
    ],
)
def test_it_is_the_users_folder_and_no_folder_of_that_name(call, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RoboximError, match=f"{tmp_path}/missing"):
        call("~/missing", "~/out")
    assert not (tmp_path / "~").exists()
    assert checked_path("~/out") == tmp_path / "out"
