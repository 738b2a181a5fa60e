"""Commands that run episodes again, as they are typed: with their defaults."""

from __future__ import annotations

from unittest.mock import MagicMock

import pytest
from click.testing import CliRunner

from roboxim_cli.commands.answers import compare_policies, mine
from roboxim_core.errors import PolicyError
from roboxim_eval.answers.moments import SceneComparison
from roboxim_runs.answers import comparing, trying

pytestmark = pytest.mark.thorough


def run(command, *arguments):
    result = CliRunner().invoke(command, [str(argument) for argument in arguments])
    assert result.exit_code == 0, (result.output, result.exception)
    return result.output


def test_two_policies_are_compared(runtime):
    text = run(compare_policies.command, "a=expert", "b=expert", "--episodes", 1)
    assert "both succeed in 1" in text
    assert "2 runs" in text


@pytest.mark.parametrize("end", [PolicyError("the server is gone"), KeyboardInterrupt()])
def test_what_was_compared_is_summed_up_when_a_policy_raises_or_on_ctrl_c(monkeypatch, end):
    def compared(bench, first, second, config, *, on_scene, on_part):
        on_scene(SceneComparison(scene=0, outcome=(True, True), diverge_at=None))
        on_scene(SceneComparison(scene=1, outcome=(True, False), diverge_at=3, decides_at=5, phase="the grasp"))
        raise end

    monkeypatch.setattr(comparing, "compare", compared)
    monkeypatch.setattr(trying, "TryBench", MagicMock())
    result = CliRunner().invoke(compare_policies.command, ["a=expert", "b=expert"])
    assert result.exit_code != 0
    assert "2 scenes: both succeed in 1, a alone in 1, b alone in 0, neither in 0." in result.output
    assert "what decides is: the grasp in 1" in result.output


def test_a_policy_without_a_weak_region_has_none(runtime):
    text = run(mine.command, "expert", "--first", 6, "--rounds", 0, "--confirm", 6)
    assert "no region was confirmed" in text
    assert "6 rollouts over reset.robot.position.0" in text
