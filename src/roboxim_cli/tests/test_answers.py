"""Commands that run episodes again, as they are typed: with their defaults."""

from __future__ import annotations

import pytest
from click.testing import CliRunner

from roboxim_cli.commands.answers import compare_policies, mine

pytestmark = pytest.mark.thorough


def run(command, *arguments):
    result = CliRunner().invoke(command, [str(argument) for argument in arguments])
    assert result.exit_code == 0, (result.output, result.exception)
    return result.output


def test_two_policies_are_compared(runtime):
    text = run(compare_policies.command, "a=expert", "b=expert", "--episodes", 1)
    assert "both succeed in 1" in text
    assert "2 runs" in text


def test_a_policy_without_a_weak_region_has_none(runtime):
    text = run(mine.command, "expert", "--first", 6, "--rounds", 0, "--confirm", 6)
    assert "no region was confirmed" in text
    assert "6 rollouts over reset.robot.position.0" in text
