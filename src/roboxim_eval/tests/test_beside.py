"""Measures beside success, over a policy's episodes."""

from __future__ import annotations

from roboxim_core.episode import EpisodeResult
from roboxim_core.verdicts import Verdict
from roboxim_eval.report.evaluation import PolicyRun, Report, evaluation_page, summary
from roboxim_eval.statistics.beside import beside_success


def result(index: int, force_n: float, crossed: float) -> EpisodeResult:
    predicates = {"limits.force_max_n": force_n, "limits.crossed": crossed}
    return EpisodeResult(episode_id=f"eval-0-{index}-0", index=index, steps=9, verdict=Verdict(predicates=predicates))


RESULTS = [result(0, 5.0, 0.0), result(1, 30.0, 1.0), result(2, 8.0, 0.0)]


def test_measures_are_summarised():
    found = beside_success(RESULTS)
    assert (found.episodes, found.crossed) == (3, 1)
    force = found.measures["force_max_n"]
    assert (force.median, force.low, force.high) == (8.0, 5.0, 30.0)
    assert beside_success([EpisodeResult(episode_id="e-0", index=0)]) is None


def test_report_and_summary_have_them():
    report = Report(title="T", runs=[PolicyRun(policy="bc", results=RESULTS)], facts={}, versions={}, command="c")
    assert summary(report)["policies"]["bc"]["limits"]["crossed"] == 1
    page = evaluation_page(report)
    assert "limits crossed in 1 of 3 episodes" in page
    assert "<td>largest force of a contact</td><td>8 N</td><td>5 N to 30 N</td>" in page
