"""The moment that decides between the expert and policies with a planted defect of one phase."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from planted_causes import DEFECTS, RELEASE_M, Defective

from roboxim_bringup.core_graph import CoreActor
from roboxim_core.actions import ANY_RATE, ActionSemantics
from roboxim_core.episode import RunConfig
from roboxim_core.errors import ConfigError, SimError
from roboxim_core.policies import PolicyDescription
from roboxim_core.seeds import SeedPath
from roboxim_eval.answers.moments import SceneComparison, events_of, first_success, summary
from roboxim_runs.answers.comparing import CompareRun, compare
from roboxim_runs.answers.trying import TryBench
from roboxim_runs.episodes.task_choice import task_text

IMAGES = RunConfig(image_width=64, image_height=64)
NEAR = 3
"""Largest distance of a tick from the planted moment at which it is found."""


pytestmark = pytest.mark.thorough


@pytest.fixture(scope="module")
def bench():
    try:
        made = TryBench()
    except SimError as error:
        pytest.skip(str(error))
    with made:
        yield made


def planted_moment(states, defect):
    """Return the tick of the expert's episode from which the defect can no longer happen."""
    if defect == "late_grasp":
        return events_of(states)["the grasp"]
    heights = [
        state.entity("target").pose.position[2] - states[0].entity("target").pose.position[2] for state in states
    ]
    return next(tick for tick, height in enumerate(heights) if height >= RELEASE_M[1])


class OtherConvention(Defective):
    """The defective policy with the gripper's numbers the other way round."""

    semantics = ActionSemantics(rate_hz=ANY_RATE, gripper="absolute_open_0_closed_1")

    def act(self, window):
        chunk = super().act(window)
        actions = np.array(chunk.actions)
        actions[:, -1] = 1.0 - actions[:, -1]
        return replace(chunk, actions=actions)


def benchmark(bench, defect, scenes, policy=Defective):
    """Return how many deciding moments are the planted ones, of how many failures, by chance, runs and seconds."""
    config = CompareRun(
        task_config=task_text("pick_cube"), scenes=scenes, run=RunConfig(image_width=64, image_height=64)
    )
    before, began = bench.runs, time.monotonic()
    found = compare(bench, bench.expert, CoreActor(policy(defect=defect)), config)
    runs, seconds = bench.runs - before, time.monotonic() - began
    lost = [one for one in found if one.outcome == (True, False)]
    right, chance = 0, 0.0
    for one in lost:
        seed = SeedPath(run_seed=0, purpose="eval", index=one.scene)
        states = bench.run(
            bench.graph.tasks.draw(seed, config.task_config), bench.expert, seed, config=config.run
        ).states
        moment = planted_moment(states, defect)
        right += one.decides_at is not None and abs(one.decides_at - moment) <= NEAR
        chance += (2 * NEAR + 1) / one.ticks
    return right, len(lost), chance / max(1, len(lost)), runs / scenes, seconds / scenes


@pytest.mark.parametrize("policy", [Defective, OtherConvention])
def test_a_late_grasp_is_found(bench, policy):
    right, lost, _, _, _ = benchmark(bench, "late_grasp", 1, policy)
    assert (right, lost) == (1, 1)


def test_equal_policies_never_differ(bench):
    config = CompareRun(task_config=task_text("pick_cube"), scenes=1, run=IMAGES)
    (one,) = compare(bench, bench.expert, bench.expert, config)
    assert (one.outcome, one.diverge_at, one.decides_at) == ((True, True), None, None)


def test_policies_that_are_executed_at_other_rates_are_refused(bench):
    config = CompareRun(task_config=task_text("pick_cube"), scenes=1, run=replace(IMAGES, max_steps=2))
    slow = CoreActor(Defective())
    slow.describe = lambda: PolicyDescription(name="slow", semantics=ActionSemantics(rate_hz=5.0), privileged=True)
    before = bench.runs
    with pytest.raises(ConfigError, match=r"rate_hz: 10.0 of the first, 5.0 of the second"):
        compare(bench, bench.expert, slow, config)
    assert bench.runs == before  # no episode was run for it


def test_bisection_and_summary():
    assert first_success(lambda tick: tick >= 17, 0, 60) == 17
    lost = SceneComparison(scene=0, outcome=(True, False), diverge_at=1, decides_at=30, phase="the grasp", ticks=60)
    even = SceneComparison(scene=1, outcome=(True, True), diverge_at=None)
    assert summary(("expert", "bc"), [lost, even]) == (
        "2 scenes: both succeed in 1, expert alone in 1, bc alone in 0, neither in 0.",
        "Of the scenes where expert succeeds and bc fails (1), what decides is: the grasp in 1.",
    )


@pytest.mark.slow
@pytest.mark.parametrize("defect", DEFECTS)
def test_planted_moments_are_found(bench, defect):
    """The table of docs/how-to/answers.md: run this file as a program."""
    right, lost, chance, _, _ = benchmark(bench, defect, 6)
    assert lost >= 5
    assert right >= 0.8 * lost
    assert chance < 0.3


def main():
    """Print the table of docs/how-to/answers.md."""
    with TryBench() as bench:
        for defect in DEFECTS:
            right, lost, chance, runs, seconds = benchmark(bench, defect, 6)
            print(f"| {defect} | {right} of {lost} | {100 * chance:.0f} % | {runs:.0f} | {seconds:.0f} s |",  # noqa: T201
                  flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
