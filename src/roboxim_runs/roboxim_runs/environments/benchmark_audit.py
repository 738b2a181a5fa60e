"""Audit of a benchmark: probe any Gymnasium environment, and have the probes judged.

The environment is only used through `reset` and `step`. Judging is `roboxim_eval.auditing`.
"""

from __future__ import annotations

import copy
import importlib
import random
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import gymnasium
import numpy as np

from roboxim_core.errors import ConfigError, nearest
from roboxim_eval.auditing import Audit, Probes, Trace, audit_findings, digest
from roboxim_policies.base import blaming
from roboxim_runs.environments.ids import register

Environment = gymnasium.Env[Any, Any]
Actor = Callable[[Any, str], Any]
"""Observation and instruction to an action. An actor is made for each episode."""
Actions = Iterable[Any] | Callable[[Any, str], Any]
SUCCESS_KEYS = ("is_success", "success")
WORD_KEYS = ("task_description", "instruction", "language_instruction", "prompt")
OTHER_SEEDS = 1_000
"""Offset of the seeds of complete episodes."""


@dataclass(frozen=True, kw_only=True)
class AuditConfig:
    """Size of an audit."""

    seeds: int = 8
    """Number of seeds whose scenes are compared; at least 2."""
    steps: int = 20
    """Number of steps of a probe; at least 2."""
    episodes: int = 20
    """Number of complete episodes of each way to act; at least 1."""
    limit: int = 1_000
    """Number of steps after which an episode is given up; at least `steps`."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: When one is too small.
        """
        if self.seeds < 2 or self.steps < 2 or self.episodes < 1 or self.limit < self.steps:
            raise ConfigError(
                "an audit needs at least 2 seeds, 2 steps, 1 episode and a limit of no fewer steps than a probe; "
                f"got {self}"
            )


def environment_maker(name: str, /, **options: Any) -> Callable[[], Environment]:
    """Return a function that makes a registered environment.

    Args:
        name: Id, e.g. ``roboxim/PickCube-v0``, or ``module:id``, which imports the module first.
        **options: Passed to the environment.

    Raises:
        ConfigError: When the module or the id is unknown.
    """
    module, _, name_there = name.rpartition(":")
    register()
    try:
        if module:
            importlib.import_module(module)
        gymnasium.spec(name_there)
    except (ImportError, gymnasium.error.Error) as error:
        hint = nearest(gymnasium.registry, name_there)
        raise ConfigError(
            f"no environment '{name}': {error}; {f'{hint} Else name' if hint else 'name'} a registered id, or "
            "MODULE:ID with the module that registers it"
        ) from error
    return lambda: gymnasium.make(name_there, disable_env_checker=True, **options)


def audit_benchmark(
    make: Callable[[], Environment], config: AuditConfig | None = None, *, solver: Callable[[], Actor] | None = None
) -> Audit:
    """Probe an environment and judge it.

    Args:
        make: Makes an environment.
        config: Size of the audit; none: the default one.
        solver: Makes an actor that succeeds, for the checks of words, replay and rewards; none: these use what random
            actions solve.

    Raises:
        ConfigError: When the environment fails at a reset, or at an action of its own space, or the solver returns no
            function.
        PolicyError: When the solver raises; the message says where.
    """
    config = config or AuditConfig()
    try:
        first, second = make(), make()
    except Exception as error:
        raise ConfigError(f"the environment cannot be made: {type(error).__name__}: {error}") from error
    unclosed: list[str] = []
    try:
        probes = _Prober(first, config).probes(second, _blamed(solver) if solver else None)
    finally:
        for env in (first, second):
            try:
                env.close()
            except Exception as error:  # the probes count, however the environment ends
                unclosed.append(f"{type(error).__name__}: {error}")
    return audit_findings(replace(probes, unclosed=unclosed))


def _blamed(solver: Callable[[], Actor]) -> Callable[[], Actor]:
    """Return a solver whose errors are its own and not the environment's."""

    def make() -> Actor:
        with blaming("the solver does not return a policy"):
            actor = solver()
        if not callable(actor):
            raise ConfigError(
                "the solver must return a policy, a function of observation and instruction; got "
                f"{type(actor).__name__}"
            )

        def act(observation: Any, words: str) -> Any:
            with blaming("the solver's policy failed"):
                return actor(observation, words)

        return act

    return make


class _Prober:
    """Makes the probes of an environment."""

    def __init__(self, env: Environment, config: AuditConfig) -> None:
        self._env, self._config = env, config
        self._notes: list[str] = []

    def probes(self, other: Environment, solver: Callable[[], Actor] | None) -> Probes:
        """Return all probes. The order matters: those of order and leaks come after the clean ones."""
        env, config = self._env, self._config
        actions = random_actions(env, 0, config.steps)
        first = self._play(env, 0, actions)
        again = self._play(env, 0, actions)
        other_instance = self._play(other, 0, actions)
        seeds = {seed: self._play(env, seed, ()) for seed in range(config.seeds)}
        after_others = self._play(env, 0, actions)
        self._play(env, config.seeds, random_actions(env, 1, config.steps))
        after_episode = self._play(env, 0, actions)
        with _global_seed(1):
            self._play(env, 0, actions)
        with _global_seed(2):
            before = _global_state()
            other_global = self._play(env, 0, actions)
            touched = before != _global_state()
        noop, drawn = self._whole(lambda seed: self._still), self._whole(self._random)
        solved, wordless = self._solved(solver)
        beyond, clipped = self._out_of_bounds()
        return Probes(
            first=first, again=again, other_instance=other_instance, after_others=after_others,
            after_episode=after_episode, other_global_seed=other_global, touches_global_random=touched,
            still=self._play(env, 0, [self._still(None, "")] * config.steps), seeds=seeds,
            unseeded=(self._unseeded(), self._unseeded()), beyond=beyond, clipped=clipped,
            not_a_number=self._nan(), noop=noop, random=drawn, limit=config.limit, solved=solved, wordless=wordless,
            **self._replays(solver), notes=(*self._memory(), *dict.fromkeys(self._notes)),
        )  # fmt: skip

    # -------------------------------------------------------------- ways to act

    def _still(self, _: Any, __: str) -> Any:
        """Return the action without motion: zeros, or the nearest to them; the first one of whole numbers."""
        return _zeros_of(self._env.action_space)

    def _random(self, seed: int) -> Actor:
        self._env.action_space.seed(seed)
        return lambda _, __: self._env.action_space.sample()

    def _whole(self, actor: Callable[[int], Actor], *, words: bool = True) -> list[Trace]:
        """Play complete episodes, each with its own actor."""
        seeds = range(OTHER_SEEDS, OTHER_SEEDS + self._config.episodes)
        return [self._play(self._env, seed, actor(seed), words=words) for seed in seeds]

    def _solved(self, solver: Callable[[], Actor] | None) -> tuple[list[Trace], list[Trace]]:
        if solver is None:
            return [], []
        solved = self._whole(lambda _: solver())
        speaks = any(trace.instruction for trace in solved)
        return solved, self._whole(lambda _: solver(), words=False) if speaks else []

    def _replays(self, solver: Callable[[], Actor] | None) -> dict[str, Any]:
        """Look for a solved episode, and play its actions again with its seed and with others."""
        for seed in range(OTHER_SEEDS, OTHER_SEEDS + self._config.episodes):
            taken: list[Any] = []
            inner = solver() if solver else self._random(seed)
            trace = self._play(self._env, seed, _recorded(inner, taken))
            if trace.success:
                return {
                    "solved_trace": trace, "replayed": self._play(self._env, seed, taken),
                    "replayed_elsewhere": [self._play(self._env, s, taken) for s in range(self._config.seeds)],
                }  # fmt: skip
        return {}

    def _unseeded(self) -> tuple[str, ...]:
        _reset(self._env, seed=3)
        return tuple(digest(_reset(self._env)[0]) for _ in range(3))

    def _out_of_bounds(self) -> tuple[Trace, Trace]:
        """Play actions at twice their bounds, and the same ones clipped.

        One component at a time: an environment may bound the length of a vector, which keeps its direction.
        """
        space, empty = self._env.action_space, Trace(observations=())
        if not isinstance(space, gymnasium.spaces.Box) or not np.isfinite([*space.low.flat, *space.high.flat]).all():
            return empty, empty
        low, high = space.low.astype(np.float64), space.high.astype(np.float64)
        middle, way = (high + low) / 2, high - low  # twice the way to a bound
        numbers = np.finfo(space.dtype) if np.issubdtype(space.dtype, np.floating) else np.iinfo(space.dtype)
        if not ((middle - way >= numbers.min) & (middle + way <= numbers.max)).all():
            return empty, empty
        rng, still = np.random.default_rng(0), np.asarray(self._still(None, ""))
        far = []
        for step in range(self._config.steps):
            far.append(still.copy())
            where = step % still.size
            far[-1].flat[where] = middle.flat[where] + rng.choice([-1, 1]) * way.flat[where]
        near = [np.clip(action, space.low, space.high) for action in far]
        return self._play(self._env, 0, far, may_refuse=True), self._play(self._env, 0, near)

    def _nan(self) -> Trace | None:
        space = self._env.action_space
        if not isinstance(space, gymnasium.spaces.Box) or not np.issubdtype(space.dtype, np.floating):
            return None
        return self._play(self._env, 0, [np.full(space.shape, np.nan, space.dtype)], may_refuse=True)

    def _memory(self) -> Iterator[str]:
        """Yield faults of memory that the environment and its caller share."""
        observation, _ = _reset(self._env, seed=0)
        before = digest(observation)
        [action] = random_actions(self._env, 4, 1)
        kept = digest(action)
        self._env.step(action)
        if digest(action) != kept:
            yield "a step changes the caller's action"
        if digest(observation) != before:
            yield "a step changes an earlier observation in place"

    # -------------------------------------------------------------- an episode

    def _play(
        self, env: Environment, seed: int, actions: Actions, *, may_refuse: bool = False, words: bool = True
    ) -> Trace:
        """Play an episode: until the actions end, or with an actor until it is over or at the limit.

        Raises:
            ConfigError: When the environment fails at a reset, or at an action that it must accept.
        """
        observation, info = _reset(env, seed=seed)
        instruction = _instruction(env, info, observation)
        seen = [digest(observation)]
        rewards: list[float] = []
        successes: list[bool | None] = []
        faults = list(_faults(env, observation, "the reset"))
        start = _success(info)
        terminated = truncated = False
        refused = ""
        words_given = (instruction or "") if words else ""
        following = None if callable(actions) else iter(actions)
        while not (terminated or truncated) and len(rewards) < self._config.limit:
            if following is None:
                action = actions(observation, words_given)  # type: ignore[operator]
            elif (action := next(following, None)) is None:
                break
            try:
                observation, reward, terminated, truncated, info = _checked(env.step(copy.deepcopy(action)))
                rewards.append(float(reward))
            except Exception as error:
                if not may_refuse:
                    raise ConfigError(
                        f"step {len(rewards) + 1} with seed {seed} failed: {type(error).__name__}: {error}"
                    ) from error
                refused = f"{type(error).__name__}: {error}"
                break
            seen.append(digest(observation))
            successes.append(_success(info))
            if not may_refuse:
                faults += _faults(env, observation, "a step")
        return Trace(
            observations=tuple(seen), rewards=tuple(rewards), successes=tuple(successes), start_success=start,
            terminated=bool(terminated), truncated=bool(truncated), instruction=instruction,
            final=tuple(_numbers(observation)), faults=tuple(dict.fromkeys(faults)), refused=refused,
        )  # fmt: skip


def random_actions(env: Environment, seed: int, count: int) -> list[Any]:
    """Return random actions of the environment's space; the same ones for the same seed."""
    env.action_space.seed(seed)
    return [env.action_space.sample() for _ in range(count)]


def _reset(env: Environment, **options: Any) -> Any:
    """Return the observation and the info of a reset.

    Raises:
        ConfigError: When it fails.
    """
    try:
        return _checked(env.reset(**options))
    except Exception as error:
        given = ", ".join(f"{name}={value}" for name, value in options.items())
        raise ConfigError(f"reset({given}) failed: {type(error).__name__}: {error}") from error


def _checked(returned: Any) -> Any:
    """Return what a reset or a step returned.

    Raises:
        TypeError: When it does not end in an info.
    """
    last = returned[-1] if isinstance(returned, tuple) and returned else returned
    if not isinstance(returned, tuple) or not isinstance(last, Mapping):
        raise TypeError(f"expected a tuple whose last part is an info (a dict), got {type(last).__name__} in its place")
    return returned


def _recorded(actor: Actor, taken: list[Any]) -> Actor:
    def act(observation: Any, words: str) -> Any:
        action = actor(observation, words)
        taken.append(copy.deepcopy(action))  # an actor may fill one array again and again
        return action

    return act


def _zeros_of(space: gymnasium.Space[Any]) -> Any:
    """Return the element of a space that has zeros, or starts, everywhere."""
    spaces = gymnasium.spaces
    if isinstance(space, spaces.Discrete):
        return space.start
    if isinstance(space, spaces.Dict):
        return {key: _zeros_of(inner) for key, inner in space.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(_zeros_of(inner) for inner in space)
    if isinstance(space, (spaces.MultiDiscrete, spaces.MultiBinary)):
        return np.zeros(space.shape, space.dtype)
    if isinstance(space, spaces.Box):
        return np.clip(np.zeros(space.shape, space.dtype), space.low, space.high).astype(space.dtype)
    raise ConfigError(f"the audit knows no action without motion of a {type(space).__name__} space")


def _success(info: dict[str, Any]) -> bool | None:
    for key in SUCCESS_KEYS:
        if key in info:
            return bool(np.all(info[key]))
    return None


def _instruction(env: Environment, info: dict[str, Any], observation: Any) -> str | None:
    for key in WORD_KEYS:
        for source in (info, observation):
            if isinstance(source, dict) and isinstance(source.get(key), str):
                return str(source[key])
        if isinstance(found := getattr(env.unwrapped, key, None), str):
            return found
    return None


def _faults(env: Environment, observation: Any, where: str) -> Iterator[str]:
    """Yield what is wrong with an observation."""
    if not env.observation_space.contains(observation):
        yield f"the observation of {where} is not in the observation space"
    if not np.isfinite(list(_numbers(observation))).all():
        yield f"the observation of {where} is not finite"


def _numbers(value: Any) -> Iterator[float]:
    """Yield the floating-point numbers of an observation."""
    if isinstance(value, dict):
        for key in sorted(value, key=str):
            yield from _numbers(value[key])
    elif isinstance(value, (list, tuple)):
        for inner in value:
            yield from _numbers(inner)
    elif isinstance(value, (np.ndarray, np.generic, float)) and np.issubdtype(np.asarray(value).dtype, np.floating):
        yield from np.asarray(value, np.float64).ravel().tolist()


def _global_state() -> tuple[Any, str]:
    return random.getstate(), digest(list(np.random.get_state(legacy=True)))  # noqa: NPY002


@contextmanager
def _global_seed(seed: int) -> Iterator[None]:
    """Seed the global generators, and restore them afterwards."""
    kept, kept_numpy = random.getstate(), np.random.get_state(legacy=True)  # noqa: NPY002
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    try:
        yield
    finally:
        random.setstate(kept)
        np.random.set_state(kept_numpy)  # noqa: NPY002
