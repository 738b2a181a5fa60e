"""Errors of a policy, and scenes that break a constraint, are no failures at the task."""

from types import SimpleNamespace

import pytest

from roboxim_core.episode import Draw, EpisodeResult
from roboxim_core.errors import PolicyError, TaskError
from roboxim_core.policies import PolicyDescription
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_runs.answers import trying
from roboxim_runs.answers.comparing import CompareRun, compare
from roboxim_runs.answers.trying import Try, TryBench


@pytest.fixture
def ended(monkeypatch):
    """Return a bench whose episodes end in errors of a given reason."""

    def made(reason):
        result = EpisodeResult(episode_id="eval-0-00000-0", index=0, outcome="error", reason=reason, message="why")
        runner = SimpleNamespace(run_attempt=lambda seed: result)
        monkeypatch.setattr(trying, "episode_loop", lambda *_, **__: runner)
        bench = TryBench.__new__(TryBench)
        drawn = Draw(task=TaskSpec(skill="pick_up", objects={}, instruction=""), scene=SceneSpec(), max_steps=1)
        tasks = SimpleNamespace(draw=lambda seed, text: drawn)
        bench.graph, bench.runs = SimpleNamespace(sim=None, tasks=tasks), 0
        return bench, drawn

    return made


def test_a_policy_that_raises_does_not_fail(ended):
    bench, drawn = ended("policy_fault")
    with pytest.raises(PolicyError, match=r"eval-0-00000-0 ended in an error of its policy \(policy_fault\).*: why"):
        bench.run(drawn, None, SeedPath(run_seed=0, purpose="eval", index=0))


def test_a_scene_that_breaks_a_constraint_is_not_compared(ended):
    bench, drawn = ended("reset_infeasible")
    tried = bench.run(drawn, None, SeedPath(run_seed=0, purpose="eval", index=0))
    assert isinstance(tried, Try)
    assert not tried.began
    actor = SimpleNamespace(describe=lambda: PolicyDescription(name="still"))
    with pytest.raises(TaskError, match="scene 0: why"):
        compare(bench, actor, actor, CompareRun(task_config="", scenes=1))
