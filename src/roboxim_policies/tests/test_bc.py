"""Behaviour cloning learns, resumes exactly after an interruption, and never leaves an incomplete checkpoint."""

import hashlib
import json
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from roboxim_core.actions import ActionSemantics, ReferenceFrame
from roboxim_core.errors import ConfigError
from roboxim_core.policies import EpisodeStart, Observation, ObservationWindow
from roboxim_core.proprioception import STATE_NAMES, Proprioception
from roboxim_datasets.dataset import Description, Features
from roboxim_datasets.episode import ImageSize, Step
from roboxim_datasets.registry import FORMATS
from roboxim_policies.bc.config import BCConfig
from roboxim_policies.learning.augment import augmentation
from roboxim_policies.learning.checkpoint import Checkpoint, load_checkpoint, policy_only
from roboxim_policies.learning.data import Demonstration, Demonstrations, assemble, read_demonstrations
from roboxim_policies.learning.features import PROPRIO_SIZE, GraspMemory, proprio_features, state_features, word_indices
from roboxim_policies.learning.layers import TargetHead, turned
from roboxim_policies.learning.points import PointEncoder
from roboxim_policies.learning.policy import LearnedPolicy
from roboxim_policies.learning.samples import Samples
from roboxim_policies.learning.supply import Supply
from roboxim_policies.learning.train import Trainer, statistics
from roboxim_policies.learning.validation import before_release, validate

CONFIG = BCConfig(
    steps=300, learning_rate=3e-3, batch=16, warmup_steps=10, ema_decay=0.9, chunk=4, execute=2,
    channels=8, keypoints=8, hidden=32, image_sizes={"workspace": 32, "wrist": 16}, brightness=0.05,
    checkpoint_every=100,
)  # fmt: skip
COLORS = {"red": (220, 30, 30), "blue": (30, 30, 220)}


def episode(rng: np.random.Generator, color: str, steps: int = 8) -> Demonstration:
    """Return an episode: images with a square per colour, actions along x to the named one, then a closing gripper.

    Nothing but the words and the picture tells the direction: the arm is measured where it began until the gripper
    closes.
    """
    places = dict(zip(COLORS, rng.permutation([4, 22]), strict=True))
    picture = np.full((32, 32, 3), 128, np.uint8)
    for name, column in places.items():
        row = rng.integers(2, 24)
        picture[row : row + 6, column : column + 6] = COLORS[name]
    direction = 1.0 if places[color] > 10 else -1.0
    actions = np.zeros((steps, 7), np.float32)
    actions[:, 0] = 0.02 * direction
    actions[:, 6] = np.arange(steps) < steps - 2
    measured = [
        Proprioception(tcp_position=(0.5 if opening else 0.5 + 0.12 * direction, 0.0, 0.0), gripper_opening=opening)
        for opening in actions[:, 6].tolist()
    ]
    proprio = np.stack([each.vector() for each in measured])
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


def test_trainings_of_one_seed_meet_the_samples_that_they_share_in_the_same_order():
    rng = np.random.default_rng(0)
    episodes = [episode(rng, ("red", "blue")[i % 2], steps=6 + i % 3) for i in range(12)]
    facts = {"camera_sizes": {"workspace": (32, 32), "wrist": (16, 16)}, "semantics": ActionSemantics()}
    one, other = assemble(episodes[:9], **facts), assemble([episodes[9], *episodes[5:9], *episodes[3:5]], **facts)
    shared = set(one.keys) & set(other.keys)
    assert len(shared) == sum(len(each.actions) for each in episodes[3:9]) < len(one)
    for epoch in (0, 1):
        orders = [data.keys[Supply(data, CONFIG)._order_of(epoch)] for data in (one, other)]
        assert len(set(orders[0])) == len(one)
        first, second = ([key for key in order if key in shared] for order in orders)
        assert first == second
        assert first != [key for key in one.keys if key in shared]
    twice = assemble(episodes[:1] * 2, **facts)
    assert len(set(twice.keys)) == len(twice)
    later = Supply(one, CONFIG)._order_of(1), Supply(one, replace(CONFIG, seed=1))._order_of(0)
    assert all((order != Supply(one, CONFIG)._order_of(0)).any() for order in later)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bc")
    reports = []
    Trainer(data(), CONFIG, folder).run(reports.append)
    return folder, reports


def first_action(policy: LearnedPolicy, demonstration: Demonstration, instruction: str) -> np.ndarray:
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


@pytest.mark.thorough
def test_it_learns_to_follow_the_named_colour(trained):
    folder, reports = trained
    assert reports[-1].step == CONFIG.steps
    assert reports[-1].parts["move"] < 0.3 * reports[0].parts["move"]
    policy = LearnedPolicy(folder)
    rng = np.random.default_rng(0)
    right = 0
    for i in range(24):
        shown = episode(rng, ("red", "blue")[i % 2])
        other = shown.instruction.replace("red", "x").replace("blue", "red").replace("x", "blue")
        direction = np.sign(shown.actions[0, 0])
        right += np.sign(first_action(policy, shown, shown.instruction)[0]) == direction
        right += np.sign(first_action(policy, shown, other)[0]) == -direction
    assert right >= 44  # of 48: the word decides


@pytest.mark.thorough
def test_what_never_moves_stays_exactly_still(trained):
    action = first_action(LearnedPolicy(trained[0]), episode(np.random.default_rng(5), "red"), "Pick up the red cube")
    assert action[1:6].tolist() == [0.0] * 5
    assert action[6] == pytest.approx(1.0, abs=0.05)


@pytest.mark.thorough
def test_it_describes_what_it_was_trained_on(trained):
    description = LearnedPolicy(trained[0], execute=3).describe()
    assert [(c.name, c.width, c.height) for c in description.cameras] == [("workspace", 32, 32), ("wrist", 16, 16)]
    assert description.horizon == 3
    assert description.semantics == ActionSemantics()
    assert description.version.startswith("step 300, ")
    assert not description.privileged
    assert load_checkpoint(trained[0]).robot == "panda"
    with pytest.raises(ConfigError, match="1..4"):
        LearnedPolicy(trained[0], execute=5)


@pytest.mark.thorough
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


@pytest.mark.thorough
def test_another_configuration_or_data_set_is_not_resumed(trained):
    with pytest.raises(ConfigError, match=r"of another configuration \(seed: 0 stored, 1 requested\); choose"):
        Trainer(data(), replace(CONFIG, seed=1), trained[0])
    with pytest.raises(ConfigError, match="of another dataset; choose"):
        Trainer(data(20), CONFIG, trained[0])
    with pytest.raises(ConfigError, match="exists"):
        Trainer(data(), CONFIG, trained[0], resume=False)


def test_every_label_and_picture_belongs_to_the_identity_of_a_training():
    known = data(6)
    identity = Checkpoint.identity_of(CONFIG, known)
    assert Checkpoint.identity_of(replace(CONFIG, checkpoint_every=7), data(6)) == identity
    others = {0: 1, 1: 0}  # two instructions change places: the same words, the same number of each
    corrected = np.vectorize(others.get)(known.instruction).astype(known.instruction.dtype)
    words = np.stack([known.words[np.flatnonzero(known.instruction == number)[0]] for number in corrected])
    images = {name: pictures.copy() for name, pictures in known.images.items()}
    images["workspace"][17, 3, 3] += 1
    for changed in (
        replace(known, instruction=corrected, words=words), replace(known, images=images),
        replace(known, instructions=tuple(text.replace("cube", "block") for text in known.instructions)),
    ):  # fmt: skip
        assert Checkpoint.identity_of(CONFIG, changed) != identity


@pytest.mark.thorough
def test_a_checkpoint_of_the_earlier_format_acts_and_is_not_continued(trained, tmp_path):
    with np.load(trained[0] / "checkpoint.npz") as archive:
        arrays = dict(archive)
    arrays["said"] = np.array(json.dumps(json.loads(str(arrays["said"])) | {"format": 5}))
    np.savez(tmp_path / "checkpoint.npz", **arrays)
    shown = episode(np.random.default_rng(3), "red")
    policies = LearnedPolicy(trained[0]), LearnedPolicy(tmp_path)
    assert np.array_equal(*(first_action(policy, shown, shown.instruction) for policy in policies))
    with pytest.raises(ConfigError, match="its policy acts, and its training cannot be continued.*another output"):
        Trainer(data(), CONFIG, tmp_path)


@pytest.mark.thorough
def test_a_failed_write_leaves_the_old_checkpoint_whole(trained, tmp_path, monkeypatch):
    trainer = Trainer(data(), CONFIG, tmp_path)
    trainer.run(until=10)
    before = (tmp_path / "checkpoint.npz").read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("roboxim_policies.learning.checkpoint.os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        trainer.run(until=20)
    assert (tmp_path / "checkpoint.npz").read_bytes() == before
    assert load_checkpoint(tmp_path).step == 10


@pytest.mark.thorough
def test_a_damaged_checkpoint_is_refused_by_name(trained, tmp_path):
    whole = (trained[0] / "checkpoint.npz").read_bytes()
    (tmp_path / "half.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ConfigError, match=r"half\.npz"):
        LearnedPolicy(tmp_path / "half.npz")
    with pytest.raises(ConfigError, match="roboxim train bc"):
        LearnedPolicy(tmp_path / "absent")


@pytest.mark.thorough
def test_a_copy_without_the_state_of_the_training_acts_the_same(trained, tmp_path):
    whole = trained[0] / "checkpoint.npz"
    short = tmp_path / "checkpoint.npz"
    short.write_bytes(policy_only(whole))
    assert short.stat().st_size < whole.stat().st_size / 3
    one, other = load_checkpoint(whole), load_checkpoint(tmp_path)
    assert not np.array_equal(one.arrays[0], one.arrays[-1]), "the weights are not their average"
    assert [array.tolist() for array in other.arrays] == [one.arrays[-1].tolist()]
    assert (one.original_sha256, other.original_sha256) == ("", hashlib.sha256(whole.read_bytes()).hexdigest())
    assert (other.step, other.identity, other.digest, other.robot) == (300, one.identity, one.digest, "panda")
    policies = LearnedPolicy(whole), LearnedPolicy(tmp_path)
    assert policies[0].describe() == policies[1].describe()
    rng = np.random.default_rng(3)
    for color in COLORS:
        shown = episode(rng, color)
        answers = [first_action(policy, shown, shown.instruction) for policy in policies]
        assert np.array_equal(*answers)
    assert policy_only(trained[0]) == short.read_bytes(), "the folder gives the same bytes"
    with pytest.raises(ConfigError, match="has the averaged weights only already"):
        policy_only(short)


@pytest.mark.thorough
@pytest.mark.parametrize(("steps", "said"), [(300, "has all its steps"), (10, "cannot continue")])
def test_no_training_continues_from_such_a_copy(trained, tmp_path, steps, said):
    whole = Trainer(data(), CONFIG, tmp_path / "whole").run(until=steps) if steps < CONFIG.steps else trained[0]
    short = tmp_path / "checkpoint.npz"
    before = policy_only(whole)
    short.write_bytes(before)
    text = (
        f"averaged weights only, after {steps} of 300 steps: .*experiment pack.*; the training {said}.*choose another"
    )
    with pytest.raises(ConfigError, match=text):
        Trainer(data(), CONFIG, tmp_path)
    with pytest.raises(ConfigError, match="of another configuration"):
        Trainer(data(), replace(CONFIG, seed=1), tmp_path)
    assert short.read_bytes() == before


@pytest.mark.thorough
def test_weights_that_are_not_those_of_the_description_are_not_copied(trained, tmp_path):
    with np.load(trained[0] / "checkpoint.npz") as archive:
        content = dict(archive)
    content[max(content.keys() - {"said"})] += 1.0
    np.savez(tmp_path / "checkpoint.npz", **content)
    with pytest.raises(ConfigError, match="is damaged: the hash of its averaged weights differs"):
        policy_only(tmp_path)
    np.savez(tmp_path / "checkpoint.npz", said=content["said"])
    with pytest.raises(ConfigError, match="it has no weights"):
        load_checkpoint(tmp_path)


def test_words_and_yaw_are_read_as_meant():
    assert word_indices("Pick up the RED cube, please!", ("cube", "red"), 4).tolist() == [2, 1, 0, 0]
    down = Proprioception(tcp_rotation_6d=(1.0, 0.0, 0.0, 0.0, -1.0, 0.0)).vector()
    half_turn = Proprioception(tcp_rotation_6d=(-1.0, 0.0, 0.0, 0.0, 1.0, 0.0)).vector()  # the same for two fingers
    eighth = Proprioception(tcp_rotation_6d=(2**-0.5, 2**-0.5, 0.0, 2**-0.5, -(2**-0.5), 0.0), gripper_opening=0.5)
    assert np.allclose(proprio_features(down), proprio_features(half_turn), atol=1e-6)
    assert proprio_features(eighth.vector()) == pytest.approx([0, 0, 0, 0.5, 1, 0, 0, 0], abs=1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("changed", "said"),
    [({"step": "x"}, "step: expected a whole number"), ({"stats": {"state_mean": [1.0]}}, "stats must have the len"),
     ({"vocabulary": 1}, "vocabulary: expected a list"), ({"word_count": -1}, "word_count, .* must be >= 1"),
     ({"camera_sizes": {"workspace": [1]}}, "camera_sizes.workspace: expected 2 values, got 1"),
     ({"input_sizes": {}}, "input_sizes must name the cameras"), ({"empty_below": None}, "empty_below: expected a num"),
     ({"state_layout": None}, "trained on proprioception None"), ({"chosen": {}}, "chosen.step: required key")],
)  # fmt: skip
def test_a_wrong_description_of_a_checkpoint_is_refused_by_its_field(trained, tmp_path, changed, said):
    with np.load(trained[0] / "checkpoint.npz") as archive:
        arrays = dict(archive)
    arrays["said"] = np.array(json.dumps(json.loads(str(arrays["said"])) | changed))
    np.savez(tmp_path / "wrong.npz", **arrays)
    with pytest.raises(ConfigError, match=rf"wrong\.npz.*{said}"):
        load_checkpoint(tmp_path / "wrong.npz")


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("changed", "said"),
    [({"format": 1}, r"old\.npz was trained on proprioception of the old layout.*train again"),
     ({"format": 2}, r"old\.npz holds the earlier network.*train again"),
     ({"state_layout": ["x", "y"]}, r"trained on proprioception \['x', 'y'\]")],
)  # fmt: skip
def test_a_checkpoint_of_another_proprioception_is_refused_by_name(trained, tmp_path, changed, said):
    with np.load(trained[0] / "checkpoint.npz") as archive:
        arrays = dict(archive)
    arrays["said"] = np.array(json.dumps(json.loads(str(arrays["said"])) | changed))
    np.savez(tmp_path / "old.npz", **arrays)
    with pytest.raises(ConfigError, match=said):
        LearnedPolicy(tmp_path / "old.npz")


def held_episode(opened_to: float = 0.6) -> tuple[np.ndarray, np.ndarray]:
    """Return proprioception and actions: the gripper closes to 0.5, turns by 90 degrees, rises, and opens."""
    rows, actions = [], []
    for step in range(24):
        yaw = np.deg2rad(-90) * np.clip((step - 10) / 6, 0, 1)
        c, s = float(np.cos(yaw)), float(np.sin(yaw))
        opening = 1.0 if step < 6 else 0.5 if step < 19 else opened_to
        at = Proprioception(
            tcp_position=(0.5, 0.0, 0.02 + 0.01 * max(0, step - 8)), tcp_rotation_6d=(c, s, 0.0, s, -c, 0.0),
            gripper_opening=opening,
        )  # fmt: skip
        rows.append(at.vector())
        rise = 0.01 if step >= 8 else 0.0
        actions.append([0.0, 0.0, rise, 0.0, 0.0, 0.0, 1.0 if step < 5 else 0.0 if step < 18 else opened_to])
    return np.stack(rows), np.array(actions, np.float32)


def assembled(*episodes: tuple[np.ndarray, np.ndarray], semantics: ActionSemantics | None = None) -> Demonstrations:
    return assemble(
        [
            Demonstration(
                images={"wrist": np.zeros((len(a), 16, 16, 3), np.uint8)}, proprio=p, actions=a, instruction="x"
            )
            for p, a in episodes
        ],
        camera_sizes={"wrist": (16, 16)},
        semantics=semantics or ActionSemantics(),
    )


def lived(proprio: np.ndarray, actions: np.ndarray, empty: float = 0.1) -> np.ndarray:
    """Return what a policy that acts on every tick remembers, shape (T, 11)."""
    memory, seen = GraspMemory(empty), []
    for row, action in zip(proprio, actions, strict=True):
        seen.append(memory.observe(row))
        memory.commanded(action[6] == 0)
    return np.stack(seen)


def test_vectors_of_the_tool_and_of_the_base_turn_into_each_other_alike():
    """Of a tool that points down, up to the sign of y: so actions of either frame are a sum of both."""
    yaw, mirror = 0.7, np.array([1.0, -1.0])
    down = np.array([[np.cos(yaw), np.sin(yaw)], [np.sin(yaw), -np.cos(yaw)]])  # x and y of the tool, in columns
    vector, heading = jnp.array([0.3, -0.5]), jnp.array([np.cos(yaw), np.sin(yaw)])
    for axes in (down, down.T):
        np.testing.assert_allclose(turned(vector * mirror, heading), axes @ vector, atol=1e-6)


def test_memory_tells_how_far_a_held_object_was_turned_and_that_it_was_put_down():
    seen = lived(*held_episode())
    assert not seen[:6].any()  # nothing was grasped yet
    assert seen[6:, 0].all()
    angles = np.rad2deg(np.arctan2(seen[:, 6], seen[:, 7]))
    assert angles[[10, 13, 18]] == pytest.approx([0, -45, -90], abs=1e-3)
    assert seen[18, 3] == pytest.approx(0.1)  # risen since the grasp
    assert seen[18, 8] == 0
    assert seen[19:, 8] == pytest.approx(0.1)  # opened: it was put down
    assert not seen[6:19, 9].any()
    assert seen[19:, 9].all()


def test_memory_forgets_a_gripper_that_closed_on_nothing():
    proprio, actions = held_episode()
    proprio[8:19, 9], proprio[8:, 2] = 0.01, 0.02
    proprio[19:, 2] += 0.012 * np.arange(5)  # opened again, it rises
    seen = lived(proprio, actions)
    assert seen[7].any()
    assert not seen[8:19, :-1].any()
    assert seen[8:, -1].all()  # 48 mm are not enough
    proprio[22:, 2] += 0.05
    assert lived(proprio, actions)[:, -1].tolist() == [False] * 8 + [True] * 14 + [False] * 2


def test_a_gripper_that_opens_less_holds_nothing():
    proprio, actions = held_episode()
    proprio[:6, 9], actions[:5, 6] = 0.45, 0.45  # less than the object is wide
    assert not lived(proprio, actions)[:6].any()
    grasps = assembled((proprio, actions)).grasps
    assert grasps[:6].max() < 0 <= grasps[6]


def failed_episode() -> tuple[np.ndarray, np.ndarray]:
    """Return `held_episode`, in which the gripper first closes on nothing; it rises by 8 cm only while it holds."""
    proprio, actions = held_episode()
    actions[1:3, 6], proprio[2:4, 9] = 0.0, 0.01
    return proprio, actions


def test_training_and_policy_compute_the_same_memory():
    episodes = [held_episode(), held_episode(1.0), failed_episode(), held_episode(0.7)]
    data = assembled(*episodes)
    assert data.empty == pytest.approx(0.25)
    assert data.failed.any()
    features = state_features(data.proprio, data.yaw, data.grasps, data.least_opening, data.released, data.failed)
    remembered = [
        np.concatenate([proprio_features(proprio), lived(proprio, actions, data.empty)], axis=1)
        for proprio, actions in episodes
    ]
    assert features == pytest.approx(np.concatenate(remembered), abs=1e-5)


@pytest.mark.thorough
@pytest.mark.parametrize(("executed", "grasped"), [(None, True), (1.0, False)])
def test_the_memory_follows_the_command_that_was_executed_not_the_one_that_was_answered(tmp_path, executed, grasped):
    Trainer(assembled(held_episode()), BCConfig(steps=1, channels=8, hidden=8), tmp_path).save()
    policy = LearnedPolicy(tmp_path)
    predict, states = policy._predict, []

    def closing(weights, inputs):
        states.append(np.asarray(inputs.state[0]))
        return eqx.tree_at(lambda p: p.closed, predict(weights, inputs), jnp.ones((1, 8)))

    policy._predict = closing
    policy.reset(EpisodeStart(episode_id="e", instruction="x", seed=0))
    for seq, opening in ((0, None), (4, executed)):
        seen = Observation(seq=seq, stamp_ns=0, images={"wrist": np.zeros((16, 16, 3), np.uint8)})
        window = ObservationWindow(
            instruction="x", observations=[seen], pad_mask=(True,), episode_id="e", seq=seq, commanded_opening=opening
        )
        policy.act(window)
    stats = policy._loaded.stats
    held = states[1][PROPRIO_SIZE] * stats.state_scale[PROPRIO_SIZE] + stats.state_mean[PROPRIO_SIZE]
    assert (held > 0.5) == grasped


@pytest.mark.thorough
def test_gripper_opens_as_far_as_in_the_demonstrations(tmp_path):
    demonstrations = [episode(np.random.default_rng(i), ("red", "blue")[i % 2]) for i in range(24)]
    for shown in demonstrations:
        shown.actions[:, 6] = 0.6
    sizes = {"workspace": (32, 32), "wrist": (16, 16)}
    learned = assemble(demonstrations, camera_sizes=sizes, semantics=ActionSemantics())
    Trainer(learned, CONFIG, tmp_path).run(until=60)
    action = first_action(LearnedPolicy(tmp_path), demonstrations[0], "Pick up the red cube")
    assert action[6] == pytest.approx(0.6, abs=0.1)


def drawn(data: Demonstrations, config: BCConfig, batch: np.ndarray):
    samples = Samples.of(data, statistics(data), config)
    return samples.draw(jnp.asarray(batch), augmentation(config, ("wrist",), 0, len(batch)), config)


@pytest.mark.thorough
def test_empty_gripper_is_taught_to_open_and_rise_before_a_grasp_only():
    data = assembled(held_episode(), held_episode())
    config = replace(CONFIG, retry=1.0, position_noise_m=0.0, opening_noise=0.0)
    _, wanted = drawn(data, config, np.array([0, 12]))
    assert np.all(wanted.opening[0] == 1)
    assert np.all(wanted.motion[0, :, 2] > 0)
    assert np.all(wanted.opening[1] == 0)  # it holds something
    proprio, actions = held_episode()
    proprio[:2, 9] = 0.0  # a demonstration that begins with a closed, empty gripper
    _, wanted = drawn(assembled((proprio, actions), held_episode()), config, np.array([2, 12]))
    assert not np.all(wanted.motion[0, :, 2] > 0)


@pytest.mark.thorough
@pytest.mark.parametrize("tilt", [0.0, 0.5])
def test_an_empty_gripper_rises_in_the_frame_of_the_actions(tilt):
    """The tool looks down, tilted about its y axis [rad]."""
    proprio, actions = held_episode()
    actions[:, 0] = 0.01
    c, s = float(np.cos(tilt)), float(np.sin(tilt))
    proprio[:, 3:9] = (c, 0.0, s, 0.0, -1.0, 0.0)
    data = assembled((proprio, actions), semantics=ActionSemantics(frame=ReferenceFrame.TOOL))
    stats = statistics(data)
    _, wanted = drawn(data, replace(CONFIG, retry=1.0, opening_noise=0.0), np.array([0]))
    x, y, z = np.asarray(wanted.motion[0, 0, :3]) * stats.motion_scale[:3]
    assert z < 0, "the tool's z axis points down"
    axes = np.array([[c, 0.0, s], [0.0, -1.0, 0.0], [s, 0.0, -c]])  # of the tool, in the base
    rise = (x, y, z) @ axes
    assert rise == pytest.approx([0.0, 0.0, 0.01], abs=1e-6)


@pytest.mark.thorough
def test_noise_never_makes_a_held_object_look_lost():
    data = assembled(*[held_episode()] * 4)
    config = replace(CONFIG, retry=0.0, opening_noise=5.0)
    inputs, _ = drawn(data, config, np.flatnonzero(data.grasps >= 0))
    stats = statistics(data)
    openings = np.asarray(inputs.state)[:, 3] * stats.state_scale[3] + stats.state_mean[3]
    assert openings.min() >= data.empty - 1e-5
    assert openings.std() > 0.1


def test_a_displacement_in_the_tools_frame_turns_with_the_tool():
    head = TargetHead(4, 8, rng=np.random.default_rng(0))
    bias = jnp.zeros_like(head.output.bias).at[-2:].set(jnp.array([1.0, 0.0]))  # 1 ahead of the tool
    head = eqx.tree_at(lambda h: (h.output.weight, h.output.bias), head, (jnp.zeros_like(head.output.weight), bias))
    headings = jnp.array([[1.0, 0.0], [0.0, 1.0]])  # yaw of 0 and of 90 degrees
    assert np.asarray(head(jnp.ones((2, 4)), headings))[:, :2] == pytest.approx(np.array([[1, 0], [0, 1]]), abs=1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize(("film", "outputs"), [(None, 2 * 2 * 8), (2, 2 * 2 * 8), (1, 2 * 8), (0, 0)])
def test_the_instruction_modulates_as_many_convolutions_as_configured(film, outputs):
    encoder = PointEncoder(
        channels=8, depth=1, keypoints=4, words=CONFIG.word_size, film=film, rng=np.random.default_rng(0)
    )
    assert (0 if encoder.film is None else encoder.film.bias.shape[0]) == outputs
    image = jnp.asarray(np.random.default_rng(1).uniform(-0.5, 0.5, (1, 32, 32, 3)), jnp.float32)
    said = [encoder(image, value * jnp.ones((1, CONFIG.word_size))) for value in (0.0, 5.0)]
    assert bool(jnp.allclose(*said)) == (film == 0)
    with pytest.raises(ConfigError, match=r"film must be 0\.\.2"):
        replace(CONFIG, film=3)


@pytest.mark.thorough
def test_errors_on_held_out_demonstrations_are_in_units_that_a_user_knows(trained):
    rng = np.random.default_rng(7)
    others = assemble(
        [episode(rng, ("red", "blue")[i % 2]) for i in range(8)],
        camera_sizes={"workspace": (32, 32), "wrist": (16, 16)},
        semantics=ActionSemantics(),
        like=data(),
    )
    found = validate(load_checkpoint(trained[0]), others)
    assert found.motion_mm < 10  # of 20 mm in each tick
    assert found.turn_mrad == 0
    assert found.grasp_mm < 60  # of up to 120 mm
    assert found.gripper < 0.1


def test_a_release_is_judged_while_something_is_held_and_opened_later():
    proprio, actions = held_episode()
    kept = actions.copy()
    kept[:, 6] = np.minimum(kept[:, 6], np.where(np.arange(24) < 5, 1.0, 0.0))  # the episode ends with the object held
    found = before_release(assembled((proprio, actions), (proprio, kept)))
    steps = np.flatnonzero(found)
    assert steps[0] >= 5
    assert steps.tolist() == list(range(steps[0], 18)), "not after the release, and not without one"


def test_poses_as_actions_are_refused(tmp_path):
    semantics = ActionSemantics(control="end_effector_absolute")  # seven numbers as well
    names = {"state": tuple(STATE_NAMES)}
    features = Features(
        cameras={"workspace": ImageSize(height=32, width=32)}, keys={"workspace": "image"}, lossless=True,
        action=semantics.component_names(), vectors=names,
    )  # fmt: skip
    description = Description(features=features, fps=20, semantics=semantics, metadata={}, robot="panda")

    def read(wanted):
        pose = np.array([0.5, 0.1, 0.2, 3.14, 0, 0, 1], np.float32)
        for index in range(4):
            images = {camera: np.zeros((32, 32, 3), np.uint8) for camera in wanted.cameras}
            yield Step(index=index, images=images, proprio={"state": np.zeros(10, np.float32)}, action=pose)

    episode = description.episode(
        length=4, instruction="pick up the cube", success=True, metadata={}, read=read, name="a"
    )
    made = FORMATS["hdf5"]()
    with made.create(tmp_path / "d", description, made.options(), identity="", overwrite=False) as writer:
        writer.add("train", episode)
        writer.complete({})
    with pytest.raises(ConfigError, match="are end_effector_absolute of 7 numbers; it learns end_effector_delta of 7"):
        read_demonstrations(tmp_path / "d")
