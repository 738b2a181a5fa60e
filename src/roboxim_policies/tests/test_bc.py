"""Behaviour cloning learns what demonstrations show."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from made_up_demonstrations import CONFIG, assembled, data, episode, first_action, held_episode

from roboxim_core.actions import ActionSemantics, ReferenceFrame
from roboxim_core.errors import ConfigError
from roboxim_core.proprioception import STATE_NAMES, Proprioception
from roboxim_datasets.dataset import Description, Features
from roboxim_datasets.episode import ImageSize, Step
from roboxim_datasets.registry import FORMATS
from roboxim_policies.bc.config import BCConfig
from roboxim_policies.learning.augment import augmentation
from roboxim_policies.learning.checkpoint import load_checkpoint
from roboxim_policies.learning.data import Demonstrations, assemble, read_demonstrations
from roboxim_policies.learning.features import proprio_features, word_indices
from roboxim_policies.learning.layers import TargetHead, turned
from roboxim_policies.learning.points import PointEncoder
from roboxim_policies.learning.policy import LearnedPolicy
from roboxim_policies.learning.samples import Samples
from roboxim_policies.learning.supply import Supply
from roboxim_policies.learning.train import Trainer, statistics
from roboxim_policies.learning.validation import before_release, validate


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


def test_words_and_yaw_are_read_as_meant():
    assert word_indices("Pick up the RED cube, please!", ("cube", "red"), 4).tolist() == [2, 1, 0, 0]
    down = Proprioception(tcp_rotation_6d=(1.0, 0.0, 0.0, 0.0, -1.0, 0.0)).vector()
    half_turn = Proprioception(tcp_rotation_6d=(-1.0, 0.0, 0.0, 0.0, 1.0, 0.0)).vector()  # the same for two fingers
    eighth = Proprioception(tcp_rotation_6d=(2**-0.5, 2**-0.5, 0.0, 2**-0.5, -(2**-0.5), 0.0), gripper_opening=0.5)
    assert np.allclose(proprio_features(down), proprio_features(half_turn), atol=1e-6)
    assert proprio_features(eighth.vector()) == pytest.approx([0, 0, 0, 0.5, 1, 0, 0, 0], abs=1e-6)


def test_vectors_of_the_tool_and_of_the_base_turn_into_each_other_alike():
    """Of a tool that points down, up to the sign of y: so actions of either frame are a sum of both."""
    yaw, mirror = 0.7, np.array([1.0, -1.0])
    down = np.array([[np.cos(yaw), np.sin(yaw)], [np.sin(yaw), -np.cos(yaw)]])  # x and y of the tool, in columns
    vector, heading = jnp.array([0.3, -0.5]), jnp.array([np.cos(yaw), np.sin(yaw)])
    for axes in (down, down.T):
        np.testing.assert_allclose(turned(vector * mirror, heading), axes @ vector, atol=1e-6)


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
