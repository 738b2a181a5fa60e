"""Conventions of GR00T (DROID, Bridge, fractal), StarVLA, Cosmos3, DreamZero and X-VLA give what their sources state.

The expected values are literals, or formulas of the sources written out here.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from roboxim_core.actions import ActionContext
from roboxim_core.conventions import decode_actions, joined_answer, load_convention, observe, to_actions
from roboxim_core.policies import Observation
from roboxim_core.poses import Pose
from roboxim_core.proprioception import Proprioception

DOWN = Pose(position=(0.5, 0.0, 0.3), quat_xyzw=(1.0, 0.0, 0.0, 0.0))
AT_REST = ActionContext(
    pose_commanded=DOWN, pose_measured=DOWN, joints_commanded=(0.0,) * 7, joints_measured=(0.0,) * 7
)
JOINTS = (0.1, 0.2, 0.3, -1.4, 0.5, 1.6, 0.7)
HAND = Rotation.from_euler("xyz", [3.0, 0.2, 0.4])
"""A rotation of the tool near the one that points down."""


def request(name, opening=1.0, rotation=HAND):
    convention = load_convention(name)
    first, second = rotation.as_matrix().T[:2]
    proprio = Proprioception(
        tcp_position=(0.5, 0.1, 0.3), tcp_rotation_6d=(*first.tolist(), *second.tolist()),
        joint_names=tuple(f"joint{i}" for i in range(1, 8)), joint_positions=JOINTS, joint_velocities=(0.0,) * 7,
        gripper_opening=opening,
    )  # fmt: skip
    images = {
        camera.name: np.full((camera.height, camera.width, 3), 10 * number + 10, np.uint8)
        for number, camera in enumerate(convention.cameras)
    }
    observations = [Observation(seq=0, stamp_ns=0, images=images, proprio=proprio)]
    return observe(convention, observations, "Pick up the red cube")


def shapes(found):
    return {key: value.shape for key, value in found.items() if isinstance(value, np.ndarray)}


@pytest.mark.parametrize(
    ("name", "joints", "gripper", "pictures"),
    [
        ("groot_droid", "joint_position", "gripper_position", {
            "exterior_image_1_left": (16, 180, 320, 3), "wrist_image_left": (16, 180, 320, 3)}),
        ("cosmos3_droid", "observation/joint_position", "observation/gripper_position", {
            f"observation/{key}_left": (360, 640, 3)
            for key in ("exterior_image_1", "exterior_image_2", "wrist_image")}),
        ("dreamzero_droid", "observation/joint_position", "observation/gripper_position", {
            f"observation/{key}_left": (180, 320, 3)
            for key in ("exterior_image_0", "exterior_image_1", "wrist_image")}),
    ],
)  # fmt: skip
def test_droids_models_get_joints_and_answer_joint_positions_with_a_gripper_that_is_0_when_open(
    name, joints, gripper, pictures
):
    found, convention = request(name, 0.75), load_convention(name)
    assert {key: shape for key, shape in shapes(found).items() if "image" in key} == pictures
    np.testing.assert_allclose(np.atleast_2d(found[joints])[-1], JOINTS, atol=1e-6)
    np.testing.assert_allclose(np.atleast_2d(found[gripper])[-1], [0.25], atol=1e-6)
    assert found["prompt"] == "Pick up the red cube"
    assert (convention.rate_hz, convention.action.control) == (15, "joint_position")
    for number, opening in ((0.0, 1.0), (0.49, 1.0), (0.51, 0.0), (1.0, 0.0)):
        raw = [*JOINTS, number]
        np.testing.assert_allclose(to_actions(convention, raw, AT_REST), [[*JOINTS, opening]], atol=1e-12)


def test_external_cameras_of_cosmos3_and_dreamzero_are_two():
    for name in ("cosmos3_droid", "dreamzero_droid"):
        found = request(name)
        numbers = {int(value.flat[0]) for key, value in found.items() if "image" in key}
        assert len(numbers) == 3, name


def test_answers_have_their_keys_and_lengths():
    horizons = {"cosmos3_droid": 32, "dreamzero_droid": 24, "groot_droid": 40, "groot_bridge": 8, "xvla_libero": 30}
    assert {name: load_convention(name).chunking.horizon for name in horizons} == horizons
    assert load_convention("cosmos3_droid").action.keys == ("action",)
    answer = {"joint_position": np.ones((40, 7)), "gripper_position": np.zeros((40, 1)), "eef_9d": np.ones((40, 9))}
    assert joined_answer(load_convention("groot_droid"), answer).shape == (40, 8)


def test_groots_droid_pose_is_the_first_two_rows_after_the_datasets_correction():
    correction = np.array([[0, 0, -1], [-1, 0, 0], [0, 1, 0]])
    expected = (HAND.as_matrix() @ correction)[:2].ravel()
    np.testing.assert_allclose(request("groot_droid")["eef_9d"][-1], [0.5, 0.1, 0.3, *expected], atol=1e-6)


def test_groots_bridge_rotation_is_0_when_the_gripper_points_down_and_turns_as_the_base_does():
    down = request("groot_bridge", rotation=Rotation.from_quat([1, 0, 0, 0]))
    turned = request("groot_bridge", 0.3, Rotation.from_rotvec([0, 0.2, 0]) * Rotation.from_quat([1, 0, 0, 0]))
    assert [float(down[key][0]) for key in ("roll", "pitch", "yaw", "pad")] == pytest.approx([0, 0, 0, 0], abs=1e-6)
    assert [float(turned[key][0]) for key in ("roll", "pitch", "yaw")] == pytest.approx([0, 0.2, 0], abs=1e-6)
    assert float(turned["gripper"][0]) == pytest.approx(0.3, abs=1e-6)
    assert down["image_0"].shape == (256, 256, 3)


def test_groots_fractal_state_is_a_quaternion_and_a_gripper_that_is_1_when_closed():
    found = request("groot_fractal", 0.25)
    quaternion = [float(found[key][0]) for key in ("rx", "ry", "rz", "rw")]
    np.testing.assert_allclose(Rotation.from_quat(quaternion).as_matrix(), HAND.as_matrix(), atol=1e-6)
    assert float(found["gripper"][0]) == pytest.approx(0.75)
    assert found["image"].shape == (256, 320, 3)


def test_groots_fractal_gripper_stays_between_its_thresholds_and_15_steps_after_a_change():
    convention = load_convention("groot_fractal")
    raw = np.zeros((20, 7))
    raw[:, 6] = [0.7, 0.3, 0.2] + [0.9] * 17  # SimplerEnv: |2 g - 1| > 0.5 acts, and then for 15 steps
    openings = to_actions(convention, raw, _still(20))[:, 6]
    assert openings.tolist() == [1, 1] + [0] * 15 + [1] * 3


@pytest.mark.parametrize("name", ["groot_bridge", "groot_fractal"])
def test_groots_motions_are_metres_and_a_rotation_vector(name):
    numbers = [0.02, -0.03, 0.01, 0.1, -0.2, 0.15]
    roll_pitch_yaw = Rotation.from_rotvec(numbers[3:]).as_euler("xyz")
    found = to_actions(load_convention(name), [*numbers, 1.0], AT_REST)
    np.testing.assert_allclose(found, [[*numbers[:3], *roll_pitch_yaw, 1.0]], atol=1e-9)


def test_starvlas_bridge_motions_are_metres_and_extrinsic_angles():
    found = to_actions(load_convention("starvla_bridge"), [0.02, -0.03, 0.01, 0.1, -0.2, 0.15, 0.6], AT_REST)
    np.testing.assert_allclose(found, [[0.02, -0.03, 0.01, 0.1, -0.2, 0.15, 1.0]], atol=1e-9)
    assert shapes(request("starvla_bridge")) == {"image": (224, 224, 3)}


def test_starvlas_libero_motions_are_oscs_and_its_gripper_is_1_when_open():
    convention = load_convention("starvla_libero")
    found = to_actions(convention, [[1, 0, -0.5, 0, 0, 0.5, 0.6], [3, 0, 0, 0, 0, 0, 0.4]], _still(2))
    moved = [[0.262 * 0.05, 0, -0.263 * 0.025, 0, 0, 0.226 * 0.25, 1], [0.262 * 0.05, 0, 0, 0, 0, 0, 0]]
    np.testing.assert_allclose(found, moved, atol=1e-9)
    assert list(shapes(request("starvla_libero"))) == ["primary", "wrist_image"]


def _still(count):
    return [ActionContext(pose_commanded=DOWN, pose_measured=DOWN)] * count


def test_x_vlas_proprio_and_poses_are_in_the_frame_of_robosuites_controller():
    """In robosuite 1.4.1 ee_ori_mat is the matrix of robot0_eef_quat times the one below, as was measured there."""
    to_controller = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    found, convention = request("xvla_libero"), load_convention("xvla_libero")
    columns = (HAND.as_matrix() @ to_controller).T[:2].ravel()
    grip_site = np.array([-0.16, 0.1, 1.212]) + HAND.apply([0, 0, -0.0069])
    np.testing.assert_allclose(found["proprio"], [*grip_site, *columns, *[0] * 11], atol=1e-6)
    assert found["proprio"].dtype == np.float64
    assert (found["domain_id"], found["steps"], found["language_instruction"]) == (3, 10, "pick up the red cube")
    assert shapes(found) == {"image0": (256, 256, 3), "image1": (256, 256, 3), "proprio": (20,)}
    position, *rotation, opening = decode_poses(convention, [*found["proprio"][:9], 0.6, *[7.0] * 10])
    np.testing.assert_allclose(position, [0.5, 0.1, 0.3], atol=1e-6)
    np.testing.assert_allclose(rotation[0].as_matrix(), HAND.as_matrix(), atol=1e-6)
    assert opening < 0.5  # above 0.5 it closes


def decode_poses(convention, raw):
    row = decode_actions(convention, raw)[0]
    matrix = np.stack([row[3:6], row[6:9], np.cross(row[3:6], row[6:9])], axis=1)
    return row[:3], Rotation.from_matrix(matrix), row[-1]


def test_x_vlas_wrist_picture_is_upside_down_and_the_other_one_is_not():
    images = {image.key: image for image in load_convention("xvla_libero").images}
    assert [(images[key].mirror, images[key].upside_down) for key in ("image0", "image1")] == [
        (True, False),
        (False, True),
    ]


def test_rates():
    rates = {"groot_bridge": 5, "starvla_bridge": 5, "groot_fractal": 3, "starvla_libero": 20, "xvla_libero": 20}
    assert {name: load_convention(name).rate_hz for name in rates} == rates
