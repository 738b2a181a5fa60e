"""The gripper's rule keeps a flickering policy from opening and closing at every action."""

import pytest

from roboxim_core.actions.gripper import GripperRule, GripperSwitch
from roboxim_core.errors import InvalidRequestError


def commands(demands, start=1.0, **rule):
    switch = GripperSwitch(GripperRule(**rule), start)
    return [switch.step(demand) for demand in demands]


def test_without_a_rule_every_opening_is_commanded():
    assert commands([0.2, 0.7, 1.0]) == [0.2, 0.7, 1.0]


def test_a_binary_gripper_is_open_or_closed():
    assert commands([0.51, 0.49, 0.5, 0.9], binary=True) == [1.0, 0.0, 0.0, 1.0]


def test_within_the_band_the_command_stays():
    assert commands([0.45, 0.35, 0.55, 0.65, 0.5], binary=True, band=0.2) == [1.0, 0.0, 0.0, 1.0, 1.0]


def test_a_change_needs_consecutive_actions_that_agree():
    assert commands([0, 1, 0, 0, 1, 1], binary=True, agree=2) == [1, 1, 1, 0, 0, 1]


def test_a_change_is_held():
    assert commands([0, 1, 1, 1, 0], binary=True, hold=3) == [0, 0, 0, 1, 1]


def test_only_jumps_count_if_the_rule_says_so():
    assert commands([0.0, 0.0, 0.6, 0.1, 0.1, 0.7], binary=True, on_change=True) == [1, 1, 1, 1, 1, 1]
    assert commands([1.0, 0.4, 0.3, 0.9], binary=True, on_change=True) == [1, 0, 0, 1]


@pytest.mark.parametrize("rule", [{"band": 0.1}, {"agree": 2}, {"hold": 2}, {"on_change": True}])
def test_a_rule_that_would_have_no_effect_is_refused(rule):
    with pytest.raises(InvalidRequestError, match="need binary: true"):
        GripperRule(**rule)
