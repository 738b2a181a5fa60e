"""`roboxim upgrade-check`: the readers' verdicts on what a folder holds."""

import json
import shutil
from pathlib import Path

import pytest

from roboxim_core.errors import ConfigError
from roboxim_runs.storage.compatibility import examine

RESULTS = Path(__file__).parents[4] / "docs" / "results"


def test_published_cards_are_read() -> None:
    findings = list(examine(RESULTS))
    assert len(findings) == len(list(RESULTS.rglob("card.json")))
    assert all(finding.readable for finding in findings), [finding.detail for finding in findings]


def test_what_is_not_read_is_named_with_its_reason(tmp_path: Path) -> None:
    card = json.loads((RESULTS / "transfer-night" / "card.json").read_text())
    (tmp_path / "card.json").write_text(json.dumps(card | {"schema": "benchmark-99"}))
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "torn.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").write_text("{")
    (tmp_path / "bc").mkdir()
    (tmp_path / "bc" / "checkpoint.npz").write_bytes(b"PK")
    found = {finding.kind: finding for finding in examine(tmp_path)}
    assert {kind: finding.readable for kind, finding in found.items()} == {
        "run": False, "bag": False, "card": False, "checkpoint": False,
    }  # fmt: skip
    assert "benchmark-99" in found["card"].detail
    assert "damaged" in found["bag"].detail


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    shutil.copy(__file__, tmp_path)
    with pytest.raises(ConfigError, match="holds no run, bag, card or checkpoint"):
        list(examine(tmp_path))
    with pytest.raises(ConfigError, match="does not exist"):
        list(examine(tmp_path / "absent"))
