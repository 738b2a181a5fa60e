"""Stores: what is uploaded is whole and checked, and everything reads from it; `make scale` installs what it needs."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest
from mcap.writer import MCAP0_MAGIC

from roboxim_core.config import to_plain
from roboxim_core.episode import EpisodeResult, RunConfig
from roboxim_core.errors import ConfigError, RecorderError, UnavailableError
from roboxim_core.shards import Shard
from roboxim_runs.episodes.run import EpisodesJob, run_episodes
from roboxim_runs.executors import Done
from roboxim_runs.storage import store as stores
from roboxim_runs.storage.folder import RunFolder
from roboxim_runs.storage.merging import merge_shards
from roboxim_runs.storage.store import Store, local_sources, note_stored, readable_run, stored_bags, upload_dataset
from roboxim_runs.storage.upload import RunUpload


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
            (bag / "x_0.mcap").write_bytes(f"recording {index}".encode() + MCAP0_MAGIC)
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
        assert (folder / result(2).bag / "x_0.mcap").read_bytes() == b"recording 2" + MCAP0_MAGIC
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
        assert (folder / result(3).bag / "x_0.mcap").read_bytes() == b"recording 3" + MCAP0_MAGIC


def test_a_dataset_is_uploaded_with_its_checksums(url, tmp_path):
    (tmp_path / "dataset" / "data").mkdir(parents=True)
    (tmp_path / "dataset" / "data" / "x").write_text("1")
    (tmp_path / "dataset" / "info.json").write_text("{}")
    assert upload_dataset(tmp_path / "dataset", url) == 2
    with local_sources([url]) as [folder]:
        assert {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()} == {
            "data/x", "info.json", "SHA256SUMS",
        }  # fmt: skip
    (tmp_path / "other").write_text("[]")
    with Store.opened(url) as store:
        store.put(tmp_path / "other", "info.json")
    with pytest.raises(RecorderError, match=r"info.json is missing, or not the file"), local_sources([url]):
        pass


def test_a_dataset_replaces_no_other_one(url, tmp_path):
    (tmp_path / "dataset").mkdir()
    (tmp_path / "dataset" / "info.json").write_text("{}")
    for _ in range(2):  # as after an upload that was stopped
        assert upload_dataset(tmp_path / "dataset", url) == 1
    (tmp_path / "dataset" / "info.json").write_text("[]")
    with pytest.raises(ConfigError, match="has another dataset; --overwrite"):
        upload_dataset(tmp_path / "dataset", url)
    upload_dataset(tmp_path / "dataset", url, overwrite=True)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "data").write_text("1")
    with pytest.raises(ConfigError, match=r"has 1 file not of .*/other, e.g. info.json"):
        upload_dataset(tmp_path / "other", url, overwrite=True)
    with local_sources([url]) as [folder]:
        assert (folder / "info.json").read_text() == "[]"


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
    with pytest.raises(ConfigError, match=r"stored.jsonl line 1 is not a stored bag; .*--repair"):
        stored_bags(tmp_path)


def test_a_torn_line_of_the_list_of_stored_bags_blocks_no_run(tmp_path):
    note_stored(tmp_path, {"episodes/a": {}})
    with Path(tmp_path, "stored.jsonl").open("a") as file:
        file.write('{"bag": "episodes/b", "fi')
    note_stored(tmp_path, {"episodes/c": {}})
    assert list(stored_bags(tmp_path)) == ["episodes/a", "episodes/c"]


class Uploading:
    """An executor whose workers upload the bags."""

    def __init__(self):
        self.asked = []

    def run(self, work, jobs, **_):
        for job in jobs:
            self.asked.append(job.data)
            with Store.opened(work.settings["staging"]["store"]) as store:
                bag = Path(work.settings["config"]["output_dir"]).parent / "made" / result(job.data).bag
                bag.mkdir(parents=True, exist_ok=True)
                text = f"recording {job.data} of seed {work.settings['config']['run_seed']}"
                (bag / "x_0.mcap").write_bytes(text.encode() + MCAP0_MAGIC)
                stored = {result(job.data).bag: store.put_folder(bag, result(job.data).bag)}
            yield Done(key=job.key, value={"result": to_plain(result(job.data)), "stored": stored})


def run_into(url, folder, *, seed=0, repair=False, shard="", **changes):
    """Run three episodes; return the indices that were run."""
    executor = Uploading()
    config = RunConfig(output_dir=str(folder), run_seed=seed)
    job = EpisodesJob(config=config, episodes=3, store=url, shard=Shard.parse(shard), **changes)
    run_episodes(job, "", {}, executor=executor, repair=repair)
    return executor.asked


def test_a_store_belongs_to_one_run(url, tmp_path):
    run_into(url, tmp_path / "a")
    with pytest.raises(ConfigError, match=r"holds another run \(run_seed: 0 stored, 1 requested\).* another --store"):
        run_into(url, tmp_path / "b", seed=1)
    with pytest.raises(ConfigError, match=r"holds 3 bags of this run that .*/c does not know: .*copy run.json"):
        run_into(url, tmp_path / "c")
    with local_sources([url]) as [folder]:
        assert (folder / result(2).bag / "x_0.mcap").read_bytes() == b"recording 2 of seed 0" + MCAP0_MAGIC
    assert run_into(url, tmp_path / "a") == [], "the run itself continues"
    assert run_into(url, tmp_path / "c", repair=True) == [0, 1, 2]


def test_shards_of_two_runs_share_no_store(url, tmp_path):
    assert run_into(url, tmp_path / "a1", shard="1/2") + run_into(url, tmp_path / "a2", shard="2/2") == [0, 2, 1]
    with pytest.raises(ConfigError, match="holds another run"):
        run_into(url, tmp_path / "b", seed=1, shard="3/3")
    merge_shards(tmp_path / "a", [tmp_path / "a1", tmp_path / "a2"])
    assert run_into(url, tmp_path / "a") == []


def test_a_damaged_bag_of_shards_that_are_not_merged_is_named(tmp_path):
    pytest.importorskip("fsspec")
    url = f"file://{tmp_path}/store"
    run_into(url, tmp_path / "a1", shard="1/2")
    run_into(url, tmp_path / "a2", shard="2/2")
    with local_sources([url]) as [folder]:
        assert len(list(folder.glob("**/x_0.mcap"))) == 3
    (tmp_path / "store" / result(1).bag / "x_0.mcap").write_bytes(b"another" + MCAP0_MAGIC)
    named = rf"{result(1).bag}/x_0.mcap is not the file that was stored"
    with pytest.raises(RecorderError, match=named), local_sources([url]):
        pass


def test_a_run_that_has_bags_in_a_store_keeps_it(tmp_path):
    pytest.importorskip("fsspec")
    run_into(f"file://{tmp_path}/store", tmp_path / "a")
    with pytest.raises(ConfigError, match=r"the bags of .*/a are in the store 'file://.*/store', not in 'file://.*/2'"):
        run_into(f"file://{tmp_path}/2", tmp_path / "a")


def test_a_last_upload_that_failed_is_repeated(tmp_path, monkeypatch):
    pytest.importorskip("fsspec")
    url = f"file://{tmp_path}/store"
    uploads, every = [], RunUpload.all

    def second_fails(upload):
        uploads.append(upload)
        if len(uploads) == 2:
            raise UnavailableError("the store is away")
        every(upload)

    monkeypatch.setattr(RunUpload, "all", second_fails)
    with pytest.raises(UnavailableError):
        run_into(url, tmp_path / "a")
    assert run_into(url, tmp_path / "a") == [], "all of its episodes are done"
    with local_sources([url]) as [folder]:
        assert len(RunFolder(folder).results()) == 3


def test_repair_repeats_the_episodes_of_damaged_lines_of_stored_bags(tmp_path):
    pytest.importorskip("fsspec")
    url = f"file://{tmp_path}/store"
    run_into(url, tmp_path / "a")
    stored = tmp_path / "a" / "stored.jsonl"
    first, _, last = stored.read_text().splitlines(keepends=True)
    stored.write_text(f"{first}garbage\n{last}")
    with pytest.raises(ConfigError, match=r"stored.jsonl line 2 .*--repair"):
        run_into(url, tmp_path / "a")
    assert run_into(url, tmp_path / "a", repair=True) == [1]
    assert run_into(url, tmp_path / "a") == []
