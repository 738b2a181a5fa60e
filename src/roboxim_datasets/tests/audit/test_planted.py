"""Planted faults: the audit finds each at every rate, and nothing else."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import audited
import numpy as np
import pytest

from roboxim_core.errors import InvalidRequestError
from roboxim_datasets.audit import AuditEpisode, Auditor, AuditResult
from roboxim_datasets.audit.faults import DATASET_FAULTS, EditableEpisode, choose
from roboxim_datasets.audit.faults.composed import Composed, compose
from roboxim_datasets.episode import Step, Wanted

COUNTS = {0.01: 100, 0.1: 20, 1.0: 10}
"""Share of the episodes in which a fault is planted, to the number of episodes."""
NEEDS_SIMULATOR = {"wrong_execution"}
SIDE_EFFECTS = {
    "rotation_jump": {"saturation", "statistics"},
    "outlier": {"saturation"},
    "gripper_range": {"statistics"},
    "blank_camera": {"frozen_camera"},
    "state_lag": {"frozen_camera"},
}
"""Fault to the checks that may find it, too."""
GENERAL = {"motion", "labels", "kinematics", "behaviour", "recorded_task"}
"""Checks that know no faults and may find any."""
TASKS = ("Pick up the cube", "Pick up the apple")
TASK = (
    '{"skill": "pick_up", "objects": {"target": {"model": "%s", "modifiers": {}}}, "arguments": {}, '
    '"instruction": "%s"}'
)


def clean(number: int) -> AuditEpisode:
    """Return a clean episode of one of two tasks."""
    text = TASKS[number % 2]
    made = audited.episode(number, instruction=text)
    made = replace(made, metadata={**made.metadata, "task": TASK % (number % 2, text)})
    return AuditEpisode(name=f"e{number}", split="train", episode=made, arm=audited.KnownArm())


@pytest.fixture(scope="module")
def pool() -> list[AuditEpisode]:
    """Return clean episodes, which remember what was read of them."""
    return [clean(number) for number in range(max(COUNTS.values()))]


def audit(episodes: list[AuditEpisode]) -> AuditResult:
    auditor = Auditor()
    for episode in episodes:
        auditor.add(episode)
    return auditor.result()


@pytest.mark.parametrize("name", DATASET_FAULTS)
def test_every_fault_conforms(name: str) -> None:
    DATASET_FAULTS.check(name)


def test_there_is_nothing_to_find_before(pool: list[AuditEpisode]) -> None:
    assert [finding.text for _, finding in audit(pool[:20]).findings()] == []


@pytest.mark.thorough
@pytest.mark.parametrize("rate", [pytest.param(0.01, marks=pytest.mark.slow), 0.1, 1.0])
@pytest.mark.parametrize("name", sorted(set(DATASET_FAULTS) - NEEDS_SIMULATOR))
def test_every_planted_fault_is_found_and_nothing_else(name: str, rate: float, pool: list[AuditEpisode]) -> None:
    fault, items = DATASET_FAULTS[name](), {item.name: item for item in pool[: COUNTS[rate]]}
    sources = [item.episode for item in items.values()]

    def plant(item: str, rng: np.random.Generator) -> str:
        copy = EditableEpisode.of(items[item].episode)
        text = fault.edit(copy, sources, rng)
        items[item] = replace(items[item], episode=copy.as_episode())
        return text

    chosen = choose(list(items), rate, 7, plant)
    assert len(chosen.done) == max(1, round(rate * len(items)))
    result = audit(list(items.values()))
    assert set(result.check(fault.found_by).faulty_episodes) == set(chosen.done)
    others = {check.name for check in result.checks if check.faults} - {fault.found_by} - GENERAL
    assert others <= SIDE_EFFECTS.get(name, set())


def test_an_edit_leaves_the_original_as_it_is(pool: list[AuditEpisode]) -> None:
    episodes = [item.episode for item in pool[:2]]
    before = EditableEpisode.of(episodes[0])
    for name in DATASET_FAULTS:
        copy = EditableEpisode.of(episodes[0])
        DATASET_FAULTS[name]().edit(copy, episodes, np.random.default_rng(0))
    after = EditableEpisode.of(episodes[0])
    np.testing.assert_array_equal(before.actions, after.actions)
    for camera, images in before.images.items():
        np.testing.assert_array_equal(np.stack(images), np.stack(after.images[camera]))


def test_an_edit_keeps_the_words_of_each_step_unless_it_relabels_them() -> None:
    whole = audited.episode()

    def read(wanted: Wanted) -> Iterator[Step]:
        for step in whole.read(wanted):
            late = step.index >= 40
            yield replace(step, instruction="Lift it" if late else whole.instruction, subtask=f"step {late:d}")

    copy = EditableEpisode.of(replace(whole, instructions=(whole.instruction, "Lift it"), read=read))
    copy.take([38, 39, 40, 40])
    made = copy.as_episode()
    assert (made.instructions, made.subtasks) == ((whole.instruction, "Lift it"), ("step 0", "step 1"))
    assert [made.words(step) for step in made.steps(())] == [whole.instruction] * 2 + ["Lift it"] * 2
    assert [step.subtask for step in made.steps(())] == ["step 0"] * 2 + ["step 1"] * 2
    copy.instruction = "Wave"
    made = copy.as_episode()
    assert (made.instruction, made.instructions, made.subtasks) == ("Wave", (), ())
    assert {(made.words(step), step.subtask) for step in made.steps(())} == {("Wave", None)}


def test_episodes_that_refuse_a_fault_are_replaced() -> None:
    names = [str(i) for i in range(20)]
    chosen = choose(names, 0.5, 0, lambda name, rng: "" if int(name) % 2 else f"planted in {name}")
    assert sorted(map(int, chosen.done)) == list(range(0, 20, 2))
    with pytest.raises(InvalidRequestError, match="none of the 20"):
        choose(names, 0.5, 0, lambda name, rng: "")
    with pytest.raises(InvalidRequestError, match="rate"):
        choose(names, 0.0, 0, lambda name, rng: "x")


def test_a_higher_rate_keeps_what_a_lower_one_plants() -> None:
    names = [str(i) for i in range(30)]

    def plant(name: str, rng: np.random.Generator) -> str:
        return f"{name} {rng.random()}"

    low, high = choose(names, 0.1, 4, plant).done, choose(names, 0.5, 4, plant).done
    assert low.items() <= high.items()


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_faults_that_nobody_named_are_found(seed: int, pool: list[AuditEpisode]) -> None:
    rng, auditor = np.random.default_rng(seed), Auditor()
    sources = [item.episode for item in pool[:24]]
    planted: dict[str, Composed] = {}
    for number, item in enumerate(pool[:24]):
        episode = replace(item.episode, metadata={**item.episode.metadata, "final_state_hash": f"{number:032x}"})
        audited_one = replace(item, episode=episode)
        if number % 2:
            copy = EditableEpisode.of(episode)
            planted[item.name] = compose(copy, sources, rng)
            audited_one = replace(item, episode=copy.as_episode(), expected=episode)
        auditor.add(audited_one)
    result = auditor.result()
    done = {name for name, fault in planted.items() if fault.text}
    assert set(result.check("content").faulty_episodes) == done, "with the bags every edit is found"
    others = {name for check in result.checks if check.name != "content" for name in check.faulty_episodes}
    counting = {name for name in done if planted[name].counts}
    assert len(counting) >= 8
    assert len(counting - others) <= 1, {name: planted[name] for name in counting - others}
    assert others <= done
