"""RoboXim's Gymnasium environments: Gymnasium's own checker, evaluate's scenes and verdicts, processes."""

import functools
import multiprocessing
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

pytest.importorskip("rclpy")

from roboxim_core.config_folders import config_names
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError, EvaluationError, PolicyError
from roboxim_core.verdicts import Verdict
from roboxim_runs.environments.benchmark_audit import AuditConfig, audit_benchmark, environment_maker
from roboxim_runs.environments.gymnasium_env import RoboXimEnv
from roboxim_runs.environments.session import EpisodeSession, SessionConfig

NAME = "roboxim:roboxim/PickCube-v0"


@pytest.fixture(scope="module")
def env():
    made = gymnasium.make(NAME, size=32)
    yield made
    made.close()


@pytest.fixture(scope="module")
def expert(expert_bag):
    """The second scene that an evaluation with seed 5 has."""
    _, result, ticks = expert_bag(seed=5, index=1, size=32)
    return result, ticks


@pytest.mark.slow
def test_the_audit_of_benchmarks_finds_nothing():
    """The command and the line of docs/how-to/audit_benchmark.md."""
    make = environment_maker("roboxim/PickCube-v0", size=32)
    found = audit_benchmark(make, AuditConfig(episodes=1, seeds=4, steps=8))
    assert found.findings == ()
    assert len(found.passed) == 20


@pytest.mark.thorough
def test_gymnasiums_checker_finds_nothing(env):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


def test_an_episode_is_the_one_that_evaluate_gives_for_the_seed_and_index(env, expert):
    result, ticks = expert
    env.reset(seed=5)
    observation, info = env.reset()
    assert (info["seed"], info["index"]) == (5, 1)
    assert info["scene_hash"] == ticks[0].state.scene_hash
    assert info["task_description"] == result.instruction == env.unwrapped.task_description
    np.testing.assert_array_equal(observation["pixels"]["wrist"], ticks[0].images["wrist"])
    for tick in ticks[1 : result.steps + 1]:
        observation, reward, terminated, truncated, info = env.step(np.array(tick.step.action_executed, np.float32))
        assert (reward > 0) == terminated == (tick.seq == result.steps)
    assert (reward, terminated, truncated, info["is_success"]) == (1.0, True, False, True)
    assert env.unwrapped.session._running().sim.world.record.state_hash == result.final_state_hash
    with pytest.raises(PolicyError, match="start one first"):
        env.step(env.action_space.sample())
    again = env.reset(seed=5, options={"index": 1})[1]
    assert again["scene_hash"] == ticks[0].state.scene_hash


def test_running_out_of_actions_truncates_and_a_wrong_action_is_named():
    env = gymnasium.make(NAME, size=32, max_steps=2, control="joint_position", disable_env_checker=True)
    assert env.unwrapped._max_episode_steps == 2
    assert env.action_space.shape == (8,)
    env.reset(seed=0)
    still = env.unwrapped.session.observe().proprio.joint_positions
    assert env.step(np.array([*still, 1.0], np.float32))[1:4] == (0.0, False, False)
    *_, reward, terminated, truncated, info = env.step(np.array([*still, 1.0], np.float32))
    assert (reward, terminated, truncated, info["is_success"]) == (0.0, False, True, False)
    env.reset()
    with pytest.raises(EvaluationError, match="invalid_action: .*takes 8: panda_joint1"):
        env.step(np.zeros(7, np.float32))
    env.close()


@pytest.mark.parametrize(
    ("reason", "verdict", "of_largest", "truncated"),
    [
        ("not_lifted", Verdict(reason="not_lifted"), 0.5, True),  # a cell of a mix has a limit of its own
        ("fell_off_table", Verdict(reason="fell_off_table", failed=True), 1.0, False),
        ("left_workspace", Verdict(), 1.0, False),
        ("not_stable", Verdict(success_ever=True), 1.0, False),
    ],
)
def test_only_the_limit_of_actions_truncates(env, monkeypatch, reason, verdict, of_largest, truncated):
    session = env.unwrapped.session
    steps = round(of_largest * session.max_steps)
    result = EpisodeResult(episode_id="e", index=0, reason=reason, verdict=verdict, steps=steps)
    env.reset(seed=0)
    monkeypatch.setattr(session, "step", lambda action: result)
    assert env.step(np.zeros(7, np.float32))[2:4] == (not truncated, truncated)


def test_environments_without_a_seed_differ_and_numpys_whole_numbers_are_seeds(env, monkeypatch):
    started = []
    env.reset(seed=0)
    window = env.unwrapped.session.start(0, 0)
    monkeypatch.setattr(EpisodeSession, "start", lambda self, seed, index: started.append((seed, index)) or window)
    others = [RoboXimEnv(size=32) for _ in range(2)]
    for other in others:
        other.session._graph = env.unwrapped.session._graph
        assert other.reset()[1]["seed"] == started[-1][0]
        other.reset()
    (first, zero), (again, one), (second, _), _ = started
    assert (again, zero, one) == (first, 0, 1), "the next episode of the same seed"
    assert second != first
    env.reset(seed=np.int64(7), options={"index": np.int32(2)})
    assert started[-1] == (7, 2)
    assert [type(number) for number in started[-1]] == [int, int]
    for seed in (-1, 1.5, "7"):
        with pytest.raises(ConfigError, match="seed must be a whole number >= 0, got"):
            env.unwrapped.reset(seed=seed)


def test_every_task_has_an_id_and_nothing_is_drawn_before_the_first_reset(monkeypatch):
    monkeypatch.setattr("roboxim_runs.environments.session.CoreGraph", lambda *_, **__: pytest.fail("drawn"))
    ids = [name for name in gymnasium.registry if name.startswith("roboxim/")]
    assert len(ids) == len(config_names("tasks"))
    ur5 = gymnasium.make("roboxim:roboxim/PickCubeUr5-v0", control="joint_velocity")
    assert ur5.action_space.shape == (7,)
    ur5.close()


def test_the_ids_are_there_if_roboxim_is_imported_before_gymnasium():
    script = "import roboxim, gymnasium; gymnasium.spec('roboxim/PickCube-v0')"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task": "pick_cubes"}, "pick_cube"),
        ({"control": "joint_speed"}, "joint_velocity"),
        ({"renderer": "rastr"}, "raster"),
        ({"control": "end_effector_absolute"}, "'end_effector_delta' or one in joint space"),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    with pytest.raises(ConfigError, match=message):
        gymnasium.make(NAME, **arguments)


def _make_forked(queue):
    try:
        EpisodeSession(SessionConfig(task="pick_cube"))
    except ConfigError as error:
        queue.put(str(error))


def test_a_forked_process_is_refused_by_name():
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Python warns of forking a process with threads, which is the point
        process = context.Process(target=_make_forked, args=(queue,))
        process.start()
    assert 'context="spawn"' in queue.get(timeout=120)
    process.join(timeout=60)


@pytest.mark.slow
def test_an_async_vector_environment_runs_in_spawned_processes(env):
    alone = env.reset(seed=3)[1]["scene_hash"]
    make = functools.partial(gymnasium.make, NAME, size=32, disable_env_checker=True)
    vector = gymnasium.vector.AsyncVectorEnv([make, make], context="spawn")
    try:
        observation, info = vector.reset(seed=2)
        assert observation["pixels"]["workspace"].shape == (2, 32, 32, 3)
        assert info["scene_hash"][1] == alone, "environment i has seed 2 + i"
        assert info["scene_hash"][0] != alone
        assert all(vector.call("task_description"))
        _, reward, *_ = vector.step(np.zeros((2, 7), np.float32))
        assert reward.tolist() == [0.0, 0.0]
    finally:
        vector.close()
