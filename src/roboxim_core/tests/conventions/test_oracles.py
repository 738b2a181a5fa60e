"""Every shipped convention gives the numbers that its source states.

The expected values are literals, or matrices written out here; none of them comes from our transforms.
"""

from dataclasses import replace
from math import cos, pi, sin, sqrt

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from roboxim_core.actions import ActionContext, MotionLag
from roboxim_core.config_folders import config_names
from roboxim_core.conventions import ArmReadings, decode_actions, load_convention, observe, to_actions
from roboxim_core.policies import Observation
from roboxim_core.poses import Pose
from roboxim_core.proprioception import Proprioception

DOWN = Pose(position=(0.5, 0.0, 0.3), quat_xyzw=(1.0, 0.0, 0.0, 0.0))
LAGGING = Pose(position=(0.49, 0.0, 0.3), quat_xyzw=(1.0, 0.0, 0.0, 0.0))
"""Measured pose, 10 mm behind the commanded one in x."""
AT_REST = ActionContext(
    pose_commanded=DOWN, pose_measured=DOWN, joints_commanded=(0.0,) * 7, joints_measured=(0.0,) * 7
)

OSC = {  # robosuite's osc_pose.json: 1 is 0.05 m, 0.5 rad, of which its arm moves a quarter per step of steady motion
    (1, 0, 0, 0, 0, 0): (0.262 * 0.05, 0, 0, 0, 0, 0),
    (0, -1, 0, 0, 0, 0): (0, -0.249 * 0.05, 0, 0, 0, 0),
    (0, 0, 0.5, 0, 0, 0): (0, 0, 0.263 * 0.025, 0, 0, 0),
    (0, 0, 0, 1, 0, 0): (0, 0, 0, 0.251 * 0.5, 0, 0),
    (0, 0, 0, 0, -0.2, 0): (0, 0, 0, 0, -0.230 * 0.1, 0),
    (0, 0, 0, 0, 0, 1): (0, 0, 0, 0, 0, 0.226 * 0.5),
    (3, 0, 0, 0, 0, -3): (0.262 * 0.05, 0, 0, 0, 0, -0.226 * 0.5),  # OSC clips its input to [-1, 1]
}
METRES = {  # metres and radians as they are
    (0.02, 0, 0, 0, 0, 0): (0.02, 0, 0, 0, 0, 0),
    (0, 0.03, 0, 0, 0, 0): (0, 0.03, 0, 0, 0, 0),
    (0, 0, -0.04, 0, 0, 0): (0, 0, -0.04, 0, 0, 0),
    (0, 0, 0, 0.1, 0, 0): (0, 0, 0, 0.1, 0, 0),
    (0, 0, 0, 0, 0.2, 0): (0, 0, 0, 0, 0.2, 0),
    (0, 0, 0, 0, 0, -0.3): (0, 0, 0, 0, 0, -0.3),
}
RT1 = {  # SimplerEnv: 1.75 is 0.05 m and 1.4 is 0.25 rad, clipped
    (1.75, 0, 0, 0, 0, 0): (0.05, 0, 0, 0, 0, 0),
    (0, -0.875, 0, 0, 0, 0): (0, -0.025, 0, 0, 0, 0),
    (0, 0, 2.0, 0, 0, 0): (0, 0, 0.05, 0, 0, 0),
    (0, 0, 0, 1.4, 0, 0): (0, 0, 0, 0.25, 0, 0),
    (0, 0, 0, 0, -0.7, 0): (0, 0, 0, 0, -0.125, 0),
    (0, 0, 0, 0, 0, 1.57): (0, 0, 0, 0, 0, 0.25),
}
UNITY = {  # x right, y up, z forward, left-handed: positive turns are the other way round
    (0.02, 0, 0, 0, 0, 0): (0, -0.02, 0, 0, 0, 0),
    (0, 0.03, 0, 0, 0, 0): (0, 0, 0.03, 0, 0, 0),
    (0, 0, -0.04, 0, 0, 0): (-0.04, 0, 0, 0, 0, 0),
    (0, 0, 0, 0.1, 0, 0): (0, 0, 0, 0, 0.1, 0),
    (0, 0, 0, 0, 0.2, 0): (0, 0, 0, 0, 0, -0.2),
    (0, 0, 0, 0, 0, -0.3): (0, 0, 0, 0.3, 0, 0),
}
OCTO = ["octo_bridge", "octo_fractal", "octo_two_cameras", "octo_finetuned"]
MOTIONS = {
    **dict.fromkeys(["libero", "oft_libero", "openvla_libero", "groot_libero", "vla_eval_libero"], OSC),
    **dict.fromkeys(["bridge", "fractal", *OCTO, "roboxim", "rt1_fractal"], METRES),
    "rt1_widowx": RT1,
    "unity": UNITY,
}
JOINT_MOTIONS = {  # DROID: a velocity of 1 is 0.2 rad per step, clipped to [-1, 1]; positions are radians
    "droid_velocity": {1.0: 0.2, -0.5: -0.1, 1.5: 0.2},
    "roboarena_joint_velocity": {1.0: 0.2, -0.5: -0.1, 1.5: 0.2},
    "droid_position": {1.0: 1.0, -2.5: -2.5},
    "roboarena_joint_position": {1.0: 1.0, -2.5: -2.5},
}
GRIPPERS = {  # number to opening, 1 = open
    "libero": {-1.0: 1, 1.0: 0, -0.1: 1, 0.1: 0},
    "vla_eval_libero": {-1.0: 1, 1.0: 0, -0.1: 1, 0.1: 0},
    **dict.fromkeys(["oft_libero", "openvla_libero", "groot_libero"], {1.0: 1, 0.0: 0, 0.6: 1, 0.4: 0}),
    **dict.fromkeys(
        ["bridge", "octo_bridge", "octo_two_cameras", "octo_finetuned"],
        {1.0: 1, 0.0: 0, 0.51: 1, 0.49: 0, 1.3: 1, -0.2: 0},
    ),
    **dict.fromkeys(
        ["droid_velocity", "droid_position", "roboarena_joint_velocity", "roboarena_joint_position"],
        {0.0: 1, 1.0: 0, 0.49: 1, 0.51: 0},
    ),
    "rt1_widowx": {-1.0: 1, 1.0: 0, -0.2: 1, 0.2: 0},
    "rt1_fractal": {-1.0: 1, 1.0: 0, -0.02: 1, 0.02: 0},
    **dict.fromkeys(["roboxim", "unity"], {1.0: 1, 0.0: 0, 0.25: 0.25}),
}
RATES = {
    **dict.fromkeys(["libero", "oft_libero", "openvla_libero", "groot_libero", "vla_eval_libero"], 20),
    **dict.fromkeys(["bridge", "octo_bridge", "octo_two_cameras"], 5),
    **dict.fromkeys(["fractal", "octo_fractal", "rt1_widowx", "rt1_fractal"], 3),
    **dict.fromkeys(JOINT_MOTIONS, 15),
    "octo_finetuned": 10,
    **dict.fromkeys(["roboxim", "unity"], 0),
}
BASES = {  # what a delta is added to
    **dict.fromkeys(MOTIONS, "measured"),
    **dict.fromkeys(["bridge", "octo_bridge", "octo_two_cameras", "octo_finetuned", "rt1_widowx"], "commanded"),
    **dict.fromkeys(["roboxim", "unity", *(name for name in MOTIONS if MOTIONS[name] is OSC)], "commanded"),
}


IN_FAMILIES = {  # whose oracles are in test_families.py
    "cosmos3_droid", "dreamzero_droid", "groot_bridge", "groot_droid", "groot_fractal", "starvla_bridge",
    "starvla_libero", "xvla_libero",
}  # fmt: skip


def test_every_shipped_convention_has_an_oracle():
    shipped = set(config_names("conventions"))
    assert shipped >= IN_FAMILIES
    shipped -= IN_FAMILIES
    assert shipped == set(MOTIONS) | set(JOINT_MOTIONS) == set(RATES)
    assert shipped - set(GRIPPERS) == {"fractal", "octo_fractal"}  # whose grippers have a test of their own


@pytest.mark.parametrize("name", sorted(MOTIONS))
def test_motions_have_the_units_and_axes_of_the_source(name):
    convention = load_convention(name)
    for numbers, expected in MOTIONS[name].items():
        action = to_actions(convention, [*numbers, convention.action.gripper.open], AT_REST)
        np.testing.assert_allclose(action, [[*expected, 1.0]], atol=1e-12)


@pytest.mark.parametrize("name", sorted(JOINT_MOTIONS))
def test_joint_motions_have_the_units_and_the_order_of_the_source(name):
    convention = load_convention(name)
    for joint in range(7):
        for number, expected in JOINT_MOTIONS[name].items():
            raw, wanted = np.zeros(8), np.zeros(8)
            raw[joint], wanted[joint] = number, expected
            wanted[7] = 1.0  # 0 is open
            np.testing.assert_allclose(to_actions(convention, raw, AT_REST), [wanted], atol=1e-12)


OSC_CONVENTIONS = sorted(name for name in MOTIONS if MOTIONS[name] is OSC)


@pytest.mark.parametrize("name", OSC_CONVENTIONS)
def test_liberos_arm_begins_slowly_and_stops_late_as_robosuites_does(name):
    """Compare with robosuite 1.4.1 along x: 5.8, 9.7, 10.5, 10.9, 11.3 mm in the first steps, then 12 to 13."""
    convention = load_convention(name)
    forwards = [1.0, 0, 0, 0, 0, 0, convention.action.gripper.open]
    lag = MotionLag(convention.action.lag)
    steps = [to_actions(convention, forwards, AT_REST, lag=lag)[0, 0] * 1e3 for _ in range(20)]
    np.testing.assert_allclose(steps[:5], [5.8, 9.7, 10.5, 10.9, 11.3], atol=1.1)
    assert steps[-1] == pytest.approx(13.1, abs=0.1)
    still = [0.0, 0, 0, 0, 0, 0, convention.action.gripper.open]
    after = [to_actions(convention, still, AT_REST, lag=lag)[0, 0] * 1e3 for _ in range(12)]
    assert after[0] == pytest.approx(0.557 * 13.1, abs=0.1)
    assert sum(steps) + sum(after) == pytest.approx(20 * 13.1, abs=0.1)  # all that was commanded is moved in the end


@pytest.mark.parametrize("name", OSC_CONVENTIONS)
def test_liberos_pictures_are_upright_and_mirrored(name):
    """A client of LIBERO turns robosuite's raw picture, which is upside down but not turned, by 180 degrees."""
    convention = load_convention(name)
    optical = np.random.default_rng(0).integers(0, 256, (256, 256, 3), dtype=np.uint8)
    raw = optical[::-1]
    for image in convention.images:
        plain = replace(image, mirror=False)
        np.testing.assert_array_equal(image.prepare(optical), plain.prepare(raw[::-1, ::-1]))
        assert not np.array_equal(image.prepare(optical), plain.prepare(optical))


def test_droid_velocity_closes_at_1():
    action = to_actions(load_convention("droid_velocity"), [1, 0, 0, 0, 0, 0, 0, 1], AT_REST)
    np.testing.assert_allclose(action, [[0.2, 0, 0, 0, 0, 0, 0, 0]], atol=1e-12)


@pytest.mark.parametrize("name", sorted(GRIPPERS))
def test_the_gripper_has_the_polarity_and_threshold_of_the_source(name):
    convention = load_convention(name)
    for number, opening in GRIPPERS[name].items():
        raw = np.zeros(convention.action.raw_size)
        raw[-1] = number
        assert to_actions(convention, raw, AT_REST)[0, -1] == pytest.approx(opening, abs=1e-12), number


@pytest.mark.parametrize("name", ["fractal", "octo_fractal"])
def test_the_google_robots_gripper_moves_on_a_jump_and_then_stays_for_15_steps(name):
    convention = load_convention(name)
    raw = np.zeros((30, 7))
    for rise, opens in ((17, False), (18, True)):  # it falls by more than 0.5 at step 3, and stays for steps 3 to 17
        raw[:, 6] = [0.9] * 3 + [0.3] * (rise - 3) + [1.0] * (30 - rise)
        closed = [0.0] * (rise - 3)
        expected = [1.0] * 3 + closed + [float(opens)] * (30 - rise)
        np.testing.assert_array_equal(to_actions(convention, raw, _still(30))[:, 6], expected)


def test_the_relative_gripper_of_rt1_stays_within_its_dead_zone():
    convention = load_convention("rt1_fractal")
    raw = np.zeros((5, 7))
    raw[:, 6] = [0.005, 0.5, 0.005, -0.009, -0.5]
    np.testing.assert_array_equal(to_actions(convention, raw, _still(5))[:, 6], [1, 0, 0, 0, 1])


@pytest.mark.parametrize("name", sorted(RATES))
def test_the_rate_is_that_of_the_source(name):
    assert load_convention(name).semantics.rate_hz == RATES[name]


@pytest.mark.parametrize("name", sorted(BASES))
def test_a_delta_is_added_to_the_state_of_the_source(name):
    """Test with an arm that is 10 mm behind its command: a zero delta to the measured pose goes back by 10 mm."""
    convention = load_convention(name)
    raw = np.zeros(7)
    raw[-1] = convention.action.gripper.open
    context = ActionContext(pose_commanded=DOWN, pose_measured=LAGGING)
    shift = to_actions(convention, raw, context)[0, 0]
    assert shift == pytest.approx(-0.01 if BASES[name] == "measured" else 0.0, abs=1e-12)


def rodrigues(vector):
    """Return the matrix of a rotation vector, by Rodrigues' formula."""
    angle = sqrt(sum(v * v for v in vector))
    x, y, z = (v / angle for v in vector)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + sin(angle) * k + (1 - cos(angle)) * k @ k


def about_x(a):
    return np.array([[1, 0, 0], [0, cos(a), -sin(a)], [0, sin(a), cos(a)]])


def about_y(a):
    return np.array([[cos(a), 0, sin(a)], [0, 1, 0], [-sin(a), 0, cos(a)]])


def about_z(a):
    return np.array([[cos(a), -sin(a), 0], [sin(a), cos(a), 0], [0, 0, 1]])


@pytest.mark.parametrize("name", sorted(name for name in MOTIONS if MOTIONS[name] is not OSC))
def test_large_rotations_are_those_of_the_source(name):
    """Test a rotation of 40 degrees and more about a skew axis, where the representations differ by degrees."""
    convention = load_convention(name)
    (a, b, c), numbers = (0.6, -0.7, 0.8), 1.0
    if name == "rt1_widowx":
        (a, b, c), numbers = (0.2, -0.24, 0.25), 1.4 / 0.25
    expected = rodrigues((a, b, c)) if name == "rt1_fractal" else about_z(c) @ about_y(b) @ about_x(a)
    if name == "unity":
        axes = np.array([[0, 0, 1], [-1, 0, 0], [0, 1, 0]])  # right, up and forward, as columns
        expected = axes @ expected @ axes.T
    raw = [0, 0, 0, numbers * a, numbers * b, numbers * c, convention.action.gripper.open]
    roll, pitch, yaw = to_actions(convention, raw, AT_REST)[0, 3:6]
    np.testing.assert_allclose(about_z(yaw) @ about_y(pitch) @ about_x(roll), expected, atol=1e-9)


def proprioception(matrix, opening=1.0):
    a, b = np.asarray(matrix, dtype=float).T[:2]
    return Proprioception(
        tcp_position=(0.5, 0.1, 0.3), tcp_rotation_6d=(*a.tolist(), *b.tolist()),
        joint_names=tuple(f"joint{i}" for i in range(1, 8)), joint_positions=(0.1, 0.2, 0.3, -1.4, 0.5, 1.6, 0.7),
        joint_velocities=(0.0,) * 7, gripper_opening=opening,
    )  # fmt: skip


LIBERO_STATES = {
    "libero": "observation/state",
    "oft_libero": "state",
    "vla_eval_libero": "states",
}


@pytest.mark.parametrize("name", sorted(LIBERO_STATES))
def test_liberos_state_is_position_rotation_vector_and_both_fingers(name):
    convention = load_convention(name)
    down = observed(convention, proprioception(about_x(pi)))[LIBERO_STATES[name]]
    np.testing.assert_allclose(down, [-0.16, 0.1, 1.2189, pi, 0, 0, 0.04, -0.04], atol=1e-6)
    assert str(down.dtype) == ("float32" if name == "vla_eval_libero" else "float64")
    half = observed(convention, proprioception(about_z(pi / 6) @ about_x(pi), 0.5))[LIBERO_STATES[name]]
    np.testing.assert_allclose(  # half a turn about an axis 15 degrees from x
        half, [-0.16, 0.1, 1.2189, pi * cos(pi / 12), pi * sin(pi / 12), 0, 0.02, -0.02], atol=1e-6
    )
    beyond = observed(convention, proprioception(about_x(3.3), 0.0))[LIBERO_STATES[name]]
    np.testing.assert_allclose(beyond[3:], [3.3, 0, 0, 0, 0], atol=1e-6)  # longer than pi, not folded back


def test_groots_state_has_a_key_for_each_number():
    request = observed(load_convention("groot_libero"), proprioception(about_x(pi)))
    found = {key: request[key].tolist() for key in ("x", "y", "z", "roll", "pitch", "yaw", "gripper")}
    expected = {
        "x": [-0.16],
        "y": [0.1],
        "z": [1.2189],
        "roll": [pi],
        "pitch": [0],
        "yaw": [0],
        "gripper": [0.04, -0.04],
    }
    assert found == {key: pytest.approx(value, abs=1e-6) for key, value in expected.items()}
    assert request["x"].dtype == np.float32  # GR00T refuses float64


@pytest.mark.parametrize("name", sorted(JOINT_MOTIONS))
def test_droids_state_is_joints_and_a_gripper_that_is_0_when_open(name):
    request = observed(load_convention(name), proprioception(about_x(pi), 0.75))
    np.testing.assert_allclose(request["observation/joint_position"], [0.1, 0.2, 0.3, -1.4, 0.5, 1.6, 0.7], atol=1e-6)
    np.testing.assert_allclose(request["observation/gripper_position"], [0.25], atol=1e-6)


def test_roboxims_state_is_what_its_exports_hold():
    measured = proprioception(about_z(0.3) @ about_x(3.0), 0.6)
    request = observed(load_convention("roboxim"), measured)
    np.testing.assert_allclose(request["observation/state"], measured.vector(), atol=1e-6)


KEYS = {
    "libero": {"observation/image", "observation/wrist_image", "observation/state", "prompt"},
    "oft_libero": {"full_image", "wrist_image", "state", "instruction"},
    "openvla_libero": {"image", "instruction", "unnorm_key"},
    "groot_libero": {"image", "wrist_image", "x", "y", "z", "roll", "pitch", "yaw", "gripper", "prompt"},
    "vla_eval_libero": {"agentview", "wrist", "states", "task_description"},
    "droid_velocity": {
        "observation/exterior_image_1_left", "observation/wrist_image_left", "observation/joint_position",
        "observation/gripper_position", "prompt",
    },
    "roboarena_joint_velocity": {
        "observation/exterior_image_0_left", "observation/wrist_image_left", "observation/joint_position",
        "observation/cartesian_position", "observation/gripper_position", "prompt",
    },
    "bridge": {"image", "instruction", "unnorm_key"},
    "fractal": {"image", "instruction", "unnorm_key"},
    **dict.fromkeys(
        ["octo_bridge", "octo_fractal"], {"image_primary", "timestep_pad_mask", "prompt", "unnorm_key"}
    ),
    "octo_two_cameras": {"image_primary", "image_wrist", "timestep_pad_mask", "prompt", "unnorm_key"},
    "octo_finetuned": {"image_primary", "image_wrist", "timestep_pad_mask", "prompt"},
    "rt1_widowx": {"image", "prompt"},
}  # fmt: skip
KEYS["droid_position"], KEYS["roboarena_joint_position"] = KEYS["droid_velocity"], KEYS["roboarena_joint_velocity"]
KEYS["rt1_fractal"] = KEYS["rt1_widowx"]
KEYS["roboxim"] = KEYS["unity"] = KEYS["libero"]
SIZES = {
    **dict.fromkeys(["libero", "oft_libero", "openvla_libero", "bridge", "fractal", *JOINT_MOTIONS], (224, 224)),
    **dict.fromkeys(["groot_libero", "vla_eval_libero", *OCTO, "roboxim", "unity"], (256, 256)),
    **dict.fromkeys(["rt1_widowx", "rt1_fractal"], (256, 320)),
}


@pytest.mark.parametrize("name", sorted(RATES))
def test_the_request_has_the_keys_and_sizes_of_the_source_and_upright_pictures(name):
    convention = load_convention(name)
    request = observed(convention, proprioception(about_x(pi)))
    assert set(request) == KEYS[name]
    pictures = [value for value in request.values() if getattr(value, "dtype", None) == np.uint8]
    assert len(pictures) == len(convention.images)
    for key, picture in request.items():
        if getattr(picture, "dtype", None) != np.uint8:
            continue
        newest = picture[-1] if convention.window > 1 else picture
        assert newest.shape == (*((128, 128) if key == "image_wrist" else SIZES[name]), 3)
        rows = np.flatnonzero(newest.any(axis=(1, 2)))
        top, bottom = newest[rows[1]].astype(int), newest[rows[-2]].astype(int)
        assert (top[20:-20, 0] > 200).all()  # what is up in the camera is red
        assert (bottom[20:-20, 2] > 200).all()  # and what is down is blue
    prompt = request[convention.prompt.key]
    assert prompt == ("pick up the red cube" if convention.prompt.lower else "Pick up the red cube")


def observed(convention, proprio):
    """Return the request for a scene whose upper half is red and whose lower half is blue."""
    images = {}
    for camera in convention.cameras:
        picture = np.zeros((camera.height or 256, camera.width or 256, 3), np.uint8)
        picture[: len(picture) // 2, :, 0], picture[len(picture) // 2 :, :, 2] = 255, 255
        images[camera.name] = picture
    observation = Observation(seq=0, stamp_ns=0, images=images, proprio=proprio)
    return observe(convention, [observation], "Pick up the red cube")


def _still(count):
    """Return the track of an arm that stands still."""
    return [ActionContext(pose_commanded=DOWN, pose_measured=DOWN)] * count


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("openvla_libero", "libero_spatial"),
        ("bridge", "bridge_orig"),
        ("octo_bridge", "bridge_dataset"),
        ("octo_fractal", "fractal20220817_data"),
    ],
)
def test_the_request_names_the_statistics_that_the_server_shall_use(name, expected):
    assert observed(load_convention(name), proprioception(about_x(pi)))["unnorm_key"] == expected


def test_droids_pictures_have_black_bars_above_and_below():
    picture = observed(load_convention("droid_velocity"), proprioception(about_x(pi)))["observation/wrist_image_left"]
    black = ~picture.any(axis=(1, 2))
    assert black[:49].all()  # 320 x 180 becomes 224 x 126, in the middle of 224
    assert black[-49:].all()
    assert not black[49:-49].any()


def test_octos_window_repeats_the_first_frame_and_masks_it():
    request = observed(load_convention("octo_bridge"), proprioception(about_x(pi)))
    assert request["image_primary"].shape == (2, 256, 256, 3)
    assert request["timestep_pad_mask"].tolist() == [False, True]
    np.testing.assert_array_equal(request["image_primary"][0], request["image_primary"][1])


def test_unitys_left_handed_axes_map_to_ours(tmp_path):
    """Test the axes of the thesis' simulator: x right, y up, z forward, where positive turns are left-handed."""
    (tmp_path / "unity.yaml").write_text(
        "rate_hz: 10\nframes: {base_axes: ['-y', z, x], tool_axes: ['-y', z, x]}\n"
        "action: {control: end_effector_delta, rotation: rotation_vector}\n"
    )
    convention = load_convention(str(tmp_path / "unity.yaml"))
    forward = decode_actions(convention, [0, 0, 0.1, 0, 0, 0, 1])[0]
    up = decode_actions(convention, [0, 0.1, 0, 0, 0, 0, 1])[0]
    right = decode_actions(convention, [0.1, 0, 0, 0, 0, 0, 1])[0]
    np.testing.assert_allclose([forward[:3], up[:3], right[:3]], [[0.1, 0, 0], [0, 0, 0.1], [0, -0.1, 0]], atol=1e-12)
    turn = decode_actions(convention, [0, 0, 0, 0, 0.2, 0, 1])[0]  # about up, clockwise from above in Unity
    np.testing.assert_allclose(turn[3:6], [0, 0, -0.2], atol=1e-9)


def test_readings_of_many_ticks_are_arrays():
    readings = ArmReadings.of([proprioception(about_x(pi)), proprioception(about_x(3.0))])
    assert readings.tcp_positions.shape == (2, 3)
    np.testing.assert_allclose(readings.tcp_rotations[1].as_matrix(), Rotation.from_rotvec([3.0, 0, 0]).as_matrix())
