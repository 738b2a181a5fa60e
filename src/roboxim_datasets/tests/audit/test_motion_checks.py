"""The audit's checks of motion: rotations that jump, lags, limits, and actions that the arm does not follow."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import audited
import numpy as np
import pytest
from audited import found, texts, unchecked, with_truth
from scipy.spatial.transform import Rotation

from roboxim_core.actions import ActionSemantics
from roboxim_datasets.audit import AuditEpisode, Touch


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
