"""Archives of arrays that unpack to far more than they weigh are refused before memory is taken."""

from __future__ import annotations

import contextlib
import zipfile
from pathlib import Path

import numpy as np
import pytest
from traced_memory import peak_below

from roboxim_core.errors import ConfigError
from roboxim_policies.learning import checkpoint_file
from roboxim_policies.learning.checkpoint_file import read_description
from roboxim_policies.recorded_actions import load_actions


def bomb(file: Path, name: str, values: np.ndarray) -> Path:
    np.savez_compressed(file, **{name: values})
    return file


def test_a_compressed_archive_is_refused_by_its_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoint_file, "MAX_UNPACKED", 2**20)
    actions = bomb(tmp_path / "actions.npz", "actions", np.zeros((2**21, 7), np.float32))
    checkpoint = bomb(tmp_path / "checkpoint.npz", "said", np.array("x" * 2**21))
    assert actions.stat().st_size < 2**17
    with peak_below(2**20):
        with pytest.raises(
            ConfigError, match=r"not a readable .npz: 'actions.npy' has \d+ bytes and unpacks to 58720384"
        ):
            load_actions(actions)
        with pytest.raises(ConfigError, match=r"not a readable checkpoint: 'said.npy' has \d+ bytes and unpacks to"):
            read_description(checkpoint)


def test_pickles_and_files_that_are_no_archive_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "objects.npz", actions=np.array([{}], object))
    np.save(tmp_path / "single.npz.npy", np.zeros((3, 7)))
    (tmp_path / "single.npz.npy").rename(tmp_path / "single.npz")
    with zipfile.ZipFile(tmp_path / "text.npz", "w") as archive:
        archive.writestr("actions.npy", b"no array")
    (tmp_path / "ragged.json").write_text("[[1, 2, 3], [4]]")
    (tmp_path / "one.json").write_text("7")
    for name in ("objects.npz", "single.npz", "text.npz", "ragged.json", "one.json"):
        with pytest.raises(ConfigError, match=name):
            load_actions(tmp_path / name)


def test_whatever_bytes_are_damaged_the_file_is_named(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "whole.npz", actions=np.zeros((5, 7), np.float32), said=np.array('{"format": 6}'))
        whole = np.frombuffer((tmp_path / "whole.npz").read_bytes(), np.uint8)
        for _ in range(300):
            damaged = whole[: rng.choice([len(whole), rng.integers(len(whole))])].copy()
            damaged[rng.integers(len(damaged), size=2) if len(damaged) else []] = rng.integers(256)
            (tmp_path / "damaged.npz").write_bytes(damaged.tobytes())
            for read in (load_actions, read_description):
                with contextlib.suppress(ConfigError):  # where nothing was damaged that is read
                    read(tmp_path / "damaged.npz")


def test_an_ordinary_archive_of_actions_is_read(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "actions.npz", actions=np.zeros((5, 7), np.float32))
    actions, _ = load_actions(tmp_path / "actions.npz")
    assert actions.shape == (5, 7)


def test_an_archive_of_something_else_is_said_to_be_no_checkpoint(tmp_path):
    np.savez(tmp_path / "checkpoint.npz", weights=np.zeros(3))
    with pytest.raises(ConfigError, match=r"checkpoint.npz is no checkpoint of a policy; give what 'roboxim train'"):
        read_description(tmp_path)
