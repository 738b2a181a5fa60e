"""Packs that would fill memory or disk are refused first, and nothing of a refused pack stays."""

from __future__ import annotations

import hashlib
import io
import json
import tarfile

import pytest

from roboxim_core.errors import ConfigError
from roboxim_core.whole_files import write_whole
from roboxim_runs.experiments import pack as experiment_pack
from roboxim_runs.experiments.pack import MANIFEST, unpack


def written(file, members):
    with tarfile.open(file, "w:gz") as archive:
        for name, content in members.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            archive.addfile(entry, io.BytesIO(content))
    return file


def manifest(**files):
    return json.dumps({"files": files}).encode()


def test_a_manifest_that_is_too_large_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr(experiment_pack, "LARGEST_MANIFEST", 1000)
    file = written(tmp_path / "pack.tgz", {MANIFEST: manifest() + b" " * 2000})
    with pytest.raises(ConfigError, match="does not begin with a pack.json of at most"):
        unpack(file, tmp_path / "out")
    with pytest.raises(ConfigError, match="does not begin with"):
        unpack(written(tmp_path / "other.tgz", {"a": b"", MANIFEST: manifest()}), tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["other.tgz", "pack.tgz"]


def test_a_bomb_is_refused_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr(experiment_pack, "LARGEST_MANIFEST", 1000)
    zeros = bytes(10_000_000)
    file = written(tmp_path / "pack.tgz", {MANIFEST: manifest(a=hashlib.sha256(zeros).hexdigest()), "a": zeros})
    assert file.stat().st_size < 20_000
    with pytest.raises(ConfigError, match="would unpack to more than .* at 'a'"):
        unpack(file, tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["pack.tgz"]


def test_what_a_refused_pack_wrote_is_removed(tmp_path):
    good = hashlib.sha256(b"good").hexdigest()
    file = written(tmp_path / "pack.tgz", {MANIFEST: manifest(a=good, b=good), "a": b"good", "b": b"evil"})
    with pytest.raises(ConfigError, match="b has a hash that differs"):
        unpack(file, tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["pack.tgz"]
    whole = written(tmp_path / "whole.tgz", {MANIFEST: manifest(a=good), "a": b"good"})
    (tmp_path / "out").mkdir()
    assert unpack(whole, tmp_path / "out").files == 1
    assert (tmp_path / "out" / "a").read_bytes() == b"good"


def test_a_file_that_cannot_be_written_leaves_nothing(tmp_path):
    write_whole(tmp_path / "page.html", "first")
    with pytest.raises(UnicodeEncodeError):
        write_whole(tmp_path / "page.html", "\ud800")
    assert (tmp_path / "page.html").read_text() == "first"
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError, match="directory"):
        write_whole(tmp_path / "folder", b"x")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder", "page.html"]
