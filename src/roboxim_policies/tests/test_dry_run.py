"""The dry run names each classic fault, and nothing when an answer is the expert's."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from roboxim_core.actions.transforms import ActionContext
from roboxim_core.conventions import load_convention
from roboxim_core.poses import Pose
from roboxim_policies.dry_run import Answers, proven, round_trip, suspicions

LIBERO, BRIDGE, ROBOXIM = (load_convention(name) for name in ("libero", "bridge", "roboxim"))
EXPERT = np.array([[0.01, 0.005 * i, -0.01, 0.02, 0.01 * i, 0.0, i % 2] for i in range(6)])
SPEED = 0.3
JOINTS = np.array([0.0, -0.8, 0.0, -2.4, 0.0, 1.6, 0.8]) + np.linspace(0, 0.3, 6)[:, None]
JOINT_SPEED = 0.5


def answers(raw, convention=LIBERO, picture=None):
    seen = np.random.default_rng(0).integers(0, 256, (224, 224, 3), dtype=np.uint8) if picture is None else picture
    sent = {image.key: seen[:, ::-1] if image.mirror else seen for image in convention.images}
    return Answers(
        raw=[np.atleast_2d(row) for row in raw], pictures=sent, upright=dict.fromkeys(sent, seen), expert=EXPERT,
        expert_speed=SPEED, joints=JOINTS,
        expert_joint_speed=JOINT_SPEED,
    )  # fmt: skip


def honest():
    """Return the expert's actions in LIBERO's numbers, about."""
    raw = EXPERT / np.array([0.0125] * 3 + [0.125] * 3 + [1.0])
    raw[:, 6] = 1 - 2 * EXPERT[:, 6]  # -1 opens
    return raw


def test_expert_itself_is_not_suspicious():
    assert suspicions(LIBERO, answers(honest())) == []


def changed(column, value):
    raw = honest()
    raw[:, column] = value
    return raw


@pytest.mark.parametrize(
    ("raw", "words"),
    [
        (np.repeat(honest()[:1], 6, axis=0), "constant: the answers to 6 different observations"),
        (np.sign(honest()), "saturated: "),
        (changed(slice(3, 6), 0.0), "all rotations are exactly zero"),
        (changed(6, 2 * EXPERT[:, 6] - 1), "inverted gripper"),
        (changed(slice(0, 3), 0.0), "does not move"),
        (honest() * np.array([0.01] * 3 + [1] * 4), "wrong rate or scale"),
    ],
)
def test_classic_fault_is_named(raw, words):
    assert any(words in found for found in suspicions(LIBERO, answers(raw)))


def test_numbers_that_are_still_normalised_are_named():
    raw = np.random.default_rng(0).uniform(-1, 1, (6, 7))
    assert any("un-normalised?" in found for found in suspicions(BRIDGE, answers(raw, BRIDGE)))


DROID_VELOCITY, DROID_POSITION = (load_convention(name) for name in ("droid_velocity", "droid_position"))
GRIPPER = 1 - EXPERT[:, 6:]  # DROID's 0 is open
POSITIONS = np.hstack([JOINTS + 0.02, GRIPPER])
VELOCITIES = np.hstack([np.linspace(0.02, 0.1, 42).reshape(6, 7), GRIPPER])


@pytest.mark.parametrize(
    ("convention", "raw", "words"),
    [
        (DROID_POSITION, POSITIONS, ""),
        (DROID_POSITION, POSITIONS * ([0.3] * 7 + [1]), "un-normalised. a joint is commanded to a position 1.7 rad"),
        (DROID_POSITION, POSITIONS[:, [6, 5, 4, 3, 2, 1, 0, 7]], "another order of the joints"),
        (DROID_VELOCITY, VELOCITIES, ""),
        (DROID_VELOCITY, VELOCITIES * ([0.05] * 7 + [1]), "wrong rate or scale.*rad/s.*states 15 Hz"),
        (DROID_VELOCITY, VELOCITIES * ([0] * 7 + [1]), "does not move"),
    ],
)
def test_faults_of_joint_actions_are_named(convention, raw, words):
    found = suspicions(convention, answers(raw, convention))
    assert len(found) == bool(words), found
    assert re.search(words, " ".join(found))


def test_arm_with_another_number_of_joints_is_named():
    six = replace(answers(POSITIONS, DROID_POSITION), joints=JOINTS[:, :6])
    assert suspicions(DROID_POSITION, six) == ["the convention commands 7 joints, the robot has 6"]


def test_pictures_that_are_not_mirrored_as_the_genuine_clients_are_named():
    """Test the convention as it was before its comparison with genuine clients, and a user's own without a proof."""
    unmirrored = replace(LIBERO, proof=None, name="mine")
    unmirrored = replace(unmirrored, images=tuple(replace(image, mirror=False) for image in LIBERO.images))
    found = suspicions(unmirrored, answers(honest(), unmirrored))
    assert len(found) == 2
    assert "sent upright; the genuine client sends it mirrored" in found[0]
    assert "Give it mirror: true" in found[0]
    assert suspicions(replace(LIBERO, proof=None, name="mine"), answers(honest())) == []


@pytest.mark.parametrize(
    ("lies", "words"),
    [
        ((slice(None, None, -1), slice(None)), "turned by 180 degrees"),
        ((slice(None, None, -1), slice(None, None, -1)), "upside down"),
    ],
)
def test_turned_and_upside_down_pictures_are_named(lies, words):
    good = answers(honest())
    turned = replace(good, pictures={key: picture[lies] for key, picture in good.pictures.items()})
    assert f"is sent {words}" in suspicions(LIBERO, turned)[0]


def test_conventions_without_a_proof_and_of_other_numbers_are_not_compared():
    assert proven(ROBOXIM) is None
    assert proven(replace(LIBERO, proof=None)) == LIBERO


def test_empty_pictures_are_named():
    black = answers(honest(), picture=np.zeros((224, 224, 3), np.uint8))
    assert "shows nothing" in suspicions(LIBERO, black)[0]


def track(count):
    rng = np.random.default_rng(1)
    rotations = Rotation.from_rotvec(rng.normal(size=(count, 3)) * 0.1) * Rotation.from_quat([1.0, 0.0, 0.0, 0.0])
    poses = map(Pose.from_arrays, rng.normal(size=(count, 3)), rotations)
    return [ActionContext(pose_commanded=pose, pose_measured=pose) for pose in poses]


@pytest.mark.parametrize("convention", [LIBERO, BRIDGE, ROBOXIM])
def test_actions_of_the_expert_come_back(convention):
    slow = EXPERT * ([0.4] * 6 + [1]) if convention.action.response else EXPERT  # as fast as LIBERO's arm can be
    found = round_trip(convention, slow, track(len(EXPERT)))
    assert found.is_exact, str(found)
    assert found.count == 6


def test_action_that_the_policy_cannot_say_is_counted():
    far = EXPERT * np.array([10.0] + [1] * 6)
    found = round_trip(LIBERO, far, track(len(EXPERT)))
    assert found.clipped == 6
    assert "beyond the policy's range" in str(found)
    assert not found.is_exact
