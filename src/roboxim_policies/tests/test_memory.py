"""What a policy remembers of its grasps: the same in a training and while it acts."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from made_up_demonstrations import assembled, held_episode

from roboxim_core.policies import EpisodeStart, Observation, ObservationWindow
from roboxim_policies.bc.config import BCConfig
from roboxim_policies.learning.features import PROPRIO_SIZE, GraspMemory, proprio_features, state_features
from roboxim_policies.learning.policy import LearnedPolicy
from roboxim_policies.learning.train import Trainer


def lived(proprio: np.ndarray, actions: np.ndarray, empty: float = 0.1) -> np.ndarray:
    """Return what a policy that acts on every tick remembers, shape (T, 11)."""
    memory, seen = GraspMemory(empty), []
    for row, action in zip(proprio, actions, strict=True):
        seen.append(memory.observe(row))
        memory.commanded(action[6] == 0)
    return np.stack(seen)


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
