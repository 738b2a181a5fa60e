"""The audit of benchmarks on a toy environment: without a fault it finds none, and each planted fault is found."""

import random

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict

from roboxim_core.errors import ConfigError
from roboxim_runs.environments.benchmark_audit import AuditConfig, audit_benchmark, environment_maker

CONFIG = AuditConfig(seeds=6, steps=5, episodes=8, limit=20)
LEFT, RIGHT = "reach the left goal", "reach the right goal"


class Reach(gymnasium.Env):
    """A point reaches one of two goals, which its instruction names. ``fault`` plants a fault."""

    made = 0

    def __init__(self, fault=""):
        self.fault = fault
        where = Box(-5, 5, (2,), np.float64)
        self.observation_space = Dict({"point": where, "left": where, "right": where})
        self.action_space = Box(-0.6, 0.6, (2,), np.float64)
        self.resets, self.worn = 0, 0.0
        Reach.made += 1
        self.number = Reach.made
        self.rng = np.random.default_rng(0)

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self.rng = np.random.default_rng({"seed_ignored": 0, "few_scenes": seed % 2}.get(self.fault, seed))
        if self.fault == "unseeded_scenes" and seed is None:
            self.rng = np.random.default_rng()
        if self.fault == "unseeded_same" and seed is None:
            self.rng = np.random.default_rng(1)
        self.resets += 1
        shift = {
            "entropy": lambda: np.random.default_rng().normal(), "count_of_resets": lambda: 0.01 * (self.resets > 3),
            "instance": lambda: 0.01 * (self.number % 2), "leak": lambda: self.worn, "global": random.random,
        }.get(self.fault, float)()  # fmt: skip
        if self.fault == "seeds_global":
            np.random.seed(seed)
        self.point = self.rng.uniform(-1, 1, 2) + shift
        self.left = self.rng.uniform([-4, 3], [-3, 4])
        self.right = self.rng.uniform([3, 3], [4, 4])
        self.words = "" if self.fault == "empty_words" else (LEFT, RIGHT)[int(self.rng.integers(2))]
        if self.fault == "same_scene":
            self.point, self.left, self.right = np.zeros(2), np.array([-3.5, 3]), np.array([-3.5, 3])
            self.point += 1e-9 * self.rng.normal(size=2)
        if self.fault == "told_by_scene":
            self.left[:] = self.right[:] = self.left if self.words == LEFT else self.right
        self.ticks, self.done_once = 0, False
        self.shared = self.point.copy()
        return self.observation(), self.info(self.fault == "starts_solved")

    def observation(self):
        point = self.point.copy()
        if self.fault == "shared_observation":
            self.shared[:] = self.point
            point = self.shared
        if self.fault == "out_of_space":
            point += 20
        if self.fault == "nan_observation" and self.ticks > 3:
            point[0] = np.nan
        if self.fault == "frozen":
            point[:] = 0
        return {"point": point, "left": self.left.copy(), "right": self.right.copy()}

    def info(self, success):
        return {"task_description": self.words} | ({} if self.fault == "silent" else {"is_success": bool(success)})

    def step(self, action):
        if not np.isfinite(action).all():
            if self.fault != "nan_accepted":
                raise ValueError("the action is not finite")
            action = np.zeros(2)
        if self.fault == "action_changed":
            action *= 0.5
        if self.fault != "unclipped":
            action = np.clip(action, -0.6, 0.6)
        if self.fault != "no_effect":
            self.point = np.clip(self.point + action + (1e-6 * np.random.default_rng().normal()
                                                       if self.fault == "noisy_steps" else 0), -5, 5)  # fmt: skip
        self.ticks += 1
        self.worn += 0.001
        goal = self.left if self.words == LEFT else self.right
        near = bool(np.linalg.norm(self.point - goal) < 0.3)
        success = near or self.fault == "always_solved" or (self.fault == "random_solves" and np.abs(action).max() > 0)
        if self.fault == "flickers":
            success = self.ticks == 3 or near
        over = success and self.fault not in ("flickers",)
        limit = self.ticks >= 15 and self.fault != "endless"
        reward = float(success)
        if self.fault == "pays_failure":
            reward = float(self.ticks == 5)
        if self.fault == "inverted_dense":
            reward = float(np.linalg.norm(self.point - goal))
        if self.fault == "infinite_reward" and self.ticks == 2:
            reward = np.inf
        if self.fault == "nan_reward":
            reward = np.float64("nan")
        if self.fault == "limit_terminates":
            over, limit = over or limit, False
        return self.observation(), reward, bool(over), bool(limit and not over), self.info(success)


def solver():
    """Go to the goal that the instruction names; without words, to the left one."""

    def act(observation, words):
        goal = observation["right" if words == RIGHT else "left"]
        return np.nan_to_num(np.clip(goal - observation["point"], -0.6, 0.6))

    return act


PLANTED = {
    "entropy": "same_seed", "noisy_steps": "same_seed", "count_of_resets": "order", "instance": "instances",
    "leak": "reset_leak", "global": "global_random", "seeds_global": "global_state", "seed_ignored": "seeds_matter",
    "few_scenes": "seeds_matter", "unseeded_scenes": "unseeded", "unseeded_same": "unseeded", "out_of_space": "values",
    "nan_observation": "values", "shared_observation": "shared_memory", "action_changed": "shared_memory",
    "frozen": "observes_actions", "no_effect": "observes_actions", "unclipped": "clipped_actions",
    "nan_accepted": "nan_actions", "silent": "says_success", "always_solved": "no_motion",
    "random_solves": "random_actions", "starts_solved": "starts_unsolved", "pays_failure": "reward",
    "inverted_dense": "reward", "infinite_reward": "finite_rewards", "flickers": "keeps_success", "endless": "ends",
    "limit_terminates": "time_limit", "empty_words": "instructions", "told_by_scene": "words_needed",
    "same_scene": "scene_matters", "nan_reward": "finite_rewards",
}  # fmt: skip
"""Planted fault to the check that must find it."""


def test_an_environment_without_a_fault_passes_every_check():
    found = audit_benchmark(Reach, CONFIG, solver=solver)
    assert found.findings == ()
    assert found.untested == {}
    assert found.rates["solver"].startswith("8 of 8")
    assert found.rates["no motion"].startswith("0 of 8")


@pytest.mark.parametrize("fault", PLANTED)
def test_a_planted_fault_is_found(fault):
    found = audit_benchmark(lambda: Reach(fault), CONFIG, solver=solver)
    assert PLANTED[fault] in {one.check for one in found.findings}, found


@pytest.mark.parametrize(("fault", "check"), [("nan_reward", "finite_rewards"), ("nan_observation", "values")])
def test_nan_is_no_fault_of_repetitions_or_clipping(fault, check):
    found = {one.check for one in audit_benchmark(lambda: Reach(fault), CONFIG).findings}
    assert check in found
    assert not found & {"same_seed", "instances", "order", "reset_leak", "clipped_actions"}


def test_without_a_solver_what_needs_one_is_named():
    found = audit_benchmark(Reach, CONFIG)
    assert found.findings == ()
    assert {"words_needed", "replay", "scene_matters"} <= set(found.untested)


class Frames(Reach):
    """Observations are 8-bit images, and the reset says nothing about success."""

    def __init__(self, fault=""):
        super().__init__(fault)
        self.observation_space = Box(0, 255, (2,), np.uint8)

    def reset(self, **options):
        observation, info = super().reset(**options)
        info.pop("is_success")
        return observation, info

    def observation(self):
        return np.rint(127 + 25 * self.point).clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("make", "config", "check"),
    [
        (Reach, CONFIG, "keeps_success"),
        (Reach, AuditConfig(seeds=2, steps=5, episodes=1, limit=20), "time_limit"),
        (Frames, CONFIG, "starts_unsolved"),
        (lambda: Frames("unclipped"), CONFIG, "clipped_actions"),
        (lambda: Reach("always_solved"), CONFIG, "reward"),
        (lambda: Reach("nan_reward"), CONFIG, "reward"),
    ],
)
def test_a_check_that_could_not_be_made_has_not_passed(make, config, check):
    found = audit_benchmark(make, config)
    assert check in found.untested, found


def test_a_solver_without_words_to_follow_or_without_success_says_nothing_about_words():
    class One(Reach):
        def reset(self, **options):
            found = super().reset(**options)
            self.words = LEFT
            return found[0], self.info(False)

    assert "one instruction" in audit_benchmark(One, CONFIG, solver=solver).untested["words_needed"]
    idle = audit_benchmark(Reach, CONFIG, solver=lambda: lambda *_: np.zeros(2))
    assert "never succeeded" in idle.untested["words_needed"]


def test_images_show_whether_actions_are_clipped():
    assert "clipped_actions" in audit_benchmark(Frames, CONFIG).passed


def test_an_environment_that_changes_its_actions_repeats_its_episodes():
    found = {one.check for one in audit_benchmark(lambda: Reach("action_changed"), CONFIG, solver=solver).findings}
    assert found == {"shared_memory", "clipped_actions"}  # it halves them before it clips them


def test_a_solver_may_fill_one_array_again_and_again():
    def thrifty():
        act, array = solver(), np.zeros(2)

        def again(observation, words):
            array[:] = act(observation, words)
            return array

        return again

    assert audit_benchmark(Reach, CONFIG, solver=thrifty).findings == ()


@pytest.mark.parametrize(
    ("space", "scale", "outcome"),
    [
        (Box(0, 255, (2,), np.uint8), 0.001, "untested"),
        (Box(-100, 100, (2,), np.int8), 0.001, "untested"),
        (Box(-5, 5, (2,), np.int64), 0.01, "fault"),
        (Box(-0.6, 0.6, (), np.float32), 0.1, "fault"),
    ],
)
def test_actions_beyond_the_bounds_are_such_or_not_tested(space, scale, outcome):
    class Unclipped(Reach):
        def __init__(self):
            super().__init__("unclipped")
            self.action_space = space

        def step(self, action):
            return super().step(np.broadcast_to(scale * np.asarray(action, np.float64), 2).copy())

    found = audit_benchmark(Unclipped, CONFIG)
    assert ("clipped_actions" in found.untested) == (outcome == "untested")
    assert ("clipped_actions" in {one.check for one in found.findings}) == (outcome == "fault")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda observation, *_, info: (observation, 0.0, False, False, None), "NoneType in its place"),
        (lambda observation, *_, info: (observation, None, False, False, info), "float"),
        (lambda observation, *_, info: (observation, np.zeros(2), False, False, info), "Python scalar"),
    ],
)
def test_a_step_that_returns_something_else_is_refused_with_its_number(change, words):
    class Wrong(Reach):
        def step(self, action):
            observation, *rest, info = super().step(action)
            return change(observation, *rest, info=info)

    with pytest.raises(ConfigError, match=rf"step 1 with seed 0 failed: TypeError: .*{words}"):
        audit_benchmark(Wrong, CONFIG)


def test_a_reset_without_an_info_is_refused():
    class Old(Reach):
        def reset(self, **options):
            return super().reset(**options)[0]

    with pytest.raises(ConfigError, match=r"reset\(seed=0\) failed: TypeError: expected a tuple .*, got dict"):
        audit_benchmark(Old, CONFIG)


def test_an_environment_without_resets_without_a_seed_is_refused():
    class Seeded(Reach):
        def reset(self, *, seed, options=None):
            return super().reset(seed=seed)

    with pytest.raises(ConfigError, match=r"reset\(\) failed: TypeError: .*missing .*'seed'"):
        audit_benchmark(Seeded, CONFIG)


def test_an_environment_that_fails_to_close_keeps_its_audit():
    class Unclosed(Reach):
        def close(self):
            raise RuntimeError("no display")

    found = [(one.check, one.sentence) for one in audit_benchmark(Unclosed, CONFIG).findings]
    assert found == [("closes", "close() failed after the last episode: RuntimeError: no display")]


def test_an_environments_own_option_may_be_called_name():
    made = []
    gymnasium.register("Named-v0", lambda name: made.append(name) or Reach())
    environment_maker("Named-v0", **{"name": "mine"})()
    assert made == ["mine"]


def test_a_broken_environment_and_an_unknown_one_are_refused():
    class Broken(Reach):
        def reset(self, **_):
            raise RuntimeError("no scene")

    with pytest.raises(ConfigError, match=r"reset\(seed=0\) failed: RuntimeError: no scene"):
        audit_benchmark(Broken, CONFIG)
    with pytest.raises(ConfigError, match="no environment 'Nothing-v0'"):
        environment_maker("Nothing-v0")
    with pytest.raises(ConfigError, match="at least 2 seeds"):
        AuditConfig(seeds=1)
