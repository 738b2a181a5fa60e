import json
import re
from collections import Counter

import numpy as np
import pytest

from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import InvalidRequestError
from roboxim_eval.grouping import grouped
from roboxim_eval.report import PolicyRun, Report, verdict_line, write_report
from roboxim_eval.statistics import error_line, failure_reasons, is_measured, rate_of, success_rate


def result(index, outcome="success", reason="", instruction="Pick up the red cube"):
    return EpisodeResult(
        episode_id=f"eval-0-{index:05d}-0",
        index=index,
        outcome=outcome,
        reason=reason,
        instruction=instruction,
        steps=40,
    )


def test_wilson_interval_agrees_with_published_values():
    # Newcombe (1998), table I, method 3: 81 of 263 and 0 of 20.
    rate = success_rate(81, 263)
    assert (rate.low, rate.high) == pytest.approx((0.2553, 0.3662), abs=1e-4)


def test_the_interval_of_no_success_is_not_too_narrow():
    # Clopper and Pearson (statsmodels 0.15: proportion_confint(0, 20, method="beta")); Wilson's would be 0 to 0.161
    rates = success_rate(0, 20), success_rate(20, 20)
    assert [(rate.low, rate.high) for rate in rates] == [
        pytest.approx((0.0, 0.168433), abs=1e-6), pytest.approx((0.831567, 1.0), abs=1e-6),
    ]  # fmt: skip


def test_impossible_counts_are_refused():
    with pytest.raises(InvalidRequestError, match="3 of 2"):
        success_rate(3, 2)


def test_errors_count_as_failures():
    results = [result(0), result(1, "error", "policy_late"), result(2, "failure", "not_lifted")]
    assert rate_of(results).successes == 1
    assert failure_reasons(results) == {"policy_late": 1, "not_lifted": 1}


def test_most_episodes_in_errors_measure_no_policy(tmp_path):
    broken = PolicyRun(
        policy="mine",
        results=[result(i, "error", "policy_fault") for i in range(3)] + [result(3, "failure", "not_lifted")],
    )
    shaky = PolicyRun(policy="shaky", results=[result(0, "error", "policy_late"), result(1)])
    zero = PolicyRun(policy="zero", results=[result(i, "failure", "max_steps") for i in range(20)])
    assert error_line(broken.results) == (
        "3 of 4 episodes ended in errors (policy_fault x3); the policy is not measured"
    )
    assert error_line(shaky.results) == "1 of 2 episodes ended in errors (policy_late x1)"
    assert [is_measured(run.results) for run in (broken, shaky, zero)] == [False, True, True]
    assert error_line(zero.results) == ""
    report = Report(title="t", runs=[zero, broken, shaky], facts={}, versions={}, command="c")
    page = write_report(report, tmp_path).read_text()
    assert page.count("not measured</span> 3 of 4 episodes ended in errors") == 1
    said = json.loads((tmp_path / "summary.json").read_text())
    numbers = said["policies"]["mine"]
    assert (numbers["measured"], numbers["rate"], numbers["high"]) == (False, None, None)
    assert numbers["errors"] == {"policy_fault": 3}
    assert "by_instruction" not in numbers
    assert "mine is not compared" in said["comparison"]
    assert "overlaps that of shaky" in said["comparison"]
    assert "overlaps" not in verdict_line([broken, zero, shaky])


def test_report_is_self_contained_and_escapes(tmp_path):
    frames = [np.full((32, 64, 3), value, np.uint8) for value in (0, 128, 255)]
    good = PolicyRun(
        policy="bc",
        results=[result(i, instruction="<b>Pick & place</b>") for i in range(18)]
        + [result(18, "failure", "not_lifted")],
        films={"eval-0-00000-0": frames, "eval-0-00018-0": frames},
    )
    bad = PolicyRun(policy="random", results=[result(i, "failure", "max_steps") for i in range(20)])
    report = Report(
        title="Pick up the cube",
        runs=[good, bad],
        facts={"seed": "0"},
        versions={"numpy": "2"},
        command="roboxim evaluate",
    )
    page = write_report(report, tmp_path).read_text()
    assert not re.search(r'(src|href)="(?!data:)', page), "a report must not refer to other files"
    assert "<b>Pick" not in page
    assert page.count("data:image/webp") == 2
    assert "lies above" in verdict_line(report.runs)
    numbers = json.loads((tmp_path / "summary.json").read_text())
    assert numbers["policies"]["bc"]["successes"] == 18
    assert numbers["policies"]["random"]["failure_reasons"] == {"max_steps": 20}


def test_numbers_of_ranges_are_grouped_into_thirds():
    groups = grouped({str(i): f"{0.1 * i:.4g}" for i in range(30)})
    assert Counter(groups.values()) == {"0 to 0.967": 10, "0.967 to 1.93": 10, "1.93 to 2.9": 10}
    assert groups["0"] == "0 to 0.967"
    assert grouped({"a": "left", "b": "right"}) == {"a": "left", "b": "right"}
    assert grouped({str(i): f"{i} {i}" for i in range(100)}) == {}, "positions are no groups"


def test_a_choice_without_a_choice_is_no_dimension():
    results = [result(i) for i in range(4)]
    drawn = {r.episode_id: {"target": "cube", "cell_number": str(r.index)} for r in results}
    assert list(PolicyRun(policy="bc", results=results, drawn=drawn).rates_by_dimension) == ["instruction"]


def test_rates_by_what_reset_components_have_drawn(tmp_path):
    results = [result(index, "success" if index % 2 else "failure") for index in range(6)]
    drawn = {r.episode_id: {"interaction_area": "left" if r.index < 4 else "right"} for r in results}
    run = PolicyRun(policy="bc", results=results, drawn=drawn)
    rates = run.rates_by_dimension["interaction_area"]
    assert {name: (rate.successes, rate.episodes) for name, rate in rates.items()} == {"left": (2, 4), "right": (1, 2)}
    report = Report(title="Areas", runs=[run], facts={}, versions={}, command="roboxim evaluate")
    assert "By interaction area" in write_report(report, tmp_path).read_text()
    numbers = json.loads((tmp_path / "summary.json").read_text())["policies"]["bc"]
    assert numbers["by_interaction_area"]["right"]["episodes"] == 2
    assert "by_instruction" in numbers
