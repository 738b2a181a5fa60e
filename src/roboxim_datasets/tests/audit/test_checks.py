"""The audit's checks: each finds its fault and says nothing about clean episodes."""

from __future__ import annotations

from dataclasses import replace

import audited
import numpy as np
import pytest
from audited import found, texts, unchecked, with_truth

from roboxim_core.actions import ActionSemantics
from roboxim_datasets.audit import AUDIT_CHECKS, AuditEpisode


@pytest.mark.parametrize("name", AUDIT_CHECKS)
def test_every_check_conforms(name: str) -> None:
    AUDIT_CHECKS.check(name)


def test_clean_episodes_have_no_finding() -> None:
    episodes = [
        AuditEpisode(
            name=f"e{i}", split="train" if i % 4 else "val", arm=audited.KnownArm(), truth=audited.truth(),
            episode=audited.episode(i, stamps=np.arange(audited.STEPS) / 10.0),
        )
        for i in range(12)
    ]  # fmt: skip
    result = audited.audit(*episodes)
    assert result.clean
    assert [finding.text for _, finding in result.findings()] == []
    assert {check.name for check in result.checks if not check.checked} == {"content", "hidden_object", "replay"}


def test_a_dataset_alone_cannot_be_checked_for_what_needs_ground_truth() -> None:
    foreign = replace(audited.episode(), semantics=None, metadata={}, robot="", fps=0.0)
    result = audited.audit(foreign)
    reasons = {check.name: " ".join(check.unchecked) for check in result.checks if not check.checked}
    for name in ("continues_after_done", "inaccurate_control", "hidden_object", "indistinguishable", "collision"):
        assert "name the bags" in reasons[name]
    assert "recorded task" in reasons["wrong_instruction"]
    assert "declare" in reasons["gripper"]
    assert result.clean


@pytest.mark.parametrize("key", ["actions", "tcp_position", "tcp_rotation_6d", "joint_positions", "stamps"])
def test_a_number_that_is_not_finite_is_found_and_spoils_no_other_check(key: str) -> None:
    stamps = np.arange(audited.STEPS) / 10.0
    values = (stamps if key == "stamps" else audited.arrays(3)[key]).copy()
    values[7] = np.nan if key in ("actions", "stamps") else np.inf
    clean = [audited.episode(i, stamps=stamps) for i in range(3)]
    result = audited.audit(*clean, audited.episode(3, **{"stamps": stamps, key: values}))
    assert {finding.episodes for _, finding in result.findings() if finding.severity == "fault"} == {("e3",)}
    assert result.check("statistics").faulty_episodes == ("e3",)
    assert {check.checked for check in result.checks if check.name != "statistics"} == {0, 3}


def test_a_rotation_that_is_none_cannot_be_checked() -> None:
    assert "not a valid rotation_6d" in unchecked("labels", audited.episode(tcp_rotation_6d=np.zeros((60, 6), "f4")))


def test_clocks_with_a_late_tick() -> None:
    even = np.arange(audited.STEPS) / 10.0
    late = even.copy()
    late[30] += 0.002
    assert found("clock", audited.episode(stamps=late)) == ("e0",)
    assert not found("clock", audited.episode(stamps=even))
    hour = np.float32(3600 + even).astype(float)  # as LeRobot rounds them
    assert not found("clock", audited.episode(stamps=hour))
    assert "stamps" in unchecked("clock", audited.episode())


@pytest.mark.parametrize(
    ("until", "change", "faulty"), [(50, lambda c: np.roll(c, 20), ()), (100, lambda c: 1 - c, ("e0",))]
)
def test_a_gripper_that_follows_within_half_a_second_is_not_inverted(until, change, faulty) -> None:
    """At 50 Hz the fingers follow 0.4 s later; others do the opposite."""
    values, command = audited.arrays(0, 100), np.ones(100, np.float32)
    command[40:until] = 0.0
    actions = np.column_stack([values["actions"][:, :6], command])
    opening = change(command)[:, None]
    made = audited.episode(fps=50.0, **(values | {"actions": actions, "gripper_opening": opening}))
    assert found("gripper", made) == faulty


def test_slow_cameras_are_not_frozen() -> None:
    images = {name: [film[k - k % 2] for k in range(len(film))] for name, film in audited.arrays(0)["images"].items()}
    assert not found("frozen_camera", audited.episode(images=images))


def test_a_camera_may_repeat_its_image_while_the_arm_rests() -> None:
    values = audited.arrays(0)
    still = {name: [film[0]] * len(film) for name, film in values["images"].items()}
    resting = values["tcp_position"] * 0 + values["tcp_position"][:1]
    assert not found("frozen_camera", audited.episode(images=still, tcp_position=resting))
    assert found("frozen_camera", audited.episode(images=still)) == ("e0",)


def test_a_picture_that_hardly_changes_is_no_repeated_one_where_images_are_exact() -> None:
    films = audited.arrays(0)["images"]

    def held(ticks: int, *, equal: bool) -> AuditEpisode:
        """An episode whose film shows a tick for some more, with a few pixels that differ a little each time."""
        film = list(films["wrist"])
        for k in range(1, ticks):
            film[20 + k] = film[20].copy()
            film[20 + k][:2, :2] += np.uint8(0 if equal else 2 * (k % 2))
        images = {**films, "wrist": film}
        return AuditEpisode(name="e0", split="", episode=audited.episode(images=images))

    for exact, ticks, equal, faulty in (
        (True, 3, True, True),
        (True, 3, False, False),
        (True, 6, False, True),  # stored with loss before
        (False, 3, False, True),
    ):
        item = held(ticks, equal=equal)
        item.exact_images = exact
        assert bool(found("frozen_camera", item)) is faulty, (exact, ticks, equal)


def plain(film: list[np.ndarray], ticks: slice, brightness: float) -> list[np.ndarray]:
    """Return a film that shows, at some ticks, a surface without texture, with a little shading."""
    shading = np.linspace(-1.5, 1.5, film[0].shape[1])[None, :, None]
    surface = np.broadcast_to(brightness + shading, film[0].shape).round().astype(np.uint8)
    return [surface if k in range(*ticks.indices(len(film))) else image for k, image in enumerate(film)]


def test_a_camera_close_to_a_plain_surface_is_neither_blank_nor_frozen() -> None:
    for ticks, faulty in ((slice(20, 36), False), (slice(0, 60), True)):
        films = audited.arrays(0)["images"]
        images = {**films, "wrist": plain(films["wrist"], ticks, 215.0)}
        assert bool(found("blank_camera", audited.episode(images=images))) is faulty
        assert not found("frozen_camera", audited.episode(images=images))


def test_an_image_of_one_value_is_blank() -> None:
    films = audited.arrays(0)["images"]
    images = {**films, "wrist": [film * 0 if k == 7 else film for k, film in enumerate(films["wrist"])]}
    assert found("blank_camera", audited.episode(images=images)) == ("e0",)


def test_every_value_is_compared_with_what_it_should_be() -> None:
    values = audited.arrays(0)
    swapped = dict(zip(("workspace", "wrist"), reversed(values["images"].values()), strict=True))
    cases = {
        "1 tick late": {"tcp_position": np.vstack([values["tcp_position"][:1], values["tcp_position"][:-1]])},
        "those of episode e0": {"actions": audited.arrays(1)["actions"]},
        "should show at tick": {"images": swapped},
        "the instruction is": {"instruction": "Push the cube"},
    }
    first = AuditEpisode(name="e0", split="", episode=audited.episode(1), expected=audited.episode(1))
    assert not found("content", first)
    for words, changes in cases.items():
        item = AuditEpisode(name="e1", split="", episode=audited.episode(**changes), expected=audited.episode())
        assert found("content", first, item) == ("e1",)
        assert any(words in text for text in texts("content", first, item)), words
    assert "--bags" in unchecked("content", audited.episode())


def test_replay_errors() -> None:
    assert found("replay", with_truth(replay_error_m=(0.0, 0.002))) == ("e0",)
    assert not found("replay", with_truth(replay_error_m=(0.0, 0.0005)))
    assert "--replay" in unchecked("replay", with_truth())


def test_the_same_episode_again() -> None:
    again = AuditEpisode(name="again", split="val", episode=audited.episode(2))
    assert found("duplicate", audited.episode(1), audited.episode(2), again) == ("again",)
    assert found("split_leak", audited.episode(1), audited.episode(2), again) == ("again",)
    assert not found("duplicate", audited.episode(1), audited.episode(2))
    assert not found("split_leak", audited.episode(1), replace(again, episode=audited.episode(4)))


def test_other_images_of_the_same_actions_are_only_a_warning() -> None:
    other = {name: [255 - image for image in film] for name, film in audited.arrays(0)["images"].items()}
    result = audited.audit(audited.episode(), audited.episode(images=other), checks=("duplicate",))
    assert result.check("duplicate").status == "warnings"


def test_numbers_that_spoil_the_statistics() -> None:
    spiked = audited.arrays(0)["actions"].copy()
    spiked[30, 1] = 1.0
    every = [
        audited.episode(i, actions=audited.arrays(i)["actions"] + spiked - audited.arrays(0)["actions"])
        for i in range(6)
    ]
    assert found("statistics", audited.episode(actions=spiked), *(audited.episode(i) for i in range(1, 6))) == ("e0",)
    assert len(found("statistics", *every)) == 6, (
        "where every episode has an outlier, the standard deviation has it, too"
    )
    broken = audited.arrays(0)["tcp_position"].copy()
    broken[3, 0] = np.nan
    assert found("statistics", audited.episode(tcp_position=broken)) == ("e0",)


def test_constant_components_are_a_warning() -> None:
    actions = [audited.arrays(i)["actions"].copy() for i in range(3)]
    for values in actions:
        values[:, 4] = 0.0
    result = audited.audit(*(audited.episode(i, actions=a) for i, a in enumerate(actions)), checks=("statistics",))
    (finding,) = result.check("statistics").findings
    assert "[4] never change" in finding.text
    assert result.clean


def test_saturation_without_declared_limits_shows_at_the_extremes() -> None:
    clipped = np.clip(audited.arrays(0)["actions"], -0.005, 0.005)
    clipped[:, -1] = audited.arrays(0)["actions"][:, -1]
    assert found("saturation", replace(audited.episode(actions=clipped), semantics=None)) == ("e0",)
    assert not found("saturation", replace(audited.episode(), semantics=None))


def test_a_target_that_is_held_is_not_saturated() -> None:
    held = np.cumsum(audited.arrays(0)["actions"], axis=0).clip(-0.02, 0.02)
    absolute = ActionSemantics(control="end_effector_absolute")
    assert "absolute targets" in unchecked("saturation", replace(audited.episode(actions=held), semantics=absolute))


def test_an_unreadable_episode_is_reported_and_the_others_are_audited() -> None:
    short = replace(audited.episode(), length=99)
    result = audited.audit(short, audited.episode(1))
    assert list(result.unreadable) == ["e0"]
    assert "99" in result.unreadable["e0"]
    assert not result.clean
    assert result.check("idle").checked == 1
