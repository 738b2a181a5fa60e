"""The audit's report: self-contained HTML that shows findings, and JSON for programs."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import audited
import pytest

from roboxim_datasets.audit import AuditEpisode, Auditor
from roboxim_datasets.audit.report import AuditReport, Picture, summary_line, write_audit


@pytest.fixture(scope="module")
def report() -> AuditReport:
    auditor = Auditor()
    spiked = audited.arrays(0)["actions"].copy()
    spiked[30, 1] = 1.0
    auditor.add(AuditEpisode(name="<e0>", split="train", episode=audited.episode(actions=spiked)))
    for i in range(1, 5):
        made = audited.episode(i, instruction="" if i == 2 else "Pick up the cube")
        auditor.add(AuditEpisode(name=f"e{i}", split="train", episode=made))
    picture = Picture.of("workspace", 3, audited.arrays(0)["images"]["workspace"][3])
    return AuditReport(
        title="Audit of <b>demos</b>", result=auditor.result(), pictures={("wrong_instruction", 0): [picture]},
        sources={"e2": "runs/demos/e2"}, facts={"episodes": "5"}, versions={"roboxim": "0"},
        command="roboxim dataset audit demos",
    )  # fmt: skip


def test_the_page_is_self_contained_and_escaped(report: AuditReport, tmp_path: Path) -> None:
    page = write_audit(report, tmp_path).read_text()
    assert not re.search(r"(?:src|href)=\"(?!data:|#)", page), "the page refers to another file"
    for word in ("<script", "@import", "url(", "<b>demos</b>"):
        assert word not in page
    for word in ("&lt;e0&gt;", "prefers-color-scheme: dark", "width=device-width"):
        assert word in page
    assert 'src="data:image/webp;base64,' in page
    assert "runs/demos/e2" in page


def test_the_page_explains_findings_and_what_could_not_be_checked(report: AuditReport, tmp_path: Path) -> None:
    page = write_audit(report, tmp_path).read_text()
    for check in report.result.checks:
        assert check.title.replace("'", "&#39;") in page
        if check.findings:
            assert check.reason.replace("'", "&#39;") in page
            assert f'id="{check.name}"' in page
    assert "name the bags that it was exported from" in page
    assert "<polyline" in page


def test_the_json_has_every_finding_with_its_rate(report: AuditReport, tmp_path: Path) -> None:
    write_audit(report, tmp_path)
    data = json.loads((tmp_path / "audit.json").read_text())
    checks = {check["name"]: check for check in data["checks"]}
    assert not data["clean"]
    assert checks["wrong_instruction"]["rate"] == 0.2
    (finding,) = checks["wrong_instruction"]["findings"]
    assert (finding["episodes"], finding["sources"]) == (["e2"], ["runs/demos/e2"])
    assert checks["statistics"]["findings"][0]["ticks"] == [30]
    assert checks["hidden_object"]["status"] == "unchecked"


def test_the_summary_counts(report: AuditReport) -> None:
    assert summary_line(report.result) == "3 checks of 24 found faults, in 2 of 5 episodes; 9 could not be made"
    few = replace(report.result, episodes=1)
    assert "in 2 episodes with the missing ones (the dataset has 1)" in summary_line(few)
    assert summary_line(Auditor(["idle"]).result()) == "0 checks of 1 found faults in 0 episodes; 1 could not be made"


def test_values_that_are_not_finite_do_not_break_a_chart(tmp_path: Path) -> None:
    auditor = Auditor(["replay"])
    item = AuditEpisode(name="e", split="", episode=audited.episode())
    item.truth = audited.truth(replay_error_m=(0.0, 0.1, float("inf"), float("inf")))
    auditor.add(item)
    page = write_audit(AuditReport(title="t", result=auditor.result()), tmp_path).read_text()
    assert '<polyline class="c0" points="0.0,120.0 213.3,0.0"/>' in page
