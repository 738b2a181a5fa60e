"""Every skill's evaluator refuses its cheats and accepts its honest ways, acted through the delta controller."""

from __future__ import annotations

from collections import Counter

import pytest

from roboxim_core.registry import Registry
from roboxim_runs.evaluation.trials import TrialRuns
from roboxim_tasks.skills import SKILLS
from roboxim_tasks.trials import TRIALS, Trial, base, missing_trials

SCENES = 10
ATTACK = (
    "push_object/carry", "place_on/drop", "place_left_of/drop", "stack/cage", "push_button/side_of_the_hand",
    "place_on/at_the_far_side", "stack/lay_it_down", "put_into/both", "push_object/two_at_once",
    "push_object/knock_another_over", "rotate/tip_and_turn", "put_into/toss",
)  # fmt: skip
"""Regressions: cheats that once passed an evaluator, and an honest solution that was rejected."""


@pytest.fixture(scope="module")
def runs():
    with TrialRuns() as made:
        yield made


@pytest.mark.parametrize("skill", sorted(SKILLS))
def test_every_skill_has_cheats_and_honest_ways(skill):
    assert not missing_trials(skill)


def test_a_skill_without_trials_is_named(monkeypatch):
    registry: Registry[Trial] = Registry("trial")
    monkeypatch.setattr(base, "TRIALS", registry)

    def nothing(scene):
        """Do nothing."""
        return []

    base.cheat("juggle", reason="dropped")(nothing)
    assert missing_trials("juggle") == (
        "skill 'juggle' needs 2 more cheats (@cheat) and 3 more honest ways (@honest) in roboxim_tasks.trials"
    )


@pytest.mark.thorough
@pytest.mark.parametrize("key", ATTACK)
def test_known_cheats_and_honest_solutions_are_judged_correctly(runs, key):
    outcome = runs.run(TRIALS[key], 0)
    assert outcome.as_expected, outcome
    assert outcome.reason == TRIALS[key].reason


@pytest.mark.slow
@pytest.mark.parametrize("key", list(TRIALS))
def test_cheats_fail_and_honest_ways_succeed(runs, key):
    outcomes = [runs.run(TRIALS[key], index) for index in range(SCENES)]
    assert not [outcome for outcome in outcomes if not outcome.as_expected]
    reasons = Counter(outcome.reason for outcome in outcomes)
    assert 2 * reasons[TRIALS[key].reason] >= SCENES, reasons
