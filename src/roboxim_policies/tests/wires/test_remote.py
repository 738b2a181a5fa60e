"""A remote policy understands its server by the convention, and refuses what does not fit."""

from pathlib import Path

import numpy as np
import pytest
from fake_servers import GOOD, groot_fake, openpi_fake, rows_for, vla_eval_fake

from roboxim_core.actions import ControlMode
from roboxim_core.config import to_plain
from roboxim_core.conventions import load_convention
from roboxim_core.errors import ConfigError, ErrorCode, PolicyError
from roboxim_core.policies import EpisodeStart
from roboxim_core.policy_guard import GuardedPolicy
from roboxim_policies.base import load_policy
from roboxim_policies.fitting import misfits
from roboxim_policies.remote import Probe, changed_facts, probe_window
from roboxim_policies.wires import groot, openpi, vla_eval

DATA = Path(__file__).parents[4] / "tests" / "data" / "wires"

LIBERO, ROBOXIM, DROID = (load_convention(name) for name in ("libero", "roboxim", "droid_velocity"))
START = EpisodeStart(episode_id="probe", instruction="pick up the red cube", seed=1)


def remote(url, convention, spec="openpi", **options):
    return load_policy(spec, url=url, convention=convention, version="v1", reconnect_s=0.0, **options)


def test_request_and_answer_have_the_meaning_of_the_convention():
    with openpi_fake("good") as server, remote(server.url, "roboxim") as policy:
        guard = GuardedPolicy(policy)
        guard.reset(START)
        chunk = guard.act(probe_window(ROBOXIM))
    np.testing.assert_array_equal(chunk.actions[:, :6], GOOD[:, :6])
    assert chunk.actions[:, 6].max() == 1.0  # an opening
    request = server.requests[-1]
    assert request["observation/image"].shape == (256, 256, 3)
    np.testing.assert_allclose(request["observation/state"], [0.5, 0, 0.3, 1, 0, 0, 0, -1, 0, 1])
    assert request["prompt"] == "pick up the red cube"


@pytest.mark.parametrize(
    ("behaviour", "code", "words"),
    [
        ("short", ErrorCode.INVALID_ACTION, "1 actions, the convention executes 5"),
        ("wrong dimension", ErrorCode.INVALID_ACTION, r"\(n, 7\)"),
        ("nan", ErrorCode.INVALID_ACTION, "finite"),
    ],
)
def test_answer_that_the_convention_does_not_allow_is_an_invalid_action(behaviour, code, words):
    convention = "libero" if behaviour == "short" else "roboxim"
    with openpi_fake(behaviour) as server, remote(server.url, convention) as policy:
        guard = GuardedPolicy(policy)
        guard.reset(START)
        with pytest.raises(PolicyError, match=words) as caught:
            guard.act(probe_window(policy.convention))
        assert caught.value.code == code


@pytest.mark.parametrize(("spec", "fake"), [("openpi", openpi_fake), ("vla_eval", vla_eval_fake)])
def test_of_a_long_answer_the_first_rows_are_used_and_the_run_says_so(spec, fake):
    """openpi's pi0_libero answers 50 actions; its own client takes the first ones."""
    with fake(*["long"] * 4) as server, remote(server.url, "libero", spec=spec) as policy:
        assert not policy.notices()
        guard = GuardedPolicy(policy)
        guard.reset(START)
        chunk = guard.act(probe_window(LIBERO))
        replies = policy.probe().replies
        (notice,) = policy.notices()
    expected = LIBERO.action.decode(rows_for("long")[:10], LIBERO.frames)
    np.testing.assert_allclose(chunk.actions, expected, rtol=1e-6)
    assert {len(reply) for reply in replies} == {50 * 7}, "the model is recognised by all of its numbers"
    assert "answers 50 actions; the first 10 are used (horizon of the convention 'libero')" in notice


def test_remote_policy_needs_a_version():
    with pytest.raises(ConfigError, match="version"):
        load_policy("openpi", url="ws://localhost:1", convention="libero")
    with pytest.raises(ConfigError, match="cannot hash a model"):
        load_policy("openpi", url="ws://localhost:1", convention="libero", version="")


def test_misspelt_and_missing_options_are_named_with_their_meaning():
    words = (
        r"'convension' is unknown \(did you mean 'convention'\?\); "
        r"'convention' is missing \(.*roboxim policy conventions .*'version' is missing "
        r"\(.*cannot hash.*It takes url, convention, version, timeout_s=90.0, "
    )
    with pytest.raises(ConfigError, match=words):
        load_policy("openpi", url="ws://localhost:1", convension="libero")


def test_server_without_a_convention_of_its_own_is_named():
    with openpi_fake() as server, pytest.raises(PolicyError, match="declares no convention.*convention=libero"):
        remote(server.url, "server")


@pytest.mark.parametrize(
    ("metadata", "convention", "words"),
    [
        ({"action_space": "joint_position"}, DROID, "its actions are 'joint_position', the convention's are"),
        ({"action_space": "joint_velocity"}, DROID, ""),
        ({"action_space": "cartesian_velocity"}, LIBERO, ""),
        ({"needs_wrist_camera": True, "n_external_cameras": 2}, DROID, "needs 2 external cameras"),
        ({"needs_stereo_camera": True}, DROID, "stereo"),
        ({"image_resolution": [180, 320]}, DROID, "320 x 180 px.*224 x 224"),
        ({"action_chunk_size": 4}, LIBERO, "answers 4 actions, the convention executes 5"),
        ({"action_chunk_size": 16}, LIBERO, ""),
        ({"action_chunk_size": 8, "state_keys": []}, LIBERO, ""),
        ({"roboxim": {"convention": to_plain(LIBERO)}}, LIBERO, ""),
        ({"roboxim": {"convention": to_plain(LIBERO)}}, DROID, "use convention=server"),
    ],
)
def test_openpi_metadata_are_compared_with_the_convention(metadata, convention, words):
    import re

    found = "; ".join(misfits("openpi", metadata, convention))
    assert re.search(words, found) if words else not found


@pytest.mark.parametrize(
    ("part", "words"),
    [
        ({"dims": 3, "format": "axis_angle"}, ""),
        ({"dims": 3, "format": "euler_xyz"}, "rotations are 'euler_xyz', the convention's 'rotation_vector'"),
        ({"dims": 1, "format": "binary_close_positive"}, ""),
        ({"dims": 1, "format": "binary_close_negative"}, "-1 opens and 1 closes"),
    ],
)
def test_vla_eval_specs_are_compared_with_the_convention(part, words):
    spec = {"a": part, "rest": {"dims": 7 - part["dims"], "format": "raw"}}
    assert words in "; ".join(misfits("vla_eval", {"action_spec": spec}, LIBERO))
    assert bool(misfits("vla_eval", {"action_spec": spec}, LIBERO)) == bool(words)
    assert "have 8 numbers" in misfits("vla_eval", {"action_spec": {"all": {"dims": 8}}}, LIBERO)[0]


def test_convention_that_does_not_fit_is_refused_before_the_first_request():
    with openpi_fake(metadata={"action_space": "joint_position"}) as server:
        with remote(server.url, "libero") as policy, pytest.raises(PolicyError, match="does not fit.*trained in"):
            policy.reset(START)
        assert not server.requests
    complaint = "needs the state arm; the convention sends state"
    with groot_fake() as server, remote(server.url, "libero", "groot") as policy:
        pytest.raises(PolicyError, policy.reset, START).match(complaint)


def test_probe_tells_another_model():
    with openpi_fake() as server, remote(server.url, "roboxim") as policy:
        first, second = policy.probe(), policy.probe()
        assert not first.complaint(second)
        policy.facts()
    with openpi_fake("nan") as server, remote(server.url, "roboxim") as policy:
        pytest.raises(PolicyError, policy.probe).match("finite")
    other = Probe(replies=tuple(tuple(x + 0.1 for x in reply) for reply in first.replies))
    assert "differ by 0.1" in first.complaint(other)
    assert "other sizes" in first.complaint(Probe(replies=((0.0,),) * 3))


def test_probe_allows_for_a_model_that_samples():
    rng = np.random.default_rng(0)
    first, same, other = (
        Probe(replies=tuple(tuple(centre + rng.normal(size=70) * 0.01) for _ in range(3))) for centre in (0.0, 0.0, 1.0)
    )
    assert not first.complaint(same)
    assert first.complaint(other)


def test_policy_over_vla_eval_leaves_out_what_the_server_does_not_want():
    params = {"observation_params": {"send_wrist_image": False, "send_state": False}}
    with vla_eval_fake(metadata=params) as server, remote(server.url, "roboxim", "vla_eval") as policy:
        policy.reset(START)
        assert policy.act(probe_window(ROBOXIM)).shape == (3, 7)
        assert set(server.requests[-1]) == {"images", "task_description"}
        assert set(server.requests[-1]["images"]) == {"image"}
        assert policy.convention.action.control == ControlMode.END_EFFECTOR_DELTA


@pytest.mark.parametrize(
    ("recording", "wire", "convention"),
    [
        ("openpi-libero/00_metadata.bin", "openpi", "libero"),
        ("roboarena/00_metadata.bin", "openpi", "roboarena_joint_position"),
        ("vla-eval/01_from_server_hello.bin", "vla_eval", "vla_eval_libero"),
        ("groot-n15/03_response_modality.bin", "groot", "groot_libero"),
        ("groot-n16/03_response_modality.bin", "groot", "groot_libero"),
        ("groot-n17/03_response_modality.bin", "groot", "groot_libero"),
    ],
)
def test_shipped_convention_fits_what_a_genuine_server_declared(recording, wire, convention):
    data = (DATA / recording).read_bytes()
    if wire == "groot":
        metadata = {"modality_config": groot.serialiser_of(data).decode(data)}
    else:
        metadata = openpi.decode(data) if wire == "openpi" else vla_eval.decode(data)["payload"]
    assert misfits(wire, metadata, load_convention(convention)) == []


def test_prose_of_a_convention_does_not_make_another_model():
    facts = {"wire": "openpi", "convention": {"rate_hz": 20, "notes": ["one"], "sources": ["a"]}, "metadata": {}}
    reworded = facts | {"convention": {"rate_hz": 20, "notes": ["other words"], "sources": [], "description": "d"}}
    assert changed_facts(facts, reworded) == ""
    assert "rate_hz" in changed_facts(facts, facts | {"convention": {"rate_hz": 10}})
