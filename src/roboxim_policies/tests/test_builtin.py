"""The policies without a network, and the sources of recorded actions."""

import json
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from roboxim_core.actions import ActionSemantics
from roboxim_core.config import to_json
from roboxim_core.errors import ConfigError
from roboxim_core.policies import EpisodeStart, ObservationWindow
from roboxim_core.vision.images import encode_image
from roboxim_datasets.rlds import RldsEpisode, RldsFeatures
from roboxim_datasets.rlds.writer import RldsWriter
from roboxim_policies import load_policy, recorded_actions

ACTIONS = np.random.default_rng(0).normal(scale=0.01, size=(5, 7)).astype(np.float32)


def window(seq: int = 0) -> ObservationWindow:
    return ObservationWindow(instruction="", observations=[], pad_mask=(), episode_id="e", seq=seq)


def start(seed: int) -> EpisodeStart:
    return EpisodeStart(episode_id="e", instruction="", seed=seed)


def test_zero_holds_still():
    assert load_policy("zero").act(window()).tolist() == [0, 0, 0, 0, 0, 0, 1]


@pytest.mark.parametrize("distribution", ["gaussian", "uniform"])
def test_random_is_seeded_and_within_the_limits(distribution):
    policy = load_policy("random", distribution=distribution, scale=1.0)
    episodes = []
    for seed in (1, 1, 2):
        policy.reset(start(seed))
        episodes.append(np.array([policy.act(window(k)) for k in range(200)]))
    assert np.array_equal(episodes[0], episodes[1])
    assert not np.array_equal(episodes[0], episodes[2])
    limits = ActionSemantics()
    lengths = np.linalg.norm(episodes[0][:, :3], axis=1)
    assert 0.8 * limits.max_translation_m < lengths.max() <= limits.max_translation_m
    assert np.linalg.norm(episodes[0][:, 3:6], axis=1).max() <= limits.max_rotation_rad
    assert set(episodes[0][:, 6]) == {0.0, 1.0}


def test_random_refuses_nonsense():
    with pytest.raises(ConfigError, match="gaussian"):
        load_policy("random", distribution="gausian")
    with pytest.raises(ConfigError, match="scale"):
        load_policy("random", scale=2.0)


def replayed(policy) -> np.ndarray:
    chunks = [policy.act(window(k)) for k in range(len(ACTIONS))]
    assert [chunk.done for chunk in chunks] == [False] * (len(ACTIONS) - 1) + [True]
    return np.concatenate([chunk.actions for chunk in chunks])


def write_rlds(folder, semantics=ActionSemantics()):  # noqa: B008 - frozen
    metadata = {"action_semantics": "text"}
    features = RldsFeatures(images={"image": (16, 16)}, encoding="png", metadata=metadata, vectors={"state": 10})
    frames = [encode_image(np.zeros((16, 16, 3), np.uint8), "png")] * len(ACTIONS)
    with RldsWriter(folder, features, name="cubes", version="1.0.0", description="") as writer:
        for split, sign in (("train", -1), ("val", 1)):
            episode = RldsEpisode(
                images={"image": frames}, vectors={"state": np.zeros((len(ACTIONS), 10), np.float32)},
                action=sign * ACTIONS,
                instruction="Pick up the red cube", reward=np.zeros(len(ACTIONS), np.float32),
                metadata={"action_semantics": to_json(semantics)},
            )  # fmt: skip
            writer.add(split, episode)


def test_replay_repeats_actions_from_every_kind_of_file(tmp_path):
    np.savez(tmp_path / "a.npz", actions=ACTIONS, other=np.zeros(3))
    (tmp_path / "a.json").write_text(json.dumps({"actions": ACTIONS.tolist()}))
    (tmp_path / "b.json").write_text(json.dumps(ACTIONS.tolist()))
    for name in ("a.npz", "a.json", "b.json"):
        assert np.array_equal(replayed(load_policy("replay", source=tmp_path / name)), ACTIONS)
    assert np.array_equal(replayed(load_policy("replay", actions=ACTIONS)), ACTIONS)


def test_replay_holds_after_the_end():
    chunk = load_policy("replay", actions=ACTIONS).act(window(9))
    assert chunk.done
    assert chunk.actions[0].tolist() == [0, 0, 0, 0, 0, 0, pytest.approx(float(ACTIONS[-1, 6]))]


def test_replay_of_an_rlds_export_keeps_its_semantics(tmp_path):
    write_rlds(tmp_path, ActionSemantics(rate_hz=20.0))
    policy = load_policy("replay", source=tmp_path, episode=1)
    assert policy.describe().semantics.rate_hz == 20.0
    assert np.array_equal(replayed(policy), ACTIONS)
    assert np.array_equal(replayed(load_policy("replay", source=tmp_path, episode=0)), -ACTIONS)
    with pytest.raises(ConfigError, match="there are 2"):
        load_policy("replay", source=tmp_path, episode=2)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.txt", b"x"),
        ("a.json", b"{"),
        ("a.json", b"[[1, 2]]"),
        ("a.json", b"[]"),
        ("a.json", b"[[0, 0, NaN, 0, 0, 0, 1]]"),
        ("a.npz", b"PK damaged"),
        ("a.mcap", b"no bag"),
    ],
)
def test_replay_names_the_file_that_it_cannot_read(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ConfigError, match=name):
        load_policy("replay", source=tmp_path / name)
    with pytest.raises(ConfigError, match="no such"):
        load_policy("replay", source=tmp_path / "absent.npz")


def write_bag(folder, seqs=(0, 1, 2, 3)):
    """Write a bag with a start, actions and one settling tick; the executed action differs from the label."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    name = "roboxim_interfaces/msg/EpisodeStep"
    text = "uint32 seq\nstring phase\nfloat64[] action_label\nfloat64[] action_executed\n"
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, name))
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/evaluator/step", name, typestore=store)
        for seq in seqs:
            action = ACTIONS[seq - 1].astype(float) if seq else np.zeros(0)
            phase = "start" if seq == 0 else "settle" if seq == max(seqs) else "act"
            step = store.types[name](seq=seq, phase=phase, action_label=action * 0, action_executed=action)
            writer.write(connection, seq, store.serialize_cdr(step, name))


def test_replay_of_a_bag_repeats_what_was_executed(tmp_path):
    write_bag(tmp_path / "bag")
    for source in (tmp_path / "bag", tmp_path / "bag" / "bag.mcap"):
        policy = load_policy("replay", source=source)
        assert np.array_equal(policy.act(window(0)).actions[0], ACTIONS[0])
        assert policy.act(window(1)).done
    write_bag(tmp_path / "gap", seqs=(0, 2, 3))
    with pytest.raises(ConfigError, match="gaps"):
        load_policy("replay", source=tmp_path / "gap")


def test_only_bc_imports_jax():
    code = "import sys; from roboxim_policies import load_policy; import roboxim_policies.learning.data; "
    code += "load_policy('zero'); sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_bag_of_a_version_with_other_semantics_is_refused_by_name():
    old = SimpleNamespace(control="end_effector_delta", frame="robot_base", rotation="euler_xyz_extrinsic")
    reader = SimpleNamespace(
        messages=lambda connections: [(None, 0, b"")],
        deserialize=lambda raw, kind: SimpleNamespace(semantics=old),
    )
    with pytest.raises(ConfigError, match="another version of RoboXim recorded it"):
        recorded_actions._semantics(reader, SimpleNamespace(msgtype="x"))


@pytest.mark.parametrize("name", ["zero", "random"])
def test_policies_without_a_rate_of_their_own_fit_every_run(name):
    for rate_hz in (5.0, 20.0):
        run = ActionSemantics(rate_hz=rate_hz)
        load_policy(name).describe().semantics.require_compatible(run, owner=name, other_owner="the run")
