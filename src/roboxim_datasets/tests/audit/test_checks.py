"""The audit's checks: each finds its fault and says nothing about clean episodes."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import audited
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from roboxim_core.actions import ActionSemantics
from roboxim_datasets.audit import (
    AUDIT_CHECKS,
    Approach,
    AuditEpisode,
    ColorPair,
    Meaning,
    Sighting,
    Touch,
)
from roboxim_datasets.audit.color import color_difference, palette_difference


def found(check: str, *episodes: Any) -> tuple[str, ...]:
    """Return the episodes in which a check finds a fault."""
    return audited.audit(*episodes, checks=(check,)).check(check).faulty_episodes


def unchecked(check: str, *episodes: Any) -> str:
    """Return the only reason why a check could not be made."""
    result = audited.audit(*episodes, checks=(check,)).check(check)
    (reason,) = result.unchecked
    assert result.status == "unchecked"
    return reason


def with_truth(name: str = "e0", **changes: Any) -> AuditEpisode:
    """Return a clean episode with ground truth."""
    return AuditEpisode(name=name, split="", episode=audited.episode(), truth=audited.truth(**changes))


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


# ------------------------------------------------------------------ the six faults of thesis 6.1.2


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


def absolute(angles: np.ndarray, rotation: str) -> Any:
    """Return an episode with absolute actions whose rotation is given."""
    values = np.column_stack([audited.arrays(0, len(angles))["tcp_position"], angles, np.ones(len(angles))])
    semantics = ActionSemantics(control="end_effector_absolute", rotation=rotation)  # type: ignore[arg-type]
    episode = audited.episode(**audited.arrays(0, len(angles)) | {"actions": values.astype(np.float32)})
    return replace(episode, semantics=semantics)


def test_angles_that_jump_at_pi() -> None:
    roll = np.linspace(3.0, 3.3, 20)
    smooth = np.column_stack([roll, np.zeros(20), np.zeros(20)])
    wrapped = (smooth + np.pi) % (2 * np.pi) - np.pi
    assert found("rotation_jump", absolute(wrapped, "euler_xyz_extrinsic")) == ("e0",)
    assert not found("rotation_jump", absolute(smooth, "euler_xyz_extrinsic"))


def test_a_real_half_turn_is_no_jump() -> None:
    turned = np.zeros((20, 3))
    turned[10:, 2] = 3.3
    assert not found("rotation_jump", absolute(turned, "euler_xyz_extrinsic"))


@pytest.mark.parametrize("rotation", ["quaternion_xyzw", "quaternion_wxyz"])
def test_quaternions_that_flip(rotation: str) -> None:
    quaternions = Rotation.from_euler("z", np.linspace(0, 1, 20)[:, None]).as_quat()
    flipped = quaternions.copy()
    flipped[12:] *= -1
    if rotation == "quaternion_wxyz":
        quaternions, flipped = np.roll(quaternions, 1, axis=1), np.roll(flipped, 1, axis=1)
    assert found("rotation_jump", absolute(flipped, rotation)) == ("e0",)
    assert not found("rotation_jump", absolute(quaternions, rotation))


def test_episodes_that_start_on_two_sides_of_the_seam() -> None:
    up = np.column_stack([np.full(20, 3.1), np.zeros(20), np.zeros(20)])
    down = up - np.array([2 * np.pi, 0, 0])
    assert found("rotation_jump", absolute(up, "euler_xyz_extrinsic"), absolute(down, "euler_xyz_extrinsic")) == ("e1",)


def test_jumps_in_a_foreign_state_of_unknown_meaning() -> None:
    quaternions = Rotation.from_euler("z", np.linspace(0, 1, 60)[:, None]).as_quat()
    quaternions[30:] *= -1

    def foreign(rotation: np.ndarray) -> Any:
        clean = audited.episode()
        names = {"state": tuple(f"s{i}" for i in range(3 + rotation.shape[1]))}
        steps = [replace(step, proprio={"state": np.r_[np.float32([0.1, 0.2, 0.3]), row].astype(np.float32)})
                 for step, row in zip(clean.steps(), rotation, strict=True)]  # fmt: skip
        return replace(clean, vectors=names, semantics=None, read=lambda wanted: iter(steps))

    assert found("rotation_jump", foreign(quaternions)) == ("e0",)
    angles = np.column_stack([np.linspace(3.0, 3.3, 60)] * 3)
    assert found("rotation_jump", foreign((angles + np.pi) % (2 * np.pi) - np.pi)) == ("e0",)
    assert not found("rotation_jump", foreign(angles))


# ------------------------------------------------------------------ further checks


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


def test_a_lag_is_not_told_from_a_few_ticks() -> None:
    assert "too short" in unchecked("state_lag", audited.episode(3, **audited.arrays(3, 20)))
    assert not found("state_lag", audited.episode(3, **audited.arrays(3, 26)))


@pytest.mark.parametrize("lag", [-2, 1, 3])
def test_lags_of_the_state_are_measured(lag: int) -> None:
    films = audited.arrays(3)["images"]
    at = np.clip(np.arange(audited.STEPS) + lag, 0, audited.STEPS - 1)
    images = {name: [film[k] for k in at] for name, film in films.items()}
    result = audited.audit(audited.episode(3, images=images), checks=("state_lag",)).check("state_lag")
    (finding,) = result.findings
    assert f"{abs(lag)} tick" in finding.text
    assert ("late" if lag > 0 else "early") in finding.text


def test_contacts_that_no_demonstration_should_have() -> None:
    hit = Touch(tick=7, bodies="robot and table", force_n=40.0)
    assert found("collision", with_truth(touches=(hit,))) == ("e0",)
    assert not found("collision", with_truth(touches=(replace(hit, force_n=2.0),)))


def test_joints_lead_to_the_recorded_pose_and_keep_the_limits() -> None:
    right = AuditEpisode(name="e0", split="", episode=audited.episode(), arm=audited.KnownArm())
    assert not found("kinematics", right)
    late = np.roll(audited.arrays(0)["joint_positions"], 1, axis=0)
    assert found("kinematics", replace(right, episode=audited.episode(joint_positions=late))) == ("e0",)
    arm = audited.KnownArm()
    arm.lower, arm.upper = np.full(7, -0.01), np.full(7, 0.01)
    assert "beyond its limit" in texts("kinematics", replace(right, arm=arm))[0]
    assert "not known" in unchecked("kinematics", audited.episode())


def texts(check: str, *episodes: Any) -> list[str]:
    """Return what a check says."""
    return [finding.text for finding in audited.audit(*episodes, checks=(check,)).check(check).findings]


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (lambda rows: np.roll(rows, 1, axis=0), "1 tick late"),
        (lambda rows: rows * np.float32([1.15, 1.15, 1.15, 1, 1, 1, 1]), "scaled by 1.15"),
        (lambda rows: rows[:, [1, 0, 2, 3, 4, 5, 6]], "y, x, z"),
        (lambda rows: rows * np.float32([-1, 1, 1, 1, 1, 1, 1]), "the sign of x"),
    ],
)
def test_actions_that_the_motion_does_not_follow_are_found_and_the_edit_is_named(edit: Any, words: str) -> None:
    edited = audited.episode(actions=edit(audited.arrays(0)["actions"]))
    others = [audited.episode(number) for number in range(1, 8)]
    assert found("motion", edited, *others) == ("e0",)
    assert words in texts("motion", edited, *others)[0]


def test_labels_are_what_was_executed_where_no_noise_was_injected() -> None:
    clean = audited.episode()
    labels = audited.arrays(0)["actions"].copy()
    labels[20, 0] += 0.003
    assert found("labels", relabelled(clean, labels)) == ("e0",)
    labels = audited.arrays(0)["actions"].copy()
    labels[30:, 6] = 1.0
    assert "gripper" in texts("labels", relabelled(clean, labels))[0]
    assert not found("labels", clean)


def test_noise_of_two_ticks_moves_position_and_rotation() -> None:
    labels = audited.arrays(0)["actions"].copy()
    labels[20:22, 0] += (0.003, -0.004)
    assert found("labels", relabelled(audited.episode(), labels)) == ("e0",)
    labels[20:22, 4] += (-0.02, 0.015)
    assert not found("labels", relabelled(audited.episode(), labels))


@pytest.mark.thorough
def test_an_arm_that_a_contact_pushes_aside_for_a_tick_is_a_warning() -> None:
    others = [audited.episode(seed) for seed in range(1, 12)]
    for push, faulty in ((0.003, ()), (0.02, ("e0",))):
        place = audited.arrays(0)["tcp_position"].copy()
        place[20, 1] += push
        pushed = audited.episode(tcp_position=place)
        assert found("motion", pushed, *others) == faulty
        assert "measured motion and actions differ" in texts("motion", pushed, *others)[0]
    place = audited.arrays(0)["tcp_position"].copy()
    place[20:22, 1] += 0.003  # the arm stays aside, as no contact of one tick leaves it
    assert found("motion", audited.episode(tcp_position=place), *others) == ("e0",)


def test_an_arm_whose_joint_is_as_fast_as_it_can_falls_behind_and_catches_up() -> None:
    others = [audited.episode(seed) for seed in range(1, 12)]
    place, joints = audited.arrays(0)["tcp_position"].copy(), audited.arrays(0)["joint_positions"].copy()
    place[20, 1] += 0.008 * np.sign(place[19, 1] - place[20, 1])
    joints[20:, 3] += 0.2
    arm = audited.KnownArm()
    arm.velocity = np.full(7, 1e3)
    for at_limit, faulty in ((True, ()), (False, ("e0",))):
        arm.velocity[3] = abs(joints[20, 3] - joints[19, 3]) * 10 if at_limit else 1e3
        episode = audited.episode(tcp_position=place, joint_positions=joints)
        assert found("motion", AuditEpisode(name="e0", split="", episode=episode, arm=arm), *others) == faulty


@pytest.mark.thorough
def test_a_jolt_of_an_arm_whose_joint_is_at_its_position_limit_is_a_warning() -> None:
    others = [audited.episode(seed) for seed in range(1, 12)]
    place, joints = audited.arrays(0)["tcp_position"].copy(), audited.arrays(0)["joint_positions"].copy()
    place[20:, 1] += 0.03
    arm = audited.KnownArm()
    for value, faulty in ((arm.upper[4] - 0.001, ()), (arm.upper[4] - 0.1, ("e0",))):
        joints[19:21, 4] = value
        episode = audited.episode(tcp_position=place, joint_positions=joints)
        made = AuditEpisode(name="e0", split="", episode=episode, arm=arm)
        assert found("motion", made, *others) == faulty
        assert ("at its position limit" in texts("motion", made, *others)[0]) == (not faulty)


def relabelled(episode: Any, labels: np.ndarray) -> Any:
    """Return an episode with other labels, of which the executed actions stay."""

    def read(wanted: Any) -> Any:
        return (replace(step, action=labels[step.index]) for step in episode.read(wanted))

    return replace(episode, read=read)


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
