"""The contents of its files identify a policy."""

from __future__ import annotations

import sys

import pytest

from roboxim_policies import identity
from roboxim_policies.base import find_policy

POLICY = """
import numpy as np

import helper
from net import layers
from roboxim_policies import BasePolicy


class Mine(BasePolicy):
    def __init__(self, checkpoint="", kind=""):
        pass

    def act(self, window):
        from late import action
        return action
"""


def policy_files(spec, options, **more):
    return identity.policy_files(spec, find_policy(spec), options, **more)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])  # the working directory is added to it
    (tmp_path / "mine.py").write_text(POLICY)
    (tmp_path / "helper.py").write_text("import deeper\n")
    (tmp_path / "deeper.py").write_text("")
    (tmp_path / "late.py").write_text("action = [0.0] * 7\n")
    (tmp_path / "unrelated.py").write_text("")
    (tmp_path / "net").mkdir()
    (tmp_path / "net" / "__init__.py").write_text("")
    (tmp_path / "net" / "layers.py").write_text("from . import parts\n")
    (tmp_path / "net" / "parts.py").write_text("")
    return tmp_path


OWN = {"mine.py", "helper.py", "deeper.py", "late.py", "net/__init__.py", "net/layers.py", "net/parts.py"}


def test_a_policys_own_file_and_what_it_imports_beside_it(folder):
    before = policy_files("mine.py:Mine", {})
    assert set(before) == OWN
    assert policy_files("mine.py:Mine", {}) == before
    (folder / "deeper.py").write_text("x = 1\n")
    (folder / "unrelated.py").write_text("x = 1\n")
    after = policy_files("mine.py:Mine", {})
    assert {name for name in OWN if before[name] != after[name]} == {"deeper.py"}


def test_a_file_or_folder_that_an_option_names(folder):
    (folder / "weights").mkdir()
    (folder / "weights" / "a.bin").write_bytes(b"a")
    (folder / "weights" / ".a.bin.tmp").write_bytes(b"half")
    options = {"checkpoint": str(folder / "weights"), "kind": "large"}
    before = policy_files("mine.py:Mine", options)
    assert set(before) == OWN | {"weights"}
    (folder / "weights" / ".a.bin.tmp").write_bytes(b"more")
    (folder / "weights" / "results").mkdir()
    (folder / "weights" / "results" / "run.json").write_bytes(b"{}")
    assert policy_files("mine.py:Mine", options, exclude=folder / "weights" / "results") == before
    (folder / "weights" / "a.bin").write_bytes(b"b")
    assert policy_files("mine.py:Mine", options)["weights"] != before["weights"]
    assert set(policy_files("mine.py:Mine", {"checkpoint": "weights/a.bin"})) == OWN | {"weights/a.bin"}


def test_a_policy_is_the_same_from_every_working_directory(folder, monkeypatch):
    (folder / "weights").mkdir()
    (folder / "weights" / "a.bin").write_bytes(b"a")
    before = policy_files("mine.py:Mine", {"checkpoint": "weights/a.bin"})
    monkeypatch.chdir(folder.parent)
    path = f"{folder.name}/mine.py:Mine"
    assert policy_files(path, {"checkpoint": f"{folder.name}/weights/a.bin"}) == before
    found = identity.location_free("reworded", {"policy": path, "instruction": "Wave"})
    assert found == {"spec": "reworded", "options": {"policy": "mine.py:Mine", "instruction": "Wave"}}
    assert identity.location_free(path, {})["spec"] == "mine.py:Mine"
    assert identity.location_free("module:Mine", {"policy": path}) == {
        "spec": "module:Mine",
        "options": {"policy": path},
    }


def test_two_files_of_one_name_both_count(folder):
    for name in ("x/w/a.bin", "y/w/a.bin"):
        (folder.parent / "far" / name).parent.mkdir(parents=True)
        (folder.parent / "far" / name).write_bytes(name.encode())
    far = str(folder.parent / "far")
    found = policy_files("mine.py:Mine", {"checkpoint": f"{far}/x/w/a.bin", "kind": f"{far}/y/w/a.bin"})
    assert set(found) == OWN | {"w/a.bin", f"{far}/y/w/a.bin"}


def test_of_a_trained_policy_only_the_checkpoint_counts(folder):
    (folder / "bc").mkdir()
    (folder / "bc" / "checkpoint.npz").write_bytes(b"1")
    before = policy_files("bc", {"checkpoint": str(folder / "bc")})
    assert set(before) == {"bc/checkpoint.npz"}
    (folder / "bc" / "notes.txt").write_text("good one")
    assert policy_files("bc", {"checkpoint": "bc/checkpoint.npz"}) == before
    (folder / "bc" / "checkpoint.npz").write_bytes(b"2")
    assert policy_files("bc", {"checkpoint": "bc"}) != before


def test_what_ships_has_no_files(folder):
    assert policy_files("random", {"scale": 0.3}) == {}
    assert policy_files("roboxim_policies.builtin:ZeroPolicy", {}) == {}


def test_an_installed_package_is_followed_no_further_than_itself(tmp_path, monkeypatch):
    site = tmp_path / "lib" / "site-packages"
    (site / "plugin").mkdir(parents=True)
    (site / "plugin" / "__init__.py").write_text("")
    (site / "plugin" / "policy.py").write_text("import heavy\nimport plugin.net\nclass Mine:\n    act = None\n")
    (site / "plugin" / "net.py").write_text("")
    (site / "heavy.py").write_text("")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(site), *sys.path])
    assert set(policy_files("plugin.policy:Mine", {})) == {f"plugin/{n}.py" for n in ("__init__", "policy", "net")}
