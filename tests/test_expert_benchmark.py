"""The expert's benchmark: storage and resumption of a long run, and the figures of an episode."""

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module", autouse=True)
def _benchmarks_importable():
    sys.path.insert(0, str(ROOT))
    yield
    sys.path.remove(str(ROOT))


def test_a_run_continues_only_with_its_code_and_configuration(tmp_path, monkeypatch):
    from benchmarks.expert import _kept

    folder = tmp_path / "run"
    _kept.Kept(folder, {"a": "skill: pick_up"}).add([{"cell": "a", "index": 0}])
    again = _kept.Kept(folder, {"a": "skill: pick_up", "b": "skill: rotate"})
    again.add([{"cell": "b", "index": 3}])
    assert again.load() == {"a": [{"cell": "a", "index": 0}], "b": [{"cell": "b", "index": 3}]}
    with pytest.raises(SystemExit, match="another configuration of b: set --out to a new folder"):
        _kept.Kept(folder, {"a": "skill: pick_up", "b": "skill: stack"})
    with pytest.raises(SystemExit, match="another configuration of a"):
        _kept.Kept(folder, {"a": "skill: stack"})
    monkeypatch.setattr(_kept, "code_digest", lambda: "0123")
    with pytest.raises(SystemExit, match="of other code .*new folder"):
        _kept.Kept(folder, {"a": "skill: pick_up"})
    (folder / "made_by.json").unlink()
    with pytest.raises(SystemExit, match="commit unknown"):
        _kept.Kept(folder, {"a": "skill: pick_up"})


def test_the_code_digest_depends_on_the_files(tmp_path, monkeypatch):
    from benchmarks.expert import _kept

    monkeypatch.setattr(_kept, "PACKAGES", ())
    monkeypatch.setattr(_kept, "config_dirs", lambda: (tmp_path,))
    (tmp_path / "objects").mkdir()
    (tmp_path / "objects" / "cube.yaml").write_text("mass: 1")
    first = _kept.code_digest()
    (tmp_path / "README.md").write_text("words")
    assert _kept.code_digest() == first
    (tmp_path / "objects" / "cube.yaml").write_text("mass: 2")
    assert _kept.code_digest() != first


@pytest.mark.thorough
def test_an_episodes_figures_are_those_of_its_settled_scene():
    from benchmarks.expert._cells import cells
    from benchmarks.expert._expert_run import ChunkWorker

    cell = next(cell for cell in cells(3) if cell.name == "pick_up/apple/3")
    job = {"cell": cell.name, "config": cell.config(), "indices": [2], "replayed": [2]}
    (near,) = ChunkWorker(None, 0).run(job, lambda _: None)
    assert near["first_try"]
    assert near["replayed"]
    assert near["disturbed"] == 0
    assert near["seen_share"] >= 0.5
    assert 40 <= near["seen_px"] <= 400  # an apple of 7 cm, a metre away, in a picture of 128 x 128
    assert near["draws"] == 1 + sum(near["rejections"].values())
