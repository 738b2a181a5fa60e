"""Partial credit of tasks of several steps."""

from __future__ import annotations

import pytest

from roboxim_core.episode import EpisodeResult
from roboxim_core.verdicts import Verdict
from roboxim_eval.report.course import explain_steps
from roboxim_eval.report.evaluation import PolicyRun, Report, evaluation_page, summary
from roboxim_eval.report.reasons import explained
from roboxim_eval.statistics.steps import step_share


def result(index: int, done: int, of: int = 2) -> EpisodeResult:
    outcome, reason = ("success", "") if done == of else ("failure", f"step_{done + 1}_not_pressed")
    predicates = {"step": float(min(done + 1, of)), "steps_done": float(done), "steps_share": done / of}
    return EpisodeResult(
        episode_id=f"eval-0-{index}-0", index=index, outcome=outcome, reason=reason, steps=9,
        verdict=Verdict(success=done == of, reason=reason, predicates=predicates),
    )  # fmt: skip


def test_share_is_the_mean_and_says_where_failures_stopped():
    found = step_share([result(0, 2), result(1, 1), result(2, 1), result(3, 0)])
    assert (found.share, found.episodes, found.stopped_at) == (0.5, 4, {"1": 1, "2": 2})
    assert 0.0 <= found.low < 0.5 < found.high <= 1.0
    assert found.stops == "step 1 (1), step 2 (2)"


@pytest.mark.parametrize("done", [0, 1, 2])
def test_equal_shares_do_not_make_it_certain(done):
    found = step_share([result(index, done) for index in range(5)])
    assert found.share == done / 2
    assert found.high - found.low > 0.3


def test_tasks_of_one_step_have_none():
    assert step_share([EpisodeResult(episode_id="eval-0-0-0", index=0)]) is None


def test_report_and_summary_say_the_share():
    run = PolicyRun(policy="bc", results=[result(0, 2), result(1, 1)])
    report = Report(title="T", runs=[run], facts={}, versions={}, command="c")
    assert summary(report)["policies"]["bc"]["steps"]["share"] == 0.75
    assert "75 %" in evaluation_page(report)
    assert "failures stopped at step 2 (1)" in evaluation_page(report)


def test_reasons_of_steps_are_explained():
    assert explained("step_2_not_pressed") == "Step 2: The button was not pressed down."
    assert explained("step_1_undone") == "Step 1: What had been done was undone."


def test_course_says_which_steps_were_done():
    words = ("Stack the red cube", "Push the button")
    told = explain_steps(words, (81, None), 2, "Pressed down 0 cm of 0.6.")
    assert (
        told
        == "1 of 2 steps were done (step 1 at tick 81). Step 2, 'Push the button', was not: pressed down 0 cm of 0.6."
    )
    assert explain_steps(words, (None, None), 1, "") == "0 of 2 steps were done. Step 1, 'Stack the red cube', was not."
