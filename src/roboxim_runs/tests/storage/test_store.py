"""Stores: what is uploaded is whole and checked, and everything reads from it; `make scale` installs what it needs."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError, RecorderError, UnavailableError
from roboxim_runs.storage import store as stores
from roboxim_runs.storage.folder import RunFolder
from roboxim_runs.storage.merging import merge_shards
from roboxim_runs.storage.store import RunUpload, Store, local_sources, note_stored, readable_run, upload_dataset


def test_without_the_extra_the_user_is_told_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(ConfigError, match=r"pip install 'roboxim\[store\]'"), Store.opened("s3://x/y"):
        pass


@pytest.fixture(scope="module")
def s3():
    """Serve S3 on this machine."""
    pytest.importorskip("s3fs")
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    _, port = server.get_host_and_port()
    before = dict(os.environ)
    os.environ |= {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}", "AWS_ACCESS_KEY_ID": "x", "AWS_SECRET_ACCESS_KEY": "x",
        "AWS_DEFAULT_REGION": "us-east-1",
    }  # fmt: skip
    import s3fs

    s3fs.S3FileSystem(skip_instance_cache=True).mkdir("bucket")
    yield "s3://bucket"
    os.environ.clear()
    os.environ.update(before)
    server.stop()


@pytest.fixture(params=["file", pytest.param("s3", marks=pytest.mark.slow)])
def url(request, tmp_path):
    """Return an empty place in a store of each kind."""
    pytest.importorskip("fsspec")
    if request.param == "file":
        return f"file://{tmp_path}/store"
    return f"{request.getfixturevalue('s3')}/{tmp_path.name}"


def result(index):
    name = f"eval-0-{index:05d}-0"
    return EpisodeResult(episode_id=name, index=index, outcome="failure", bag=f"episodes/{name}")


def write_run(path, url, indices, shard=""):
    """Make a run whose bags are in the store, as a run with --store does."""
    config = {"purpose": "eval", "episodes": 4, "run_seed": 0, "store": url, **({"shard": shard} if shard else {})}
    with RunFolder(path).opened(config) as folder, Store.opened(url) as store:
        for index in indices:
            bag = path / "made" / result(index).bag
            bag.mkdir(parents=True)
            (bag / "x_0.mcap").write_text(f"recording {index}")
            (bag / "metadata.yaml").write_text(f"metadata {index}")
            note_stored(path, {result(index).bag: store.put_folder(bag, result(index).bag)})
            folder.append(result(index))
    RunUpload(path, url, shard=shard).all()
    return path


def test_a_file_is_there_when_it_is_whole_and_comes_back_equal(url, tmp_path):
    (tmp_path / "a.bin").write_bytes(os.urandom(300_000))
    with Store.opened(url) as store:
        facts = store.put(tmp_path / "a.bin", "deep/a.bin")
        assert store.find() == ["deep/a.bin"], "no partial file stays"
        store.get("deep/a.bin", tmp_path / "b.bin", sha256=facts["sha256"])
        with pytest.raises(RecorderError, match="has no"):
            store.get("deep/c.bin", tmp_path / "c.bin")
    assert (tmp_path / "a.bin").read_bytes() == (tmp_path / "b.bin").read_bytes()
    assert facts["bytes"] == 300_000


def test_a_run_is_read_back_from_its_store(url, tmp_path):
    run = write_run(tmp_path / "run", url, range(4))
    with local_sources([url]) as [folder]:
        assert (folder / result(2).bag / "x_0.mcap").read_text() == "recording 2"
        assert len(RunFolder(folder).results()) == 4
    assert not folder.exists(), "the copies are temporary"
    with local_sources([run]) as [folder]:
        assert (folder / result(2).bag / "metadata.yaml").read_text() == "metadata 2"
    with readable_run(run, [result(1).bag]) as folder:
        assert [path.name for path in folder.rglob("*.mcap")] == ["x_0.mcap"]
    assert RunFolder(run).without_bag(RunFolder(run).results()) == [], "a stored bag is not lost"


def test_a_damaged_object_is_named(url, tmp_path):
    write_run(tmp_path / "run", url, range(4))
    with Store.opened(url) as store:
        (tmp_path / "other").write_text("something else")
        store.put(tmp_path / "other", f"{result(3).bag}/x_0.mcap")
    wanted = r"episodes/eval-0-00003-0/x_0.mcap is not the file that was stored"
    with pytest.raises(RecorderError, match=wanted), local_sources([url]):
        pass


def test_shards_in_a_store_are_merged_without_their_bags(url, tmp_path):
    parts = [write_run(tmp_path / str(i), url, range(i - 1, 4, 2), shard=f"{i}/2") for i in (1, 2)]
    [merged] = merge_shards(tmp_path / "out", parts)
    assert (merged.episodes, merged.missing) == (4, ())
    with local_sources([url]) as [folder]:
        assert [one.index for one in RunFolder(folder).results()] == [0, 1, 2, 3]
        assert (folder / result(3).bag / "x_0.mcap").read_text() == "recording 3"


def test_a_dataset_is_uploaded_with_its_checksums(url, tmp_path):
    (tmp_path / "dataset" / "data").mkdir(parents=True)
    (tmp_path / "dataset" / "data" / "x").write_text("1")
    (tmp_path / "dataset" / "info.json").write_text("{}")
    assert upload_dataset(tmp_path / "dataset", url) == 2
    with local_sources([url]) as [folder]:
        assert {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()} == {
            "data/x", "info.json", "SHA256SUMS",
        }  # fmt: skip


def test_a_lost_connection_is_tried_again_and_then_named(tmp_path, monkeypatch):
    pytest.importorskip("fsspec")
    monkeypatch.setattr(stores, "PAUSE_S", 0.0)
    (tmp_path / "a").write_text("x")
    with Store.opened(f"file://{tmp_path}/store") as store:
        put, tried = store._files.put_file, []

        def broken(*words, until=stores.TRIES - 1):
            tried.append(words)
            if len(tried) < until:
                raise ConnectionResetError("reset by peer")
            put(*words)

        monkeypatch.setattr(store._files, "put_file", broken)
        store.put(tmp_path / "a", "a")
        assert len(tried) == stores.TRIES - 1
        tried.clear()
        monkeypatch.setattr(store._files, "put_file", lambda *words: broken(*words, until=99))
        with pytest.raises(UnavailableError, match=r"cannot upload b at file://.*reset by peer; the same command"):
            store.put(tmp_path / "a", "b")
        assert [path.name for path in (tmp_path / "store").iterdir()] == ["a"]


def test_what_is_no_store_is_refused():
    pytest.importorskip("fsspec")
    for text, complaint in (
        ("runs/demos", "a store is a URL"),
        ("nonsense://x", "not the URL of a store|not installed"),
    ):
        with pytest.raises(ConfigError, match=complaint), Store.opened(text):
            pass


def test_a_damaged_list_of_stored_bags_is_named(tmp_path):
    Path(tmp_path, "stored.jsonl").write_text(json.dumps({"bag": "x"}) + "\n")
    with pytest.raises(ConfigError, match=r"stored.jsonl is damaged"):
        stores.stored_bags(tmp_path)
