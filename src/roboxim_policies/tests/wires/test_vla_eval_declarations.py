"""What vla-eval's model servers declare is compared with the convention, or refused by its name.

The declarations come from vla-eval's own classes, whose models are not loaded, over its own server.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vla_eval import api
from vla_eval.model_servers.groot import GR00TModelServer
from vla_eval.model_servers.oft import OFTModelServer
from vla_eval.model_servers.openvla import OpenVLAModelServer
from vla_eval.model_servers.predict import PredictModelServer
from vla_eval.model_servers.xvla import XVLAModelServer
from vla_eval.rotation import matrix_to_rot6d_contiguous, matrix_to_rot6d_interleaved

from roboxim_core.actions import ControlMode
from roboxim_core.conventions import load_convention
from roboxim_core.conventions.states import StateField, StateInput, StatePart
from roboxim_core.errors import PolicyError
from roboxim_core.policies import EpisodeStart
from roboxim_core.rotation.representations import RotationRepresentation, decode, encode
from roboxim_policies.fitting import misfits
from roboxim_policies.remote import RemotePolicy, probe_window
from roboxim_policies.wires.vla_eval import VlaEvalWire

LIBERO = load_convention("vla_eval_libero")
ABSOLUTE = replace(
    LIBERO,
    action=replace(
        LIBERO.action, response=None, control=ControlMode.END_EFFECTOR_ABSOLUTE, delta_base="none", frame="robot_base",
        translation_range=(), rotation_range=(), translation_scale_m=1.0, rotation_scale_rad=1.0,
    ),
)  # fmt: skip


def declaring(kind, **attributes):
    """Return a server that declares what vla-eval's class declares, and answers zeros."""

    class Declaring(PredictModelServer):
        def predict(self, obs, ctx):
            self.seen.append(obs)
            return {"actions": np.zeros((1, 7), np.float32)}

        def get_observation_params(self):
            return kind.get_observation_params(self.genuine)

        def get_action_spec(self):
            return kind.get_action_spec(self.genuine)

        def get_observation_spec(self):
            return kind.get_observation_spec(self.genuine)

    server = Declaring(chunk_size=1)
    server.seen, server.genuine = [], object.__new__(kind)
    vars(server.genuine).update(attributes)
    return server


XVLA = {
    "benchmark_profile": "libero", "output_action_dim": 7, "_euler_offset": None, "use_predicted_proprio": True,
    "_image_keys": ("agentview", "wrist"),
}  # fmt: skip


def connected(server, convention, **options):
    with (
        api.serve_background(server) as served,
        RemotePolicy(VlaEvalWire(served.url, **options), convention, version="1") as policy,
    ):
        policy.reset(EpisodeStart(episode_id="e", instruction="pick up the red cube", seed=0))
        policy.act(probe_window(policy.convention))
    return server.seen[0]


def test_x_vlas_absolute_poses_do_not_run_as_deltas():
    """Its profile declares absolute_action and, in the specification, deltas; its benchmark goes by the first."""
    with pytest.raises(PolicyError, match="does not fit.*absolute poses .absolute_action: True.*'end_effector_delta'"):
        connected(declaring(XVLAModelServer, **XVLA), LIBERO)
    connected(declaring(XVLAModelServer, **XVLA), ABSOLUTE)


@pytest.mark.parametrize(
    ("kind", "attributes"),
    [
        (OFTModelServer, {"num_images_in_input": 2, "use_proprio": True}),
        (OpenVLAModelServer, {}),
    ],
)
def test_servers_for_libero_fit_its_convention_and_not_an_absolute_one(kind, attributes):
    assert "states" in connected(declaring(kind, **attributes), LIBERO)
    with pytest.raises(PolicyError, match="its actions are 'delta_xyz', the convention's 'end_effector_absolute'"):
        connected(declaring(kind, **attributes), ABSOLUTE)


def test_gr00ts_euler_angles_are_not_taken_for_a_rotation_vector():
    server = declaring(GR00TModelServer, _extra_obs_params={}, invert_gripper=True)
    with pytest.raises(PolicyError, match="rotations are 'euler_xyz', the convention's 'rotation_vector'"):
        connected(server, LIBERO)


UNKNOWN = [
    ({"observation_params": {"send_video_history": True}}, "observation_params: send_video_history"),
    ({"observation_params": {"control_mode": "arm_pd_ee_wobble"}}, "observation_params: control_mode"),
    ({"action_spec": {"all": {"dims": 7, "format": "joint_positions_r1pro"}}}, "action_spec: all"),
    ({"observation_spec": {"depth": {"dims": 0, "format": "depth_mm"}}}, "observation_spec: depth"),
    ({"capabilities": {"streaming": True}}, "capabilities: streaming"),
    ({"units": "inches"}, "units"),
]


@pytest.mark.parametrize(("declared", "name"), UNKNOWN)
def test_a_declaration_that_is_not_understood_is_refused_by_its_name(declared, name):
    (found,) = misfits("vla_eval", declared, LIBERO)
    assert f"it declares '{name}' = " in found
    assert "does not understand" in found
    short = name.rpartition(": ")[2]
    assert f"ignore={short}" in found
    assert not misfits("vla_eval", declared, LIBERO, ignore=(short,))


@pytest.mark.parametrize(
    ("declared", "words"),
    [
        ({"observation_params": {"absolute_action": False}}, ""),
        ({"observation_params": {"quat_no_antipodal": False}}, "shorter than pi"),
        (
            {"observation_params": {"control_mode": "arm_pd_ee_target_base_pose_gripper_pd_joint_pos"}},
            "its actions are 'end_effector_absolute'",
        ),
        ({"observation_params": {"seed": 0, "ep_len": 720, "success_mode": "truncation"}}, ""),
        ({"action_spec": {"position": {"dims": 3, "format": "absolute_xyz"}}}, "'absolute_xyz', the convention's"),
        (
            {"action_spec": {"rotation": {"dims": 7, "format": "rot6d_interleaved"}}},
            "rotations are 'rot6d_interleaved'",
        ),
        ({"action_spec": {"gripper": {"dims": 1, "format": "continuous_01"}}}, "its gripper is 'continuous_01'"),
        ({"observation_spec": {"state": {"dims": 0, "format": "joint_positions"}}}, "its state is 'joint_positions'"),
        ({"observation_spec": {n: {"dims": 0, "format": "rgb_hwc_uint8"} for n in "abc"}}, "the pictures a, b, c"),
    ],
)
def test_what_is_understood_is_compared(declared, words):
    found = "; ".join(misfits("vla_eval", declared, LIBERO))
    assert words in found
    assert bool(found) == bool(words)


def test_controller_states_are_sent_beside_the_states():
    parts = (StatePart(field=StateField.TCP_POSITION), StatePart(field=StateField.CONSTANT, values=(1.0, 2.0)))
    both = replace(LIBERO, states=(*LIBERO.states, StateInput(key="controller_states", parts=parts)))
    seen = connected(declaring(OpenVLAModelServer), both)
    assert np.asarray(seen["states"]).shape == (8,)
    np.testing.assert_allclose(seen["controller_states"], [-0.16, 0.0, 1.2189, 1.0, 2.0], rtol=1e-6)


def test_six_numbers_of_a_rotation_are_ordered_as_in_vla_eval():
    matrix = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
    turn = Rotation.from_matrix(matrix)
    kinds = RotationRepresentation
    expected = {
        kinds.ROTATION_6D: matrix_to_rot6d_contiguous(matrix),
        kinds.ROTATION_6D_INTERLEAVED: matrix_to_rot6d_interleaved(matrix),
        kinds.ROTATION_6D_ROWS: matrix[:2].ravel(),
    }
    for kind, numbers in expected.items():
        np.testing.assert_allclose(encode(turn, kind), numbers, atol=1e-12)
        np.testing.assert_allclose(decode(2.0 * numbers, kind).as_matrix(), matrix, atol=1e-12)
