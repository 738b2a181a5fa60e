"""A run whose bags are in a store is the run; datasets made from the store are those made from the folder."""

from __future__ import annotations

import hashlib
from contextlib import ExitStack, contextmanager

import pytest
from click.testing import CliRunner
from planted_runs import recordings, repeatable_results

from roboxim_cli.main import group
from roboxim_core.errors import UnavailableError
from roboxim_runs.episodes.generation import GenerationConfig, generate
from roboxim_runs.events import EpisodeFinished
from roboxim_runs.storage.store import local_sources

pytestmark = [pytest.mark.ros, pytest.mark.slow]

SMALL = {"size": 32, "renderer": "tiny", "workers": 1, "episodes": 2}


def test_bags_in_a_store_are_those_of_a_folder_and_export_alike(tmp_path):
    pytest.importorskip("fsspec")
    url = f"file://{tmp_path}/store"
    generate(GenerationConfig(out=tmp_path / "whole", **SMALL))
    stored = generate(GenerationConfig(out=tmp_path / "out", store=url, **SMALL))
    assert stored.picture is not None
    assert not list((tmp_path / "out").rglob("*.mcap"))
    with local_sources([url]) as [folder]:
        assert recordings(folder) == recordings(tmp_path / "whole")
        assert repeatable_results(folder) == repeatable_results(tmp_path / "whole")
    assert generate(GenerationConfig(out=tmp_path / "out", store=url, **SMALL)).summary.endswith("nothing was run")
    files = []
    for source in (str(tmp_path / "whole"), url, str(tmp_path / "out")):
        words = ["export", "rlds", source, "--out", str(tmp_path / f"rlds-{len(files)}")]
        CliRunner().invoke(group, words, standalone_mode=False, catch_exceptions=False)
        dataset = tmp_path / f"rlds-{len(files)}"
        files.append(
            {
                path.name: hashlib.sha256(path.read_bytes()).hexdigest()
                for path in dataset.rglob("*tfrecord*")
                if path.is_file()
            }
        )
    assert files[0]
    assert files[0] == files[1] == files[2]


@contextmanager
def s3_server(port=0):
    """Serve S3 on this machine and yield the port; what it holds outlives it."""
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=port, verbose=False)
    server.start()
    try:
        yield server.get_host_and_port()[1]
    finally:
        server.stop()


def test_a_run_whose_store_is_lost_is_continued_by_the_same_call(tmp_path, monkeypatch):
    s3fs = pytest.importorskip("s3fs")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "x")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    url, ended = "s3://lost/demos", []
    config = GenerationConfig(out=tmp_path / "out", store=url, **{**SMALL, "episodes": 4})

    def lose(event):
        if isinstance(event, EpisodeFinished) and not ended:
            ended.append(event.result.index)
            stopping.close()

    with ExitStack() as stopping:
        port = stopping.enter_context(s3_server())
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{port}")
        s3fs.S3FileSystem(skip_instance_cache=True).mkdir("lost")
        with pytest.raises(UnavailableError, match="the same command continues when the store can be reached"):
            generate(config, on_event=lose)
    with s3_server(port):
        generate(config)
        generate(GenerationConfig(out=tmp_path / "whole", **{**SMALL, "episodes": 4}))
        with local_sources([url]) as [folder]:
            assert recordings(folder) == recordings(tmp_path / "whole")
            assert repeatable_results(folder) == repeatable_results(tmp_path / "whole")
