from __future__ import annotations

import pytest

from roboxim_runs.pace import WINDOW_S, Pace, duration_text, rate_text


def test_a_rate_needs_two_counts_and_leaves_out_the_start():
    pace = Pace()
    assert pace.text(0.0, 10) == ""
    pace.add(20.0, 1)  # 20 s in which workers start
    assert pace.per_second(20.0) is None
    pace.add(22.0, 2)
    pace.add(24.0, 3)
    assert pace.per_second(24.0) == pytest.approx(0.5)
    assert pace.text(24.0, 60) == "30/min, 2 min left"
    assert pace.text(24.0, 0) == "30/min"


def test_a_rate_falls_while_nothing_is_done_and_follows_a_change_of_speed():
    pace = Pace()
    for second in range(11):
        pace.add(float(second), 1 + second)
    assert pace.per_second(11.0) == pytest.approx(1.0)
    assert pace.per_second(100.0) == pytest.approx(0.1)
    for step in range(1, 40):
        pace.add(10.0 + 100.0 * step, 11 + step)
    assert 3 * WINDOW_S < 10.0 + 100.0 * 39
    assert pace.per_second(10.0 + 100.0 * 39) == pytest.approx(0.01)


def test_a_count_that_goes_back_begins_anew():
    pace = Pace()
    for time_s, done in ((0.0, 5), (1.0, 6), (2.0, 2), (4.0, 4)):
        pace.add(time_s, done)
    assert pace.per_second(4.0) == pytest.approx(1.0)


def test_what_was_done_before_is_no_speed():
    pace = Pace()
    for time_s, done in ((0.0, 0), (11.0, 0), (28.0, 1975), (38.0, 2025)):
        pace.add(time_s, done)
    assert pace.text(38.0, 2975) == "5.0/s, 10 min left"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.4, "0 s"), (89, "89 s"), (90, "2 min"), (3600, "60 min"), (12000, "3 h 20 min"), (86400 * 2 + 7200, "2 d 2 h")],
)
def test_durations_have_one_or_two_units(seconds, text):
    assert duration_text(seconds) == text


def test_rates_are_given_in_a_unit_that_has_something_to_count():
    found = [rate_text(rate) for rate in (1234.5, 2.0, 0.5, 0.02, 0.001)]
    assert found == ["1,234/s", "2.0/s", "30/min", "1.2/min", "3.6/h"]
