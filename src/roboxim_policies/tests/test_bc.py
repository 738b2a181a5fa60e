"""Behaviour cloning learns, resumes exactly after an interruption, and never leaves an incomplete checkpoint."""

import json
from dataclasses import replace

import numpy as np
import pytest

from roboxim_core.actions import ActionSemantics
from roboxim_core.errors import ConfigError
from roboxim_core.policies import EpisodeStart, Observation, ObservationWindow
from roboxim_core.proprioception import Proprioception
from roboxim_policies.bc.checkpoint import load_checkpoint
from roboxim_policies.bc.config import BCConfig
from roboxim_policies.bc.data import Demonstration, Demonstrations, assemble, proprio_features, word_indices
from roboxim_policies.bc.policy import BCPolicy
from roboxim_policies.bc.train import Trainer

CONFIG = BCConfig(
    steps=300, learning_rate=3e-3, batch=16, warmup_steps=10, ema_decay=0.9, chunk=4, execute=2,
    channels=8, keypoints=8, hidden=32, image_sizes={"workspace": 32, "wrist": 16}, brightness=0.05,
    checkpoint_every=100,
)  # fmt: skip
COLORS = {"red": (220, 30, 30), "blue": (30, 30, 220)}


def episode(rng: np.random.Generator, color: str, steps: int = 8) -> Demonstration:
    """Return an episode: images with a square per colour, actions along x to the named one, then a closing gripper."""
    places = dict(zip(COLORS, rng.permutation([4, 22]), strict=True))
    picture = np.full((32, 32, 3), 128, np.uint8)
    for name, column in places.items():
        row = rng.integers(2, 24)
        picture[row : row + 6, column : column + 6] = COLORS[name]
    direction = 1.0 if places[color] > 10 else -1.0
    actions = np.zeros((steps, 7), np.float32)
    actions[:, 0] = 0.02 * direction
    actions[:, 6] = np.arange(steps) < steps - 2
    proprio = np.stack(
        [
            Proprioception(tcp_position=(0.5 + x, 0.0, 0.0), gripper_opening=opening).vector()
            for x, opening in zip(np.cumsum(actions[:, 0]).tolist(), actions[:, 6].tolist(), strict=True)
        ]
    )
    images = {"workspace": np.stack([picture] * steps), "wrist": np.stack([picture[::2, ::2]] * steps)}
    return Demonstration(images=images, proprio=proprio, actions=actions, instruction=f"Pick up the {color} cube")


def data(count: int = 24) -> Demonstrations:
    rng = np.random.default_rng(0)
    return assemble(
        [episode(rng, ("red", "blue")[i % 2]) for i in range(count)],
        camera_sizes={"workspace": (32, 32), "wrist": (16, 16)},
        semantics=ActionSemantics(),
        robot="panda",
    )


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bc")
    reports = []
    Trainer(data(), CONFIG, folder).run(reports.append)
    return folder, reports


def first_action(policy: BCPolicy, demonstration: Demonstration, instruction: str) -> np.ndarray:
    policy.reset(EpisodeStart(episode_id="e", instruction=instruction, seed=0))
    images = {name: frames[0] for name, frames in demonstration.images.items()}
    x, *_, opening = demonstration.proprio[0].tolist()
    proprio = Proprioception(tcp_position=(x, 0.0, 0.0), gripper_opening=opening)
    observation = Observation(seq=0, stamp_ns=0, images=images, proprio=proprio)
    answer = policy.act(
        ObservationWindow(instruction=instruction, observations=[observation], pad_mask=(True,), episode_id="e", seq=0)
    )
    assert answer.shape == (2, 7)
    return answer[0]


def test_it_learns_to_follow_the_named_colour(trained):
    folder, reports = trained
    assert reports[-1].step == CONFIG.steps
    assert reports[-1].parts["move"] < 0.3 * reports[0].parts["move"]
    policy = BCPolicy(folder)
    rng = np.random.default_rng(0)
    right = 0
    for i in range(24):
        shown = episode(rng, ("red", "blue")[i % 2])
        other = shown.instruction.replace("red", "x").replace("blue", "red").replace("x", "blue")
        direction = np.sign(shown.actions[0, 0])
        right += np.sign(first_action(policy, shown, shown.instruction)[0]) == direction
        right += np.sign(first_action(policy, shown, other)[0]) == -direction
    assert right >= 44  # of 48: the word decides


def test_what_never_moves_stays_exactly_still(trained):
    action = first_action(BCPolicy(trained[0]), episode(np.random.default_rng(5), "red"), "Pick up the red cube")
    assert action[1:6].tolist() == [0.0] * 5
    assert action[6] in (0.0, 1.0)


def test_it_describes_what_it_was_trained_on(trained):
    description = BCPolicy(trained[0], execute=3).describe()
    assert [(c.name, c.width, c.height) for c in description.cameras] == [("workspace", 32, 32), ("wrist", 16, 16)]
    assert description.horizon == 3
    assert description.semantics == ActionSemantics()
    assert description.version.startswith("step 300, ")
    assert not description.privileged
    assert load_checkpoint(trained[0]).robot == "panda"
    with pytest.raises(ConfigError, match="1..4"):
        BCPolicy(trained[0], execute=5)


def test_an_interrupted_training_ends_in_the_same_bits(trained, tmp_path):
    class Interrupt(KeyboardInterrupt):
        pass

    def interrupt(report):
        if report.step >= 30:
            raise Interrupt

    with pytest.raises(Interrupt):
        Trainer(data(), CONFIG, tmp_path).run(interrupt)
    resumed = Trainer(data(), CONFIG, tmp_path)
    assert resumed.step == 30
    resumed.run()
    whole, parts = load_checkpoint(trained[0]), load_checkpoint(tmp_path)
    assert whole.digest == parts.digest
    assert all(np.array_equal(a, b) for a, b in zip(whole.arrays, parts.arrays, strict=True))


def test_another_configuration_or_data_set_is_not_resumed(trained):
    with pytest.raises(ConfigError, match=r"of another configuration \(seed: 0 stored, 1 requested\); choose"):
        Trainer(data(), replace(CONFIG, seed=1), trained[0])
    with pytest.raises(ConfigError, match="of another dataset; choose"):
        Trainer(data(20), CONFIG, trained[0])
    with pytest.raises(ConfigError, match="exists"):
        Trainer(data(), CONFIG, trained[0], resume=False)


def test_a_failed_write_leaves_the_old_checkpoint_whole(trained, tmp_path, monkeypatch):
    trainer = Trainer(data(), CONFIG, tmp_path)
    trainer.run(until=10)
    before = (tmp_path / "checkpoint.npz").read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("roboxim_policies.bc.checkpoint.os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        trainer.run(until=20)
    assert (tmp_path / "checkpoint.npz").read_bytes() == before
    assert load_checkpoint(tmp_path).step == 10


def test_a_damaged_checkpoint_is_refused_by_name(trained, tmp_path):
    whole = (trained[0] / "checkpoint.npz").read_bytes()
    (tmp_path / "half.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ConfigError, match=r"half\.npz"):
        BCPolicy(tmp_path / "half.npz")
    with pytest.raises(ConfigError, match="roboxim train bc"):
        BCPolicy(tmp_path / "absent")


def test_words_and_yaw_are_read_as_meant():
    assert word_indices("Pick up the RED cube, please!", ("cube", "red"), 4).tolist() == [2, 1, 0, 0]
    down = Proprioception(tcp_rotation_6d=(1.0, 0.0, 0.0, 0.0, -1.0, 0.0)).vector()
    half_turn = Proprioception(tcp_rotation_6d=(-1.0, 0.0, 0.0, 0.0, 1.0, 0.0)).vector()  # the same for two fingers
    eighth = Proprioception(tcp_rotation_6d=(2**-0.5, 2**-0.5, 0.0, 2**-0.5, -(2**-0.5), 0.0), gripper_opening=0.5)
    assert np.allclose(proprio_features(down), proprio_features(half_turn), atol=1e-6)
    assert proprio_features(eighth.vector()) == pytest.approx([0, 0, 0, 0.5, 1, 0], abs=1e-6)


@pytest.mark.parametrize(
    ("changed", "said"),
    [({"format": 1}, r"old\.npz was trained on proprioception of the old layout.*train again"),
     ({"state_layout": ["x", "y"]}, r"trained on proprioception \['x', 'y'\]")],
)  # fmt: skip
def test_a_checkpoint_of_another_proprioception_is_refused_by_name(trained, tmp_path, changed, said):
    with np.load(trained[0] / "checkpoint.npz") as archive:
        arrays = dict(archive)
    arrays["said"] = np.array(json.dumps(json.loads(str(arrays["said"])) | changed))
    np.savez(tmp_path / "old.npz", **arrays)
    with pytest.raises(ConfigError, match=said):
        BCPolicy(tmp_path / "old.npz")
