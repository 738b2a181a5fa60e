"""RoboXim's motions are clean; the referee detects a corrupted planner."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest


@pytest.fixture(scope="module")
def ours() -> Callable[..., Any]:
    """Plans a problem in this process and returns the motion's samples and its duration."""
    from benchmarks.peers import run_roboxim

    from roboxim_core.models.library import ModelLibrary
    from roboxim_planner.pipeline import Planner

    planner = Planner(ModelLibrary().robot("panda"))

    def solve(problem: Any, seed: int = 1) -> tuple[np.ndarray, float]:
        answer = run_roboxim.plan(planner, {"problem": problem.plain(), "seed": seed, "limit_s": 60.0})
        assert not answer["error"], answer["error"]
        return run_roboxim.unpack(answer["positions"]), answer["duration_s"]

    return solve


def verdict_on(problem: Any, motion: tuple[np.ndarray, float]) -> Any:
    return problem.referee().judge(*motion, np.array(problem.start), problem.goal_value)


@pytest.mark.thorough
def test_the_planners_motions_are_clean(ours) -> None:
    from benchmarks.planner._problems import tabletop
    from benchmarks.planner._problems_hard import FAMILIES, hard

    problems = [tabletop(seed, salt=9) for seed in range(8)] + [hard(family, 3, salt=9) for family in FAMILIES]
    for problem in problems:
        assert verdict_on(problem, ours(problem)).clean, problem.name


def test_a_graze_between_free_samples_is_not_let_through(ours) -> None:
    from benchmarks.planner._problems import tabletop
    from benchmarks.planner._problems_hard import hard

    for problem, seed in ((tabletop(598), 598), (hard("table_under_pick", 12, salt=1), 12)):
        assert verdict_on(problem, ours(problem, seed)).clean, problem.name


def test_a_planner_that_overlooks_obstacles_is_caught(ours, monkeypatch: pytest.MonkeyPatch) -> None:
    from benchmarks.peers import run_roboxim
    from benchmarks.planner._problems import tabletop

    seen = run_roboxim.scene_of
    monkeypatch.setattr(run_roboxim, "scene_of", lambda problem: seen(problem | {"solids": []}))
    verdicts = [verdict_on(problem, ours(problem)) for problem in (tabletop(seed, salt=9) for seed in range(0, 8, 2))]
    assert any("collision" in fault for verdict in verdicts for fault in verdict.faults)


def test_a_planner_that_forgets_what_it_holds_is_caught(ours, monkeypatch: pytest.MonkeyPatch) -> None:
    from benchmarks.peers import run_roboxim
    from benchmarks.planner._problems import tabletop

    seen = run_roboxim.scene_of
    monkeypatch.setattr(run_roboxim, "scene_of", lambda problem: seen(problem | {"held": None}))
    verdicts = [verdict_on(problem, ours(problem)) for problem in (tabletop(seed, salt=9) for seed in range(0, 30, 6))]
    assert any("held" in fault for verdict in verdicts for fault in verdict.faults)


def test_a_time_law_beyond_the_limits_is_refused_and_caught_when_the_verifier_is_blind(
    ours, monkeypatch: pytest.MonkeyPatch
) -> None:
    from benchmarks.planner._problems import tabletop

    from roboxim_planner import pipeline
    from roboxim_planner.motions import timing
    from roboxim_planner.motions.verify import Finding

    def hasty(path, corners, limits, *rest):
        faster = replace(limits, velocity=1.2 * limits.velocity, acceleration=1.2 * limits.acceleration)
        return timing.time_path(path, corners, faster, *rest)

    problem = tabletop(0, salt=9)
    monkeypatch.setattr(pipeline, "time_path", hasty)
    with pytest.raises(AssertionError, match="TRAJECTORY_INVALID"):
        ours(problem)
    monkeypatch.setattr(pipeline, "verify_motion", lambda *_, **__: Finding())
    assert verdict_on(problem, ours(problem)).violations
