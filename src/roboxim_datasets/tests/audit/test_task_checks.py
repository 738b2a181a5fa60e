"""The audit's checks of what was done: the task, behaviour, instructions, and objects that can be seen."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import audited
import pytest
from audited import found, texts, unchecked, with_truth

from roboxim_datasets.audit import Approach, AuditEpisode, ColorPair, Meaning, Sighting
from roboxim_datasets.audit.color import color_difference, palette_difference


@pytest.mark.parametrize(
    ("solved", "faulty"),
    [
        ((False,) * 60 + (True,), False),
        ((False,) * 54 + (True,) * 7, False),  # a tenth of the ticks
        ((False,) * 53 + (True,) * 8, True),
        ((False,) * 40 + (True,) * 10 + (False,) * 11, True),  # lost again
        ((False,) * 66 + (True,) * 5, False),  # solved while it settles
    ],
)
def test_ticks_after_the_task_is_done(solved: tuple[bool, ...], faulty: bool) -> None:
    assert bool(found("continues_after_done", with_truth(solved=solved))) == faulty


def test_a_second_after_the_task_is_done_is_too_much_in_a_long_episode() -> None:
    steps = 200

    def long(after: int) -> AuditEpisode:
        solved = (False,) * (steps - after) + (True,) * (after + 1)
        values = audited.arrays(0, steps)
        return AuditEpisode(name="e0", split="", episode=audited.episode(**values), truth=audited.truth(solved=solved))

    assert found("continues_after_done", long(11)) == ("e0",)
    assert not found("continues_after_done", long(10))


def approach(**changes: Any) -> Approach:
    """Return a clean approach with changes."""
    (clean,) = audited.truth().approaches
    assert clean is not None
    return replace(clean, **changes)


@pytest.mark.parametrize(
    "changes",
    [
        {"closings": 2},
        {"recovered": True},
        {"path_m": 1.5},
        {"distance_m": (0.4, 0.2, 0.04, 0.07, 0.02, 0.0)},
    ],
)
def test_misses_and_corrections(changes: dict[str, Any]) -> None:
    assert found("inaccurate_control", with_truth(approaches=(approach(**changes),))) == ("e0",)


def test_a_detour_far_from_the_object_is_no_miss() -> None:
    assert not found("inaccurate_control", with_truth(approaches=(approach(distance_m=(0.4, 0.2, 0.3, 0.1, 0.0)),)))


def sighting(**changes: Any) -> Sighting:
    """Return a camera's view of a well visible cube, with changes."""
    seen = Sighting(camera="workspace", fixed=True, thing="cube", tick=0, pixels=400.0, share=1.0)
    return replace(seen, **changes)


@pytest.mark.parametrize("hidden", [{"share": 0.2}, {"pixels": 40.0}])
def test_objects_that_a_fixed_camera_does_not_see_at_the_start(hidden: dict[str, float]) -> None:
    assert found("hidden_object", with_truth(sightings=(sighting(**hidden),))) == ("e0",)
    in_the_hand = sighting(camera="wrist", fixed=False, **hidden)
    assert not found("hidden_object", with_truth(sightings=(sighting(), in_the_hand)))


def test_an_object_that_no_camera_sees_on_the_way_to_it() -> None:
    def seen(hidden_ticks: int) -> tuple[Sighting, ...]:
        return tuple(
            sighting(
                tick=tick, camera=camera, fixed=camera == "workspace", share=0.1 if 0 < tick <= hidden_ticks else 1.0
            )
            for tick in range(10)
            for camera in ("workspace", "wrist")
        )

    assert found("hidden_object", with_truth(sightings=seen(4))) == ("e0",)
    assert not found("hidden_object", with_truth(sightings=seen(2)))


def worded(instruction: str, relabelled: str = "") -> AuditEpisode:
    """Return an episode of a dataset whose convention lowers case, and which says that it relabelled the episode."""
    episode = audited.episode(instruction=instruction)
    return AuditEpisode(name="e0", split="", episode=episode, relabelled=relabelled, prompt=str.lower)


def test_instructions_that_the_episode_does_not_carry_out() -> None:
    wrong = with_truth(meaning=Meaning(ever=False, detail="the scene has no apple"))
    assert found("wrong_instruction", wrong, with_truth(name="e1")) == ("e0",)
    exported = audited.episode(instruction="Pick up the apple")
    assert found("wrong_instruction", exported, audited.episode()) == ("e0",)
    assert found("wrong_instruction", audited.episode(instruction=" ")) == ("e0",)
    assert not found("wrong_instruction", worded("pick up the cube"), worded("Touch it", "Touch it"))
    assert not found("wrong_instruction", worded("touch it", "Touch it"))
    assert found("wrong_instruction", worded("pick up the cube", "Touch it")) == ("e0",)


def test_objects_of_one_colour() -> None:
    def pair(difference: float) -> ColorPair:
        return ColorPair(camera="workspace", named="red cube", other="orange cube", difference=difference)

    check = "indistinguishable"
    assert found(check, with_truth(pairs=(pair(9.0),))) == ("e0",)
    warned = audited.audit(with_truth(pairs=(pair(14.0),)), checks=(check,)).check(check)
    assert (warned.status, len(warned.findings)) == ("warnings", 1)
    assert not audited.audit(with_truth(pairs=(pair(30.0),)), checks=(check,)).check(check).findings


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [  # Sharma, Wu and Dalal 2005, table 1
        ((50.0, 2.6772, -79.7751), (50.0, 0.0, -82.7485), 2.0425),
        ((50.0, -1.3802, -84.2814), (50.0, 0.0, -82.7485), 1.0),
        ((50.0, 2.49, -0.001), (50.0, -2.49, 0.0011), 7.2195),
        ((50.0, -0.001, 2.49), (50.0, 0.0011, -2.49), 4.7461),
        ((50.0, 2.5, 0.0), (61.0, -5.0, 29.0), 22.8977),
        ((2.0776, 0.0795, -1.1350), (0.9033, -0.0636, -0.5514), 0.9082),
    ],
)
def test_colour_difference_equals_the_published_values(first: Any, second: Any, expected: float) -> None:
    assert color_difference(first, second) == pytest.approx(expected, abs=1e-4)
    assert color_difference(second, first) == pytest.approx(expected, abs=1e-4)


def test_objects_differ_by_the_colours_of_their_parts() -> None:
    housing, red, blue = [(220, 215, 205)] * 70, [(200, 20, 20)] * 30, [(30, 60, 200)] * 30
    glare = [(255, 255, 255)] * 5
    assert palette_difference(housing + red, housing + blue) > 40  # as two buttons whose caps alone differ
    assert palette_difference(housing + red, housing + glare + red + red) < 1
    assert palette_difference(red, [(190, 22, 21)] * 900) < 5


def test_failed_rollouts_are_no_wrong_instructions() -> None:
    failed = with_truth(meaning=Meaning(ever=False))
    failed = replace(failed, episode=replace(failed.episode, success=False))
    assert "failed" in unchecked("wrong_instruction", failed)


def drawn(number: int, target: str, skill: str = "pick_up", run: int = 0) -> Any:
    """Return an episode whose recorded task says what was drawn for its scene."""
    made = audited.episode(number)
    task = json.dumps({"skill": skill, "instruction": "Pick up the cube", "drawn": {"target": target}})
    return replace(made, metadata={**made.metadata, "run_seed": run, "task": task})


def test_a_task_of_another_run_is_found() -> None:
    episodes = [drawn(number, str(number)) for number in range(8)]
    assert not found("recorded_task", *episodes)
    assert found("recorded_task", *episodes[:7], drawn(7, "7", "push")) == ("e7",)
    mixed = [drawn(number, str(number), "push" if number % 2 else "pick_up") for number in range(8)]
    assert not found("recorded_task", *mixed)


def test_a_task_that_two_episodes_record_is_found() -> None:
    episodes = [drawn(number, str(number)) for number in range(8)]
    (text,) = texts("recorded_task", *episodes, drawn(8, "3"))
    assert "one recorded task" in text or "has the recorded task of" in text
    still = audited.arrays(9)["tcp_position"] * 0 + 0.1
    other = replace(drawn(9, "3"), read=audited.episode(9, tcp_position=still).read)
    assert not found("recorded_task", *episodes, other), "of one skill, how it moves tells nothing"
    pushes = [drawn(number, str(number), "push") for number in (10, 11)]
    assert found("recorded_task", *episodes, other, *pushes) == ("e8",)
    assert not found("recorded_task", *(drawn(number, "3") for number in range(8))), "nothing is drawn there"
    plain = audited.episode()
    assert "recorded task" in unchecked("recorded_task", replace(plain, metadata={}))
