"""A run whose bags are in a store is the run; datasets made from the store are those made from the folder."""

from __future__ import annotations

import hashlib

import pytest
from click.testing import CliRunner

from roboxim_bringup.cli import group
from roboxim_bringup.runs.generation import GenerationConfig, generate
from roboxim_bringup.runs.store import local_sources
from roboxim_bringup.testing import recordings, repeatable_results

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
        words = ["export", "rlds", source, str(tmp_path / f"rlds-{len(files)}")]
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
